"""The side of a closed mesh that a point is on, found from the nearest point of the mesh.

The normal of the nearest triangle does not tell it beyond an edge or a corner, where several triangles are as near. The
mean of their normals does, each weighed by the angle that it has there (Baerentzen & Aanaes 2005, "Signed distance
computation using the angle weighted pseudonormal").
"""

from __future__ import annotations

import numpy as np

_ON_EDGE = 1.0e-5
"""Nearer to an edge than this a place is on it, in the size of the mesh: places are of single precision. It may be
wide, as the normal of an edge tells the sides of what is right beside it, too."""


class Pseudonormals:
    """Outward directions at every place on a closed mesh: positions (n, 3) [m] and outward triangles (m, 3)."""

    def __init__(self, positions: np.ndarray, triangles: np.ndarray) -> None:
        # Vertices in the same place are one: what has flat normals has them split.
        positions, vertices = np.unique(positions, axis=0, return_inverse=True)
        self._triangles = triangles = vertices.ravel()[triangles]
        self._positions = positions.astype(np.float64)
        self._on_edge = _ON_EDGE * float(np.ptp(positions, axis=0).max())
        sides = _sides(self._positions[triangles])
        self._of_triangles = _unit(np.cross(sides[:, 0], sides[:, 1]))
        edges = _edges(triangles)
        self._edges = edges.reshape(-1, 3)
        self._of_edges = _unit(_sums(edges, np.repeat(self._of_triangles, 3, axis=0)))
        ways = _unit(sides)
        cosines = -(np.roll(ways, 1, axis=1) * np.roll(ways, -1, axis=1)).sum(axis=2)
        angles = np.arccos(np.clip(cosines, -1.0, 1.0))
        weighed = (angles[:, :, None] * self._of_triangles[:, None]).reshape(-1, 3)
        self._of_vertices = _unit(_sums(triangles.ravel(), weighed))

    def at(self, numbers: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Unit vectors outwards (k, 3) at places (k, 3) [m] on the triangles of these numbers (k,)."""
        outwards, corners = self._of_triangles[numbers], self._positions[self._triangles[numbers]]
        from_corners = places[:, None] - corners
        distances = np.linalg.norm(from_corners, axis=2)
        into = _unit(np.cross(outwards[:, None], _sides(corners)))  # from each side, in the triangle's plane
        heights = (np.roll(from_corners, -1, axis=1) * into).sum(axis=2)
        is_on_edge = heights.min(axis=1) < self._on_edge
        edges = self._edges[numbers[is_on_edge], heights[is_on_edge].argmin(axis=1)]
        outwards[is_on_edge] = self._of_edges[edges]
        is_on_vertex = distances.min(axis=1) < self._on_edge
        vertices = self._triangles[numbers[is_on_vertex], distances[is_on_vertex].argmin(axis=1)]
        outwards[is_on_vertex] = self._of_vertices[vertices]
        return outwards


def _sides(corners: np.ndarray) -> np.ndarray:
    """Sides of triangles (m, 3, 3) [m]: number k goes from corner k + 1 to k + 2."""
    return np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)


def _edges(triangles: np.ndarray) -> np.ndarray:
    """Numbers of the edges that sides of triangles are on, (3 m,): two sides of neighbours are on one."""
    ends = np.stack([np.roll(triangles, -1, axis=1), np.roll(triangles, 1, axis=1)], axis=2).reshape(-1, 2)
    ends = np.sort(ends.astype(np.int64), axis=1)
    return np.unique(ends[:, 0] * (int(ends.max()) + 1) + ends[:, 1], return_inverse=True)[1]


def _sums(numbers: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Sums of the vectors (n, 3) that have the same number (n,), by number, (k, 3)."""
    return np.stack([np.bincount(numbers, vectors[:, axis]) for axis in range(3)], axis=1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors of length 1, and of length 0 where they had none."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
