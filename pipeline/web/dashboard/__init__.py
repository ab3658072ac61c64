"""The dashboard: a farm's jobs as pages in a browser. Needs the extra `view`; only `pipeline dashboard` imports it."""
