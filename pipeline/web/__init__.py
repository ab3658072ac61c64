"""Pages in a browser: the dashboard of the farm, the viewer of a job, live scenes."""
