"""Counts where the triangles of a mesh cross, by exact arithmetic; shares no code with the physics.

Triangles without a common edge cross where an edge of one passes through the other. Whether it does is a matter of the
signs of five determinants; those that floating point cannot tell are computed with fractions.
"""

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

CERTAIN = 1.0e-12  # above it, over the product of the lengths in it, a determinant has the sign of float64


def edges_of_triangles(triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Every edge once, (e, 2)."""
    return np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).astype(np.int64), axis=1), axis=0)


def crossings(positions: NDArray[np.floating], triangles: NDArray[np.integer]) -> NDArray[np.int64]:
    """Edges that pass through triangles, or touch them: two ends and three corners, (m, 5).

    Args:
        positions: of the vertices [m], (n, 3).
        triangles: corners, (k, 3).
    """
    x = np.asarray(positions, dtype=np.float64)
    triangles = triangles.astype(np.int64)
    edges = edges_of_triangles(triangles)
    edge_centre, centroid = x[edges].mean(axis=1), x[triangles].mean(axis=1)
    edge_radius = np.linalg.norm(x[edges] - edge_centre[:, None], axis=2).max(axis=1)
    radius = np.linalg.norm(x[triangles] - centroid[:, None], axis=2).max(axis=1)
    near = cKDTree(edge_centre).sparse_distance_matrix(
        cKDTree(centroid), float(edge_radius.max() + radius.max()), output_type="ndarray"
    )
    near = near[near["v"] <= edge_radius[near["i"]] + radius[near["j"]]]
    candidates = np.concatenate([edges[near["i"]], triangles[near["j"]]], axis=1)
    apart = ~(candidates[:, :2, None] == candidates[:, None, 2:]).any(axis=(1, 2))
    candidates = candidates[apart]
    p, q, a, b, c = np.moveaxis(x[candidates], 1, 0)
    sides = np.stack([_sign(a, b, c, p), _sign(a, b, c, q)], axis=1)
    # An edge in the plane of a triangle, as all of flat cloth, passes through nothing.
    through_plane = (sides.prod(axis=1) <= 0) & sides.any(axis=1)
    candidates, p, q, a, b, c = (each[through_plane] for each in (candidates, p, q, a, b, c))
    sides = np.stack([_sign(p, q, a, b), _sign(p, q, b, c), _sign(p, q, c, a)], axis=1)
    return candidates[(sides >= 0).all(axis=1) | (sides <= 0).all(axis=1)]


def _sign(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray[np.int64]:
    """Sign of the volume of each tetrahedron, exact, (m,)."""
    u, v, w = b - a, c - a, d - a
    volume = np.einsum("ij,ij->i", np.cross(u, v), w)
    scale = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(w, axis=1)
    sign = np.sign(volume).astype(np.int64)
    for row in np.flatnonzero(np.abs(volume) <= CERTAIN * scale):
        exact = [[Fraction(float(value)) for value in point[row]] for point in (a, b, c, d)]
        (ux, uy, uz), (vx, vy, vz), (wx, wy, wz) = (
            [value - start for value, start in zip(point, exact[0], strict=True)] for point in exact[1:]
        )
        determinant = ux * (vy * wz - vz * wy) - uy * (vx * wz - vz * wx) + uz * (vx * wy - vy * wx)
        sign[row] = (determinant > 0) - (determinant < 0)
    return sign
