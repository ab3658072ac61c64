"""What the user wrote: models, loading, presets, overrides."""
