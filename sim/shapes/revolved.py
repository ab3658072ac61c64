"""Bodies of revolution: a profile that turns around z, such as a glass, a bowl or a vase."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.parameters import RevolvedShape
from sim.shapes.primitives import axial_edge, segments_of
from sim.shapes.solid import Points, RestShape, ShapeError, TriangleMesh
from sim.shapes.tessellation import revolve, revolve_ring, subdivide_polyline

Distances = NDArray[np.float64]
Profile = NDArray[np.float64]

_POINTS_AT_ONCE = 20_000  # whose distances to all segments are held in memory together


@dataclass(frozen=True, eq=False)
class Revolved(RestShape):
    """A region of the half plane of radius and height, turned around z, its bounding box centred on the origin.

    Distances are exact: the nearest point of a solid of revolution lies in the half plane of the point.

    Attributes:
        profile: corners (radius, z) of the region's outline [m], (n, 2), counter-clockwise; from the axis to the axis,
            or a closed ring if it stays off the axis.
    """

    profile: Profile

    @cached_property
    def _meets_axis(self) -> bool:
        return bool(self.profile[0, 0] == 0.0)

    @cached_property
    def segments(self) -> tuple[Profile, Profile]:
        """Starts and ends of the segments that turn into surface, (m, 2) each; what lies on the axis does not."""
        if self._meets_axis:
            return self.profile[:-1], self.profile[1:]
        return self.profile, np.roll(self.profile, -1, axis=0)

    @property
    def volume(self) -> float:
        """Volume of the frustums under the outline [m³]; exact for the round body."""
        (r, z), (s, w) = (each.T for each in self.segments)
        return float(np.pi / 3.0 * np.sum((w - z) * (r * r + r * s + s * s)))

    def support(self, directions: Points) -> Distances:
        """Largest x·d over the body [m]: on the circle of a corner."""
        r, z = self.profile.T
        across = np.hypot(directions[:, 0], directions[:, 1])
        return (across[:, None] * r + directions[:, 2:] * z).max(axis=1)

    def signed_distance(self, points: Points) -> Distances:
        """Exact distance [m], negative inside."""
        plane = np.stack([np.hypot(points[:, 0], points[:, 1]), points[:, 2]], axis=1)
        parts = [self._in_plane(plane[k : k + _POINTS_AT_ONCE]) for k in range(0, len(plane), _POINTS_AT_ONCE)]
        return np.concatenate(parts) if parts else np.empty(0)

    def _in_plane(self, p: Profile) -> Distances:
        """Distance to the nearest segment, negative where a ray outwards crosses an odd number of segments."""
        start, end = self.segments
        along = end - start
        offset = p[:, None] - start
        share = np.clip((offset * along).sum(axis=2) / (along * along).sum(axis=1), 0.0, 1.0)
        nearest = np.linalg.norm(offset - share[:, :, None] * along, axis=2).min(axis=1)
        passes = (start[:, 1] > p[:, 1:]) != (end[:, 1] > p[:, 1:])
        rise = np.where(along[:, 1] == 0.0, 1.0, along[:, 1])  # a level segment is never passed
        crossing = start[:, 0] + (p[:, 1:] - start[:, 1]) / rise * along[:, 0]
        inside = np.count_nonzero(passes & (crossing > p[:, :1]), axis=1) % 2 == 1
        return np.where(inside, -nearest, nearest)

    def surface_mesh(self, max_edge: float | None) -> TriangleMesh:
        """The outline, turned."""
        segments = segments_of(float(self.profile[:, 0].max()), max_edge)
        if self._meets_axis:
            return revolve(subdivide_polyline(self.profile, axial_edge(max_edge)), segments)
        closed = np.concatenate([self.profile, self.profile[:1]])
        return revolve_ring(subdivide_polyline(closed, axial_edge(max_edge))[:-1], segments)


def build_revolved(shape: RevolvedShape) -> Revolved:
    """The body of a profile.

    Raises:
        ShapeError: the outline is no simple region: it crosses itself, is flat, or meets the axis between its ends.
    """
    outline = np.asarray(shape.profile, dtype=np.float64)
    repeats = np.all(outline == np.roll(outline, -1, axis=0), axis=1)
    if repeats.any():
        raise ShapeError(f"shape.profile: point {int(np.argmax(repeats)) + 1} is there twice in a row; leave one out")
    on_axis = outline[:, 0] == 0.0
    if on_axis[1:-1].any():
        place = int(np.argmax(on_axis[1:-1])) + 2
        raise ShapeError(
            f"shape.profile: point {place} of {len(outline)} is on the axis, where only the first and the last may be; "
            "begin there"
        )
    if on_axis[0] != on_axis[-1]:
        where = "last" if on_axis[0] else "first"
        raise ShapeError(
            f"shape.profile: one end is on the axis, and the {where} point is not: give it radius 0 for a body that "
            "reaches the axis, or both ends a radius for a ring"
        )
    if crossing := _first_crossing(outline):
        raise ShapeError(
            f"shape.profile: the outline crosses itself between points {crossing[0]} and {crossing[0] + 1} and after "
            f"point {crossing[1]}; go once around the region"
        )
    if _area(outline) < 0.0:
        outline = outline[::-1]
    width, height = outline[:, 0].max(), np.ptp(outline[:, 1])
    if _area(outline) <= 1.0e-9 * width * height:
        raise ShapeError("shape.profile: encloses no area; give the wall a thickness")
    return Revolved(outline - [0.0, 0.5 * (outline[:, 1].min() + outline[:, 1].max())])


def _area(outline: Profile) -> float:
    """Area of a region [m²], negative if its outline goes clockwise."""
    r, z = outline.T
    return float(0.5 * np.sum(r * np.roll(z, -1) - np.roll(r, -1) * z))


def _first_crossing(outline: Profile) -> tuple[int, int] | None:
    """Numbers from 1 of the first points of two sides that cross or touch; None for a simple outline."""
    count = len(outline)
    sides = [(outline[k], outline[(k + 1) % count]) for k in range(count)]
    for i, j in combinations(range(count), 2):
        if j - i in (1, count - 1):
            continue
        (a, b), (c, d) = sides[i], sides[j]
        if _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0:
            low, high = np.minimum(a, b), np.maximum(a, b)
            if np.all(np.maximum(c, d) >= low) and np.all(np.minimum(c, d) <= high):
                return i + 1, j + 1
    return None


def _turn(a: Profile, b: Profile, c: Profile) -> float:
    """Twice the area of a triangle, positive if it goes counter-clockwise."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
