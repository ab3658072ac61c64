"""Soft matter: sand, snow, jelly and clay, by the material point method."""
