"""How the surface of an animated body deforms in its own frame: points that are fixed to it, and its distances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sim.shapes.animation import AnimatedSolid
from sim.shapes.level_set import LevelSet
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.parameters import AnimationShape
from sim.shapes.solid import Points, TriangleMesh

GRID_CELLS = 48  # of a distance grid along the longest edge of all that the mesh ever fills
GRID_PADDING = 0.1  # how far a distance grid reaches past it, in longest edges
EXACT_WITHIN = 2.0  # cells from the surface up to which distances are exact
FELT_WITHIN = 3.0  # cells from the surface up to which velocities are those of the nearest point
SPARSE = 4  # cells between the nodes that velocities farther away are interpolated from
MOST_KNOTS = 8  # moments between two samples at which distances are computed
LOOKUPS = 5  # moments between two samples at which speeds are looked up
KEPT_FIELDS = 3

Values = Callable[[Points], NDArray[np.float64]]


class Fields(NamedTuple):
    """Distances and velocities at the nodes of a grid, as far as it goes from one moment to another."""

    number: int  # tells the pair of moments
    share: float  # of the time between them that has passed [-]
    distances: tuple[NDArray[np.float32], NDArray[np.float32]]  # at both [m], (nx, ny, nz)
    velocities: tuple[NDArray[np.float32], NDArray[np.float32]]  # at both [m/s], (nx, ny, nz, 3)


class Track:
    """Values that are given at the samples, (k, ...), and go smoothly, or straight, in between; at rest outside.

    Attributes:
        values: at the samples, (k, ...).

    Cubic ones have the tangents of a parabola through three neighbours, and none at the ends, as paths have them.
    """

    def __init__(self, times: NDArray[np.float64], values: NDArray[np.floating], *, linear: bool) -> None:
        self._times, self.values, self._linear = times, values, linear

    def interval(self, time_s: float) -> tuple[int, float]:
        """Number of the sample before a time [s], or of the one that holds, and share of the way to the next one."""
        times = self._times
        if time_s < times[0]:
            return 0, 0.0
        if time_s >= times[-1]:
            return len(times) - 1, 0.0
        k = int(np.searchsorted(times, time_s, side="right")) - 1
        return k, (time_s - float(times[k])) / float(times[k + 1] - times[k])

    def at(self, time_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Values, and their derivatives, at a time [s]."""
        k, s = self.interval(time_s)
        value = self._value(k)
        if k == len(self._times) - 1 or time_s < self._times[0]:
            return value, np.zeros_like(value)
        span = float(self._times[k + 1] - self._times[k])
        step = self._value(k + 1) - value
        if self._linear:
            return value + s * step, step / span
        start, end = span * self._tangent(k), span * self._tangent(k + 1)
        bend, twist = 3.0 * step - 2.0 * start - end, start + end - 2.0 * step
        value = value + s * (start + s * (bend + s * twist))
        return value, (start + s * (2.0 * bend + 3.0 * s * twist)) / span

    def _value(self, k: int) -> NDArray[np.float64]:
        return self.values[k].astype(np.float64)

    def _tangent(self, k: int) -> NDArray[np.float64]:
        if k in (0, len(self._times) - 1):
            return np.zeros(self.values.shape[1:])
        before, after = (float(self._times[k + i] - self._times[k + i - 1]) for i in (0, 1))
        slopes = (self._value(k) - self._value(k - 1)) / before, (self._value(k + 1) - self._value(k)) / after
        tangent: NDArray[np.float64] = (after * slopes[0] + before * slopes[1]) / (before + after)
        return tangent


@dataclass(frozen=True, eq=False)
class Attachment:
    """Points that are fixed to triangles: over a point of each, by an offset along its edge, across it and outward."""

    faces: NDArray[np.int32]  # corners of the triangle of each, (m, 3)
    weights: NDArray[np.float64]  # barycentric coordinates, (m, 3)
    offsets: Points  # along the axes of the triangle [m], (m, 3)

    def at(self, vertices: Points) -> Points:
        """The points with the vertices there [m], (m, 3)."""
        corners = vertices[self.faces]
        return np.einsum("mc,mcx->mx", self.weights, corners) + np.einsum("mcx,mc->mx", axes_of(corners), self.offsets)

    def turned(self, rest: Points, vertices: Points, directions: Points) -> Points:
        """Directions (m, 3) at the points at rest as they are turned with the triangles."""
        along = np.einsum("mcx,mx->mc", axes_of(rest[self.faces]), directions)
        return np.einsum("mcx,mc->mx", axes_of(vertices[self.faces]), along)


