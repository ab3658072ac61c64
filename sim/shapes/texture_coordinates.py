"""Where on pictures a repaired mesh lies: found again by place, as repairs join, turn and drop what the file has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.mesh_file import read_texture_coordinates
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import TriangleMesh

SAME_PLACE = 1.0e-5
"""Repairs move vertices by less than this many bounding-box diagonals."""


def texture_coordinates(mesh: TriangleMesh, shape: MeshShape) -> NDArray[np.float32] | None:
    """Texture coordinates of every corner of the rest mesh of a file's solid.

    Args:
        mesh: with the vertices and the size of the file's shape, not scaled by its body.
        shape: the file.

    Returns:
        From a picture's lower left corner (0, 0) to its upper right (1, 1), (m, 3, 2); None if the file has none. Caps
        over holes go on with what their nearest corners have.

    Raises:
        ShapeError: the file cannot be read.
    """
    from scipy.spatial import cKDTree

    found = read_texture_coordinates(shape)
    if found is None:
        return None
    corners, uv = found
    own = mesh.corners
    # Both faces at a corner of a seam are there; the triangle says which of them counts, and then the corner's place.
    away, triangle = cKDTree(corners.mean(axis=1)).query(own.mean(axis=1))
    offsets = np.linalg.norm(own[:, :, None] - corners[triangle][:, None], axis=3)
    coordinates = np.take_along_axis(uv[triangle], offsets.argmin(axis=2)[:, :, None], axis=1)
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    of_cap = (away > SAME_PLACE * diagonal) | (offsets.min(axis=2).max(axis=1) > SAME_PLACE * diagonal)
    if of_cap.any():
        _, nearest = cKDTree(corners.reshape(-1, 3)).query(own[of_cap].reshape(-1, 3))
        coordinates[of_cap] = uv.reshape(-1, 2)[nearest].reshape(-1, 3, 2)
    return coordinates.astype(np.float32)
