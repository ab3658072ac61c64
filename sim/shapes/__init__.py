"""Shapes: primitives, the procedural duck and bunny, meshes, and their signed distances."""