def axes_of(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors along the first edge, across it and outward, of triangles (m, 3, 3), (m, 3, 3)."""
    tiny = np.finfo(np.float64).tiny
    edge = corners[:, 1] - corners[:, 0]
    normal = np.cross(edge, corners[:, 2] - corners[:, 0])
    edge /= np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), tiny)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), tiny)
    return np.stack([edge, np.cross(normal, edge), normal], axis=1)


class Deformation:
    """The surface of an animated body in the frame of its scaled shape, by simulated time.

    Distances are those of the mesh at some moments, between which its surface gets no farther than a cell, or of as
    many as there may be; in between they are interpolated. All grids have the same nodes.

    Attributes:
        faces: triangles, (m, 3).
        bounds: box of all that it ever fills [m], (2, 3).
        shortest_edge: of the boxes of its samples [m].
        largest_speed: of its points in this frame, as far as looked up [m/s].
        spacing: of the grids [m].
    """

    def __init__(self, solid: AnimatedSolid, shape: AnimationShape, scale: float) -> None:
        assert solid.deformed is not None, "a rigid animation has no deformation"
        self.faces, self._linear = solid.mesh.faces, shape.interpolation == "linear"
        self._times = shape.start_s + solid.times
        self._points = np.float32(scale) * solid.deformed
        self._vertices = Track(self._times, self._points, linear=self._linear)
        low, high = self._points.min(axis=1), self._points.max(axis=1)
        self.bounds = np.stack([low.min(axis=0), high.max(axis=0)]).astype(np.float64)
        self.shortest_edge = float((high - low).min())
        self.spacing = float(np.ptp(self.bounds, axis=0).max()) / GRID_CELLS
        self._speeds = self._interval_speeds()
        self.largest_speed = float(self._speeds.max())
        self._knots = self._knot_times()
        self._field = lru_cache(maxsize=KEPT_FIELDS)(self._sampled)

    @property
    def end_s(self) -> float:
        """Time after which it is still [s]."""
        return float(self._times[-1])

    def vertices(self, time_s: float) -> tuple[Points, Points]:
        """The mesh's vertices [m] and their velocities [m/s] at a time [s], (n, 3) each."""
        return self._vertices.at(time_s)

    def speed(self, time_s: float) -> float:
        """Largest speed of its points [m/s] between the samples before and after a time [s]; 0 where it is still."""
        if time_s < self._times[0] or time_s >= self._times[-1]:
            return 0.0
        return float(self._speeds[int(np.searchsorted(self._times, time_s, side="right")) - 1])

    @cached_property
    def widest(self) -> int:
        """Number of the sample in which its surface is largest: points spread there are nowhere too far apart."""
        areas = [
            np.linalg.norm(TriangleMesh(each.astype(np.float64), self.faces).area_vectors, axis=1).sum()
            for each in self._points
        ]
        return int(np.argmax(areas))

    def solid(self, number: int) -> MeshSolid:
        """The solid of a sample."""
        return MeshSolid(TriangleMesh(self._points[number].astype(np.float64), self.faces))

    def attach(self, points: Points, number: int = 0) -> Attachment:
        """Points [m], (m, 3), fixed to the nearest triangles of a sample."""
        vertices = self._points[number].astype(np.float64)
        faces, weights, nearest = _nearest(vertices, self.faces, points)
        offsets = np.einsum("mcx,mx->mc", axes_of(vertices[faces]), points - nearest)
        return Attachment(faces, weights, offsets)

    def track(self, values: Values) -> Track:
        """Values of the vertices (n, 3) [m] of each sample, and how they go on in between."""
        return Track(
            self._times, np.stack([values(each.astype(np.float64)) for each in self._points]), linear=self._linear
        )

    def level_set(self, time_s: float) -> LevelSet:
        """Distances at a time [s]."""
        fields = self.fields(time_s)
        one, two = fields.distances
        return LevelSet(self.origin, self.spacing, one + np.float32(fields.share) * (two - one))

    def velocities(self, points: Points, time_s: float) -> Points:
        """Velocities [m/s] that the surface near points (k, 3) [m] has at a time [s], (k, 3)."""
        fields = self.fields(time_s)
        one, two = fields.velocities
        places = ((points - self.origin) / self.spacing).T
        found = [
            (1.0 - fields.share) * _interpolated(one[..., axis], places)
            + fields.share * _interpolated(two[..., axis], places)
            for axis in range(3)
        ]
        return np.stack(found, axis=1)

    def fields(self, time_s: float) -> Fields:
        """Distances and velocities around a time [s], of the moments between which it is."""
        knots = self._knots
        number = int(np.clip(np.searchsorted(knots, time_s, side="right") - 1, 0, len(knots) - 2))
        share = float(np.clip((time_s - knots[number]) / (knots[number + 1] - knots[number]), 0.0, 1.0))
        one, two = self._field(number), self._field(number + 1)
        return Fields(number, share, (one[0], two[0]), (one[1], two[1]))

    @cached_property
    def origin(self) -> NDArray[np.float64]:
        """Of the grids [m], (3,)."""
        return self.bounds.mean(axis=0) - 0.5 * self.spacing * (np.array(self.shape) - 1)

    @cached_property
    def shape(self) -> tuple[int, int, int]:
        """Nodes of the grids along x, y and z."""
        x, y, z = self._field(0)[0].shape
        return x, y, z

    def _sampled(self, knot: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Distances [m] and velocities [m/s] of the nodes at a knot."""
        vertices, velocities = self.vertices(float(self._knots[knot]))
        level_set = LevelSet.sample(
            _InBox(MeshSolid(TriangleMesh(vertices, self.faces)), self.bounds),
            self.spacing,
            padding=GRID_PADDING * GRID_CELLS * self.spacing,
            exact_within=EXACT_WITHIN * self.spacing,
        )
        distances, origin = level_set.values, level_set.origin
        shape = distances.shape

        def felt(nodes: NDArray[np.integer]) -> NDArray[np.float64]:
            faces, weights, _ = _nearest(vertices, self.faces, origin + self.spacing * nodes)
            return np.einsum("mc,mcx->mx", weights, velocities[faces])

        sparse = [np.arange(0, count + SPARSE - 1, SPARSE) for count in shape]
        coarse = felt(np.stack(np.meshgrid(*sparse, indexing="ij"), axis=-1).reshape(-1, 3))
        coarse = coarse.reshape(*map(len, sparse), 3)
        every = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij")) / SPARSE
        found = np.stack(
            [map_coordinates(coarse[..., axis], every, order=1, mode="nearest") for axis in range(3)], axis=-1
        ).astype(np.float32)
        near = np.abs(distances) <= FELT_WITHIN * self.spacing
        found[near] = felt(np.argwhere(near))
        return distances, found

    def _interval_speeds(self) -> NDArray[np.float64]:
        """Largest speeds between neighbouring samples [m/s], (k - 1,)."""
        speeds = [
            [
                np.linalg.norm(self.vertices(float(start + share * (end - start)))[1], axis=1).max()
                for share in np.arange(LOOKUPS) / LOOKUPS
            ]
            for start, end in zip(self._times[:-1], self._times[1:], strict=True)
        ]
        return np.array(speeds).max(axis=1)

    def _knot_times(self) -> NDArray[np.float64]:
        """Moments at which distances are computed [s]."""
        knots = [self._times[:1]]
        for number, speed in enumerate(self._speeds):
            start, end = self._times[number], self._times[number + 1]
            count = int(np.clip(np.ceil(speed * (end - start) / self.spacing), 1, MOST_KNOTS))
            knots.append(start + (end - start) * np.arange(1, count + 1) / count)
        return np.concatenate(knots)


@dataclass(frozen=True, eq=False)
class _InBox:
    """A solid that is looked at in a larger box than its own."""

    solid: MeshSolid
    bounds: NDArray[np.float64]

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        return self.solid.signed_distance(points)


def _interpolated(values: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = map_coordinates(values, places, output=np.float64, order=1, mode="nearest")
    return found


def _nearest(
    vertices: Points, faces: NDArray[np.int32], points: Points
) -> tuple[NDArray[np.int32], NDArray[np.float64], Points]:
    """Corners of the triangles nearest to points (m, 3), barycentric coordinates there, and the places [m]."""
    import igl

    tree = igl.AABB()
    tree.init(vertices, faces.astype(np.int64))
    _, found, nearest = tree.squared_distance(vertices, faces.astype(np.int64), np.ascontiguousarray(points))
    chosen = faces[found]
    a, b, c = (vertices[chosen[:, corner]] for corner in range(3))
    weights = igl.barycentric_coordinates(np.ascontiguousarray(nearest), a, b, c)
    return chosen, np.nan_to_num(weights, nan=1.0 / 3.0), nearest
