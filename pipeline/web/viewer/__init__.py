"""Cached frames in a browser, to be scrubbed and played, also while their job still runs.

Reading (`committed`, `frames`), deciding (`playback`, `numbers`) and drawing (`scene`, `page`) are apart: only
`controls` and `page` know viser.
"""
