"""Cached frames in a browser: what a job has simulated, to be scrubbed and played, also while it still runs.

Reading (`committed`, `frames`, `loaded`), deciding (`playback`, `colors`, `smoke_pictures`, `numbers`) and drawing
(`drawing`, `page`) are apart: only `serving`, `drawing`, `controls` and `page` know viser.
"""
