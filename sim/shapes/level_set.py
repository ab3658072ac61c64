"""A signed distance sampled on a grid, for the places that ask for it millions of times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from sim.shapes.solid import HasSignedDistance, Points, ShapeError

_QUERY_POINTS = 2**20
_LARGEST_GRID = 2**29
_COARSEST_CELLS = 32  # grids of so few cells along their longest edge are sampled at every node


@dataclass(frozen=True, eq=False)
class LevelSet:
    """Signed distances at the nodes of a cubic grid, interpolated trilinearly.

    Accuracy inside the grid: below spacing²/(4 R) where the surface has radius of curvature R and no medial axis
    crosses the cell, at most 0.87 spacings (half a cell's diagonal) beside edges and medial axes. Outside of the grid
    the distance is that of the nearest grid point plus the way to it: an upper bound.
    """

    origin: NDArray[np.float64]  # position of node (0, 0, 0) [m], (3,)
    spacing: float  # edge of a cell [m]
    values: NDArray[np.float32]  # distances [m], negative inside, (nx, ny, nz), float32

    @classmethod
    def sample(
        cls, solid: HasSignedDistance, spacing: float, *, padding: float | None = None, exact_within: float = np.inf
    ) -> LevelSet:
        """Sample a solid's exact distance in cells with edges of `spacing` [m].

        Args:
            solid: what to sample.
            spacing: edge of a cell [m].
            padding: how far the grid reaches past the solid's bounds [m]; two cells if omitted.
            exact_within: farther from the surface than this [m] distances are those of a grid of twice the spacing,
                and so on, within 0.87 of its spacings; so the cost goes with the surface, not with the volume.

        Raises:
            ShapeError: the grid would take more than 2 GiB.
        """
        margin = 2.0 * spacing if padding is None else padding
        lower, upper = solid.bounds
        counts = np.ceil((upper - lower + 2.0 * margin) / spacing).astype(np.int64) + 1
        if np.prod(counts.astype(np.float64)) > _LARGEST_GRID:
            raise ShapeError(
                f"a distance grid of {' x '.join(map(str, counts))} nodes at a spacing of {spacing:g} m is too large; "
                "use a larger spacing"
            )
        origin = 0.5 * (lower + upper) - 0.5 * spacing * (counts - 1)
        coarse = None
        if np.isfinite(exact_within) and counts.max() > _COARSEST_CELLS:
            coarse = cls.sample(solid, 2.0 * spacing, padding=margin, exact_within=exact_within)
        x, y, z = (start + spacing * np.arange(count) for start, count in zip(origin, counts, strict=True))
        values = np.empty(tuple(counts), dtype=np.float32)
        layers = max(1, _QUERY_POINTS // (len(y) * len(z)))
        for start in range(0, len(x), layers):
            stop = min(start + layers, len(x))
            points = np.stack(np.meshgrid(x[start:stop], y, z, indexing="ij"), axis=-1).reshape(-1, 3)
            distance = solid.signed_distance(points) if coarse is None else coarse._refined(solid, points, exact_within)
            values[start:stop] = distance.reshape(stop - start, len(y), len(z))
        return cls(origin, spacing, values)

    def _refined(self, solid: HasSignedDistance, points: Points, exact_within: float) -> NDArray[np.float64]:
        """Distances [m] of points (n, 3): the solid's own near its surface, else those of this grid.

        Interpolation errs by a cell's diagonal at most, so no point within `exact_within` is missed, no sign is wrong.
        """
        distance = self.signed_distance(points)
        near = np.abs(distance) <= exact_within + np.sqrt(3.0) * self.spacing
        distance[near] = solid.signed_distance(points[near])
        return distance

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of the grid [m], (2, 3)."""
        return np.stack([self.origin, self.origin + self.spacing * (np.array(self.values.shape) - 1)])

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,), of positions (n, 3)."""
        lower, upper = self.bounds
        nearest = np.clip(points, lower, upper)
        inside_grid = map_coordinates(
            self.values, ((nearest - lower) / self.spacing).T, output=np.float64, order=1, mode="nearest"
        )
        return inside_grid + np.linalg.norm(points - nearest, axis=1)

    def gradient(self, points: Points) -> NDArray[np.float64]:
        """Gradient of the distance [-], (n, 3): central differences over one cell, not normalized."""
        steps = 0.5 * self.spacing * np.eye(3)
        columns = [self.signed_distance(points + step) - self.signed_distance(points - step) for step in steps]
        return np.stack(columns, axis=1) / self.spacing
