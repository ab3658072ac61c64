"""A job's scene in real time in a browser: bodies are dragged, and parameters changed."""
