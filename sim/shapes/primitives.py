"""Primitives with exact signed distances, closed volumes and closed meshes.

Distances follow the constructions of I. Quilez, "Distance functions" (2008-2023), in their exact variants.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points, RestShape, TriangleMesh
from sim.shapes.tessellation import grid_box, icosphere, revolve, revolve_ring, subdivide_polyline

Distances = NDArray[np.float64]

SMOOTH_SEGMENTS = 160  # of a full circle when only looks count: a chord is off by 0.02 % of the radius


def segments_of(radius: float, max_edge: float | None) -> int:
    """Segments of a circle so that edges, diagonals of the quads included, stay within `max_edge` [m]."""
    if max_edge is None:
        return SMOOTH_SEGMENTS
    return max(SMOOTH_SEGMENTS, int(np.ceil(2.0 * np.pi * radius / (max_edge / np.sqrt(2.0)))))


def axial_edge(max_edge: float | None) -> float:
    """Longest edge of a profile that is turned [m], so that diagonals of the quads stay within `max_edge`."""
    return np.inf if max_edge is None else max_edge / np.sqrt(2.0)


def _radial(points: Points) -> Distances:
    return np.hypot(points[:, 0], points[:, 1])


def _distance_in_slab(beyond: NDArray[np.float64]) -> Distances:
    """Distance to {x : beyond(x) <= 0 in every column}, for orthogonal columns (n, k)."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


@dataclass(frozen=True)
class Box(RestShape):
    """An axis-aligned box of the given edge lengths [m], centred on the origin."""

    size: tuple[float, float, float]

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return float(np.prod(self.size))

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the box [m]."""
        return np.abs(directions) @ (0.5 * np.asarray(self.size))

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        return _distance_in_slab(np.abs(points) - 0.5 * np.asarray(self.size))

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """Faces cut into rectangles; two triangles each."""
        return grid_box(self.size, axial_edge(max_edge))


@dataclass(frozen=True)
class Sphere(RestShape):
    """A ball of the given radius [m], centred on the origin."""

    radius: float

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return 4.0 / 3.0 * np.pi * self.radius**3

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the ball [m]."""
        return self.radius * np.linalg.norm(directions, axis=1)

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        return np.linalg.norm(points, axis=1) - self.radius

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """An icosahedron, subdivided and projected."""
        return icosphere(self.radius, np.inf if max_edge is None else max_edge)


@dataclass(frozen=True)
class Cylinder(RestShape):
    """A solid cylinder along z, centred on the origin; radius and height [m]."""

    radius: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return np.pi * self.radius**2 * self.height

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the cylinder [m]."""
        return self.radius * _radial(directions) + 0.5 * self.height * np.abs(directions[:, 2])

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        return _distance_in_slab(
            np.stack([_radial(points) - self.radius, np.abs(points[:, 2]) - 0.5 * self.height], axis=1)
        )

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """A revolved rectangle."""
        half = 0.5 * self.height
        profile = [(0.0, -half), (self.radius, -half), (self.radius, half), (0.0, half)]
        return revolve(subdivide_polyline(profile, axial_edge(max_edge)), segments_of(self.radius, max_edge))


@dataclass(frozen=True)
class Capsule(RestShape):
    """A cylinder along z with half-ball caps, centred on the origin; radius and cylindrical height [m]."""

    radius: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return np.pi * self.radius**2 * (self.height + 4.0 / 3.0 * self.radius)

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the capsule [m]."""
        return self.radius * np.linalg.norm(directions, axis=1) + 0.5 * self.height * np.abs(directions[:, 2])

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        beyond_axis = np.maximum(np.abs(points[:, 2]) - 0.5 * self.height, 0.0)
        return np.hypot(_radial(points), beyond_axis) - self.radius

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """A revolved half stadium."""
        segments = segments_of(self.radius, max_edge)
        angle = np.linspace(0.0, 0.5 * np.pi, segments // 4 + 1)
        r, z = self.radius * np.sin(angle), -self.radius * np.cos(angle) - 0.5 * self.height
        r[0] = 0.0
        profile = [*zip(r, z, strict=True), *zip(r[::-1], -z[::-1], strict=True)]
        return revolve(subdivide_polyline(profile, axial_edge(max_edge)), segments)


@dataclass(frozen=True)
class Torus(RestShape):
    """A ring around z, centred on the origin; major radius > minor radius [m]."""

    major_radius: float
    minor_radius: float

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return 2.0 * np.pi**2 * self.major_radius * self.minor_radius**2

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the ring [m]."""
        return self.major_radius * _radial(directions) + self.minor_radius * np.linalg.norm(directions, axis=1)

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        return np.hypot(_radial(points) - self.major_radius, points[:, 2]) - self.minor_radius

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """A revolved circle."""
        around_tube = segments_of(self.minor_radius, max_edge) // (2 if max_edge is None else 1)
        angle = np.linspace(0.0, 2.0 * np.pi, around_tube, endpoint=False)
        r, z = self.major_radius + self.minor_radius * np.cos(angle), self.minor_radius * np.sin(angle)
        return revolve_ring(np.stack([r, z], axis=1), segments_of(self.major_radius + self.minor_radius, max_edge))


@dataclass(frozen=True)
class Cone(RestShape):
    """A solid cone along z, base down, its bounding box centred on the origin; base radius and height [m]."""

    radius: float
    height: float

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return np.pi * self.radius**2 * self.height / 3.0

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the cone [m]: at its tip or on the rim of its base."""
        along = 0.5 * self.height * directions[:, 2]
        return np.maximum(along, self.radius * _radial(directions) - along)

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside: that of the triangle which the cone revolves."""
        p = np.stack([_radial(points), points[:, 2]], axis=1)
        half = 0.5 * self.height
        rim, slant = np.array([self.radius, -half]), np.array([-self.radius, self.height])
        along_slant = np.clip((p - rim) @ slant / (slant @ slant), 0.0, 1.0)
        to_slant = np.linalg.norm(p - rim - along_slant[:, None] * slant, axis=1)
        to_base = np.hypot(np.maximum(p[:, 0] - self.radius, 0.0), p[:, 1] + half)
        inside = (p[:, 1] > -half) & ((p - rim) @ np.array([self.height, self.radius]) < 0.0)
        return np.where(inside, -1.0, 1.0) * np.minimum(to_slant, to_base)

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """A revolved triangle."""
        half = 0.5 * self.height
        # A few rows keep the smooth normals of the tip from spreading over the whole cone.
        slant_edge = min(axial_edge(max_edge), np.hypot(self.radius, self.height) / 32.0)
        profile = [(0.0, -half), *subdivide_polyline([(self.radius, -half), (0.0, half)], slant_edge)]
        return revolve(subdivide_polyline(profile, axial_edge(max_edge)), segments_of(self.radius, max_edge))
