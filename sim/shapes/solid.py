"""What a solid is to everybody else: an inside, a signed distance and a surface mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
"""(n, 3) positions or directions."""


class ShapeError(ValueError):
    """A shape that cannot be built; the text gives place, rule, value and remedy."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles whose normals (counter-clockwise corners) point out of the solid.

    Attributes:
        vertices: (n, 3) float64 [m].
        faces: (m, 3) int32 vertex indices.
        part: (m,) int32, which of `part_names` a face belongs to; None for a shape of one part.
        part_names: names of the parts, such as "body", "bill" and "eyes".
    """

    vertices: Points
    faces: NDArray[np.int32]
    part: NDArray[np.int32] | None = None
    part_names: tuple[str, ...] = ()

    @property
    def corners(self) -> NDArray[np.float64]:
        """Corners of every face [m], (m, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def area_vectors(self) -> NDArray[np.float64]:
        """Normal of every face times its area [m²], (m, 3)."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return 0.5 * np.cross(b - a, c - a)

    @property
    def signed_volume(self) -> float:
        """Enclosed volume [m³] by the divergence theorem; exact for a closed mesh, negative if inside out."""
        a, b, c = np.moveaxis(self.corners - self.vertices.mean(axis=0), 1, 0)
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner [m], (2, 3)."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @property
    def is_closed(self) -> bool:
        """Whether every edge is passed as often forwards as backwards: a surface without boundary."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        forwards = edges[:, 0] < edges[:, 1]
        undirected = np.sort(edges, axis=1)
        key = undirected[:, 0] * len(self.vertices) + undirected[:, 1]
        _, edge = np.unique(key, return_inverse=True)
        return bool(np.all(np.bincount(edge, weights=np.where(forwards, 1.0, -1.0)) == 0.0))

    def transformed(self, scale: float, rotation: NDArray[np.float64], position: NDArray[np.float64]) -> TriangleMesh:
        """The mesh scaled, then rotated by a (3, 3) matrix, then moved by `position` [m]."""
        vertices = scale * self.vertices @ rotation.T + position
        return TriangleMesh(vertices, self.faces, self.part, self.part_names)

    def piece(self, part: str) -> TriangleMesh:
        """The faces of one part, with the vertices that they use; the whole mesh if it has no parts."""
        if self.part is None:
            return self
        faces = self.faces[self.part == self.part_names.index(part)]
        used, numbers = np.unique(faces, return_inverse=True)
        return TriangleMesh(self.vertices[used], numbers.reshape(faces.shape).astype(np.int32))


class Solid(Protocol):
    """A closed region of the world."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of its tight axis-aligned box [m], (2, 3)."""

    @property
    def volume(self) -> float:
        """Volume [m³]."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired or assumed to build it, one sentence each, for the user."""

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,), of world positions (n, 3)."""

    def surface_mesh(self, max_edge: float | None = None) -> TriangleMesh:
        """Its closed, outward-oriented surface in world coordinates, fine enough to be rendered.

        Args:
            max_edge: upper bound on the length of an edge [m]; as fine as looks smooth if omitted.
        """


class RestShape(Protocol):
    """A shape about its own origin, before it is scaled, rotated and moved; lengths in metres."""

    @property
    def volume(self) -> float:
        """Volume [m³]."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired or assumed, one sentence each."""

    def support(self, directions: Points) -> NDArray[np.float64]:
        """Largest x·d over the shape [m], (k,), for unit directions d (k, 3)."""

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,)."""

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """Closed outward-oriented surface; edges no longer than `max_edge` [m] if given."""
