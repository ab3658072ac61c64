"""Which cells and faces of a grid a shape passes over."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.paths import Motion
from sim.shapes.level_set import LevelSet
from sim.shapes.parameters import BunnyShape, DuckShape, MeshShape, Placement
from sim.shapes.placement import PlacedSolid, build_solid
from sim.smoke.grid import Index3, SmokeGrid

COSTLY_SHAPES = (DuckShape, BunnyShape, MeshShape)  # their distances take long, and so are looked up
LOOKUPS_PER_CELL = 2.0  # nodes of such a table along the edge of a cell
ROUND_OFF = 1.0e-9  # of ways and distances, in parts of them and in cells, at most
CELLS = 3  # stands for cells where the axis of faces is asked for


@dataclass(frozen=True)
class Swept:
    """The places that a shape passed over."""

    indices: NDArray[np.int32]  # of the places in flat arrays, ascending, (n,)
    places: NDArray[np.float64]  # their positions [m], (n, 3)
    poses: NDArray[np.int64]  # which of the poses was the last to cover each, (n,)


class SweptShape:
    """A shape that moves over a grid; a place is covered if it lies inside, as for shapes that stay.

    Attributes:
        reach: largest distance of its points from its origin [m].
    """

    def __init__(self, placement: Placement, grid: SmokeGrid) -> None:
        """Build the shape; where it stands does not matter.

        Raises:
            ShapeError: it cannot be built.
        """
        placed = build_solid(placement)
        self._grid = grid
        self._solid = PlacedSolid(placed.shape, placed.scale, np.eye(3), np.zeros(3))
        self.reach = float(np.linalg.norm(np.abs(self._solid.bounds).max(axis=0)))
        self._distance = self._solid.signed_distance
        self._is_exact = not isinstance(placement.shape, COSTLY_SHAPES)
        if not self._is_exact:
            spacing = grid.cell_size / LOOKUPS_PER_CELL
            self._distance = LevelSet.sample(self._solid, spacing, exact_within=2.0 * spacing).signed_distance

    def covered(self, poses: Sequence[Motion], axis: int) -> Swept:
        """The faces across an axis, or the `CELLS`, that it covers in one of the poses at least."""
        grid = self._grid
        shape: Index3 = grid.cells if axis == CELLS else grid.face_shape(axis)
        offset = np.array([0.0 if a == axis else 0.5 for a in range(3)])
        windows = [self._window(pose, shape, offset) for pose in poses]
        first = np.min([low for low, _ in windows], axis=0)
        size = np.maximum(np.max([high for _, high in windows], axis=0) - first, 0)
        last = np.full(size, -1, np.int64)
        # Backwards, so that what a later pose covers need not be looked at again. No more need what is farther off
        # than the shape has gone since it was looked at.
        free_until = np.full(size, -np.inf)
        ways = self._ways_to_the_last(poses)
        for number in reversed(range(len(poses))):
            pose, (low, high) = poses[number], windows[number]
            window = tuple(map(slice, low - first, high - first))
            asked = np.nonzero((last[window] < 0) & (free_until[window] <= ways[number]))
            if len(asked[0]) == 0:
                continue
            places = self._positions(np.stack(asked, axis=-1) + low, offset)
            own = rotation.rotated(rotation.conjugate(pose.orientation), places - pose.position)
            distance = self._distance(own)
            last[window][asked] = np.where(distance < 0.0, number, -1)
            if self._is_exact:
                free_until[window][asked] = ways[number] + distance
        found = np.argwhere(last >= 0) + first
        padded = grid.padded
        indices = ((found[:, 0] + 1) * padded[1] + found[:, 1] + 1) * padded[2] + found[:, 2] + 1
        return Swept(indices.astype(np.int32), self._positions(found, offset), last[last >= 0])

    def _ways_to_the_last(self, poses: Sequence[Motion]) -> NDArray[np.float64]:
        """Bound of how far points of the shape go from each pose to the last one [m], (n,)."""
        origins = np.stack([pose.position for pose in poses])
        turned = np.stack([rotation.matrices(pose.orientation) for pose in poses])
        steps = np.linalg.norm(np.diff(origins, axis=0), axis=1)
        turns = np.linalg.norm(np.diff(turned, axis=0), axis=(1, 2))
        ways = (1.0 + ROUND_OFF) * (steps + self.reach * turns) + ROUND_OFF * self._grid.cell_size
        return np.append(np.cumsum(ways[::-1])[::-1], 0.0)

    def _window(
        self, pose: Motion, shape: Index3, offset: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The first place within the shape's box along each axis, from 0, and the first one after it."""
        solid = PlacedSolid(self._solid.shape, self._solid.scale, rotation.matrices(pose.orientation), pose.position)
        lower, upper = (solid.bounds - self._grid.origin) / self._grid.cell_size - offset
        low = np.clip(np.ceil(lower), 0, shape).astype(np.int64)
        return low, np.clip(np.floor(upper) + 1, low, shape).astype(np.int64)

    def _positions(self, places: NDArray[np.int64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
        positions: NDArray[np.float64] = np.asarray(self._grid.origin) + (places + offset) * self._grid.cell_size
        return positions
