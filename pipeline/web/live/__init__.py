"""A job's scene in real time in a browser: moved by hand, with knobs for what it is made of."""
