"""The job file: loading, overrides, messages, schema, presets, checks of the whole job."""
