"""Cloth as a renderable surface: normals for smooth shading."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from render.meshes import Float32Array


def vertex_normals(vertices: ArrayLike, faces: ArrayLike) -> Float32Array:
    """Unit normals (n, 3) float32 of vertices (n, 3) [m]: means over the triangles around them, weighted by area.

    Twice the area of a triangle is the length of the cross product of its sides, so these are just added, in float64
    and in the order of the faces: the same mesh gives the same bits. A vertex whose triangles have no area, or that is
    of none, gets (0, 0, 1).
    """
    positions, triangles = np.asarray(vertices, np.float64), np.asarray(faces)
    a, b, c = np.moveaxis(positions[triangles], 1, 0)
    of_faces = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    totals = np.stack(
        [np.bincount(triangles.ravel(), weights=each, minlength=len(positions)) for each in of_faces.T], axis=1
    )
    lengths = np.linalg.norm(totals, axis=1, keepdims=True)
    flat = np.broadcast_to((0.0, 0.0, 1.0), totals.shape)
    return np.divide(totals, lengths, out=flat.copy(), where=lengths > 0.0).astype(np.float32)
