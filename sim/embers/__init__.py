"""Embers: glowing particles that the air of a smoke carries."""
