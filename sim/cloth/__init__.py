"""Cloth: springs between points of mass, after XPBD with small steps."""
