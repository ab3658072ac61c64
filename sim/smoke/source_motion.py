"""Where sources are, along keyframes or on a rigid body, and how much of cells and faces they pass over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.paths import KeyframePath, Motion, path_through
from sim.shapes.level_set import LevelSet
from sim.shapes.parameters import BunnyShape, DuckShape, MeshShape, Placement
from sim.shapes.placement import PlacedSolid, build_solid
from sim.smoke.grid import Index3, SmokeGrid

if TYPE_CHECKING:
    from sim.smoke.parameters import SmokeSourceParameters

Array = NDArray[np.float64]

COSTLY_SHAPES = (DuckShape, BunnyShape, MeshShape)  # their distances take long, and so are looked up
LOOKUPS_PER_CELL = 4.0  # nodes of such a table along the edge of a cell
ROUND_OFF = 1.0e-9  # of ways and distances, in parts of them and in cells, at most
ROUNDING = 2.0**-16  # of covered parts, so that what is symmetric stays so
AHEAD_S = 1.0e-3  # of a body's way, by which it is told how it goes on [s]
PARTS = 4  # points along the edge of a cell at which it is asked how much of it is covered
CELLS = 3  # stands for cells where the axis of faces is asked for


class SourceMotion(Protocol):
    """How a source moves."""

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """Its motion from a time to another [s] in a step of the smoke, so often that it leaves no gap; once at least.

        None of its points goes farther than a spacing [m] from one pose to the next.
        """

    def speed(self) -> float:
        """Bound of the speed of its points in the coming step [m/s]."""


class PathMotion:
    """Along a path that is known ahead."""

    def __init__(self, path: KeyframePath, reach: float) -> None:
        """Take the path of the shape's origin, from which its points are no farther than the reach [m]."""
        self._path, self._way, self._speed = path, path.arc_length(reach), path.largest_speed(reach)

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """See `SourceMotion`."""
        begun, ended = np.interp([begin_s, end_s], self._way.times, self._way.lengths)
        return [self._path.at(time) for time in _times(begin_s, end_s, float(ended - begun), spacing)]

    def speed(self) -> float:
        """The largest of the whole path [m/s]."""
        return self._speed


class BodyMotion:
    """Fixed to a rigid body, which someone else tells the motion of, step by step.

    Between the two ends of a step the body is taken to go straight and to turn about one axis.
    """

    def __init__(self, offset: Array, orientation: Array, reach: float) -> None:
        """Take the source's origin from that of the body's shape [m], (3,), its turn, (4,), and its reach [m]."""
        self._offset, self._orientation = offset, orientation
        self._arm = reach + float(np.linalg.norm(offset))
        self.go_on(Motion(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3)), 0.0)

    def go_on(self, body: Motion, time_s: float) -> None:
        """The body is here at a time [s], between two steps; until it is told otherwise it goes on as it moves."""
        turned = rotation.product(rotation.exponential(AHEAD_S * body.angular_velocity), body.orientation)
        ahead = body._replace(position=body.position + AHEAD_S * body.velocity, orientation=turned)
        self._times, self._begin, self._end, self._here = (time_s, time_s + AHEAD_S), body, ahead, body

    def carry(self, body: Motion, begin_s: float, end_s: float) -> None:
        """In the coming step of the smoke, from one time to another [s], the body gets here."""
        self._times, self._begin, self._end, self._here = (begin_s, end_s), self._here, body, body

    def poses(self, begin_s: float, end_s: float, *, spacing: float) -> list[Motion]:
        """See `SourceMotion`."""
        (leg_begin_s, leg_end_s), begin, end = self._times, self._begin, self._end
        duration = leg_end_s - leg_begin_s
        turn = rotation.logarithm(rotation.product(end.orientation, rotation.conjugate(begin.orientation)))
        step = end.position - begin.position
        length = (float(np.linalg.norm(step)) + self._arm * float(np.linalg.norm(turn))) * (end_s - begin_s) / duration
        poses = []
        for time in _times(begin_s, end_s, length, spacing):
            part = (time - leg_begin_s) / duration
            body = Motion(
                begin.position + part * step,
                rotation.product(rotation.exponential(part * turn), begin.orientation),
                begin.velocity + part * (end.velocity - begin.velocity),
                begin.angular_velocity + part * (end.angular_velocity - begin.angular_velocity),
            )
            poses.append(self._on(body))
        return poses

    def speed(self) -> float:
        """Where the body was last [m/s]."""
        body = self._here
        return float(np.linalg.norm(body.velocity)) + self._arm * float(np.linalg.norm(body.angular_velocity))

    def _on(self, body: Motion) -> Motion:
        arm = rotation.rotated(body.orientation, self._offset)
        return Motion(
            body.position + arm,
            rotation.product(body.orientation, self._orientation),
            body.velocity + np.cross(body.angular_velocity, arm),
            body.angular_velocity,
        )


