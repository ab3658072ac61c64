"""What a solid is to everybody else: an inside, a signed distance and a surface mesh."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]  # (n, 3) positions or directions
SignedDistance = Callable[[Points], NDArray[np.float64]]


class ShapeError(ValueError):
    """A shape that cannot be built; the text gives place, rule, value and remedy."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles whose normals (counter-clockwise corners) point out of the solid."""

    vertices: Points  # (n, 3) float64 [m]
    faces: NDArray[np.int32]  # (m, 3) vertex indices
    part: NDArray[np.int32] | None = None  # which of `part_names` a face belongs to, (m,); None for one part
    part_names: tuple[str, ...] = ()  # such as "body", "bill" and "eyes"

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
        return not len(boundary_edges(self.faces))

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


def boundary_edges(faces: NDArray[np.integer]) -> NDArray[np.int64]:
    """Directed edges (k, 2) that faces pass more often forwards than backwards; none for a closed mesh."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    low, high = edges.min(axis=1), edges.max(axis=1)
    _, first, edge = np.unique(low * (high.max(initial=0) + 1) + high, return_index=True, return_inverse=True)
    net = np.bincount(edge, weights=np.where(edges[:, 0] < edges[:, 1], 1.0, -1.0)).astype(np.int64)
    undirected = np.stack([low[first], high[first]], axis=1)
    open_edges = np.where(net[:, None] >= 0, undirected, undirected[:, ::-1])
    return np.repeat(open_edges, np.abs(net), axis=0)


def outward_normals(signed_distance: SignedDistance, points: Points, step: float) -> Points:
    """Unit vectors along the gradient of a distance, by differences over twice a step [m], (n, 3)."""
    shifts = [np.eye(3)[axis] * step for axis in range(3)]
    gradient = np.stack([signed_distance(points + shift) - signed_distance(points - shift) for shift in shifts], axis=1)
    return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)


class HasSignedDistance(Protocol):
    """A region of space that is known by its signed distance."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of its tight axis-aligned box [m], (2, 3)."""

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,), of positions (n, 3)."""


class Solid(HasSignedDistance, Protocol):
    """A closed region of the world."""

    @property
    def volume(self) -> float:
        """Volume [m³]."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired or assumed to build it, one sentence each, for the user."""

    def surface_mesh(self, max_edge: float | None = None) -> TriangleMesh:
        """Closed outward-oriented surface; edges no longer than `max_edge` [m], or as fine as looks smooth."""


class RestShape(ABC):
    """A shape about its own origin, before it is scaled, rotated and moved; lengths in metres.

    Attributes:
        warnings: what was repaired or assumed, one sentence each.
    """

    warnings: tuple[str, ...] = ()

    @property
    def centre(self) -> NDArray[np.float64]:
        """Where a body of the shape that is placed at the origin has the shape's own origin [m], (3,)."""
        return np.zeros(3)

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume [m³]."""

    @abstractmethod
    def support(self, directions: Points) -> NDArray[np.float64]:
        """Largest x·d over the shape [m], (k,), for unit directions d (k, 3)."""

    @abstractmethod
    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,), of points (n, 3)."""

    @abstractmethod
    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """Closed outward-oriented surface; edges no longer than `max_edge` [m] if given."""