def motion_of(source: SmokeSourceParameters, reach: float) -> SourceMotion | None:
    """How a source moves, with points up to `reach` [m] from its origin; None if it stays where it is."""
    if source.follow is not None:
        return BodyMotion(np.asarray(source.position, float), rotation.from_degrees(source.rotation_deg), reach)
    if not source.keyframe:
        return None
    return PathMotion(path_through(source.keyframe, linear=source.interpolation == "linear"), reach)


def _times(begin_s: float, end_s: float, length: float, spacing: float) -> list[float]:
    """Times from beginning to end [s] so many that a way of a length [m] is cut into parts of a spacing [m]."""
    if length <= 0.0 or end_s <= begin_s:
        return [end_s]
    count = max(1, math.ceil(length / spacing))
    return [begin_s + (end_s - begin_s) * number / count for number in range(count + 1)]


@dataclass(frozen=True)
class Swept:
    """The places that a shape passed over."""

    indices: NDArray[np.int32]  # of the places in flat arrays, ascending, (n,)
    shares: NDArray[np.float64]  # parts of the cells around them that it covered [-], above 0, (n,)
    places: NDArray[np.float64]  # their positions [m], (n, 3)
    poses: NDArray[np.int64]  # which of the poses was the last to touch each, (n,)


class SweptShape:
    """A shape that stays in a grid or moves over it, which covers parts of cells, and of the cells around faces.

    A part is found from signed distances d at `PARTS`³ points of a cell, s apart, as the mean of 1/2 - d/s between 0
    and 1. A ball of radius R is larger than it is by (s/R)²/4: by 0.7 % at one and a half cells of radius.

    Attributes:
        reach: largest distance of its points from its origin [m].
    """

    def __init__(self, placement: Placement, cell_size: float) -> None:
        """Build the shape for grids of this cell size [m]; where it stands does not matter.

        Raises:
            ShapeError: it cannot be built.
        """
        placed = build_solid(placement)
        self._cell_size = cell_size
        self._solid = PlacedSolid(placed.shape, placed.scale, np.eye(3), np.zeros(3))
        self.reach = float(np.linalg.norm(np.abs(self._solid.bounds).max(axis=0)))
        self._distance = self._solid.signed_distance
        self._is_exact = not isinstance(placement.shape, COSTLY_SHAPES)
        if not self._is_exact:
            spacing = cell_size / LOOKUPS_PER_CELL
            self._distance = LevelSet.sample(self._solid, spacing, exact_within=2.0 * spacing).signed_distance
        steps = (np.arange(PARTS) + 0.5) / PARTS - 0.5
        points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        self._points = cell_size * points  # about the middle of a cell [m], (PARTS³, 3)
        # Farther from the surface than this a cell is covered whole, or not at all.
        self._margin = cell_size * (0.5 * math.sqrt(3.0) + 0.5 / PARTS)

    def bounds(self, pose: Motion) -> Array:
        """Corners of the box around the shape in a pose [m], (2, 3)."""
        turned = rotation.matrices(pose.orientation)
        return PlacedSolid(self._solid.shape, self._solid.scale, turned, pose.position).bounds

    def covered(self, grid: SmokeGrid, poses: Sequence[Motion], axis: int) -> Swept:
        """The faces of a grid across an axis, or the `CELLS`, that it covers a part of in one of the poses."""
        shape: Index3 = grid.cells if axis == CELLS else grid.face_shape(axis)
        offset = np.array([0.0 if a == axis else 0.5 for a in range(3)])
        windows = [self._window(grid, pose, shape, offset) for pose in poses]
        first = np.min([low for low, _ in windows], axis=0)
        size = np.maximum(np.max([high for _, high in windows], axis=0) - first, 0)
        last, shares = np.full(size, -1, np.int64), np.zeros(size)
        # Cells near the surface have rows: of the least distances of their points, and of when these need be asked.
        rows, count = np.full(size, -1, np.int64), len(self._points)
        nearest, spare = np.empty((0, count)), np.empty((0, count))
        half = 0.5 * grid.cell_size / PARTS
        # Backwards, so that what a later pose covers whole need not be looked at again. No more need what is farther
        # off than the shape has gone since it was looked at.
        free_until = np.full(size, -np.inf)
        ways = self._ways_to_the_last(poses)
        for number in reversed(range(len(poses))):
            pose, (low, high) = poses[number], windows[number]
            window = tuple(map(slice, low - first, high - first))
            asked = np.nonzero((shares[window] < 1.0) & (free_until[window] <= ways[number]))
            if len(asked[0]) == 0:
                continue
            places = _positions(grid, np.stack(asked, axis=-1) + low, offset)
            distance = self._distances(pose, places)
            if self._is_exact:
                free_until[window][asked] = ways[number] + distance - self._margin
            cut = np.abs(distance) <= self._margin
            found = tuple(index[cut] for index in asked)
            row = rows[window][found]
            row[row < 0] = len(nearest) + np.arange((row < 0).sum())
            rows[window][found] = row
            more = max(0, row.max(initial=-1) + 1 - len(nearest))
            nearest = np.concatenate([nearest, np.full((more, count), np.inf)])
            spare = np.concatenate([spare, np.full((more, count), -np.inf)])
            at = np.nonzero((nearest[row] > -half) & (spare[row] <= ways[number]))
            off = self._distances(pose, places[cut][at[0]] + self._points[at[1]])
            at = row[at[0]], at[1]
            nearest[at] = np.minimum(nearest[at], off)
            if self._is_exact:
                spare[at] = ways[number] + off - np.minimum(nearest[at], half)
            part = np.clip(0.5 - nearest[row] / (2.0 * half), 0.0, 1.0).mean(axis=1)
            now = np.where(distance < 0.0, 1.0, 0.0)
            now[cut] = np.round(part / ROUNDING) * ROUNDING
            is_new = (last[window][asked] < 0) & (now > 0.0)
            last[window][tuple(index[is_new] for index in asked)] = number
            shares[window][asked] = np.maximum(shares[window][asked], now)
        indices = np.argwhere(last >= 0) + first
        padded = grid.padded
        flat = ((indices[:, 0] + 1) * padded[1] + indices[:, 1] + 1) * padded[2] + indices[:, 2] + 1
        is_covered = last >= 0
        return Swept(flat.astype(np.int32), shares[is_covered], _positions(grid, indices, offset), last[is_covered])

    def _distances(self, pose: Motion, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distances [m] of positions (n, 3) from the shape in a pose, (n,)."""
        return self._distance((places - pose.position) @ rotation.matrices(pose.orientation))

    def _ways_to_the_last(self, poses: Sequence[Motion]) -> NDArray[np.float64]:
        """Bound of how far points of the shape go from each pose to the last one [m], (n,)."""
        origins = np.stack([pose.position for pose in poses])
        turned = np.stack([rotation.matrices(pose.orientation) for pose in poses])
        steps = np.linalg.norm(np.diff(origins, axis=0), axis=1)
        turns = np.linalg.norm(np.diff(turned, axis=0), axis=(1, 2)) / math.sqrt(2.0)
        ways = (1.0 + ROUND_OFF) * (steps + self.reach * turns) + ROUND_OFF * self._cell_size
        return np.append(np.cumsum(ways[::-1])[::-1], 0.0)

    def _window(
        self, grid: SmokeGrid, pose: Motion, shape: Index3, offset: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The first place along each axis, from 0, that may be covered in part, and the first one after the last."""
        margin = 0.5 + 0.5 / PARTS
        lower, upper = (self.bounds(pose) - grid.origin) / grid.cell_size - offset
        low = np.clip(np.ceil(lower - margin), 0, shape).astype(np.int64)
        return low, np.clip(np.floor(upper + margin) + 1, low, shape).astype(np.int64)


def _positions(grid: SmokeGrid, places: NDArray[np.int64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    positions: NDArray[np.float64] = np.asarray(grid.origin) + (places + offset) * grid.cell_size
    return positions
