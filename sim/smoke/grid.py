"""The staggered grid of a smoke: where its values live, how far its cells are from solids, which faces are open.

Every array is stored flat with one layer of ghost cells around it, C order, so that a value of cell (i, j, k),
counted from 1, stands at index (i * (ny + 2) + j) * (nz + 2) + k. A face has the index of the cell on its upper side:
`u_face_x` at (i, j, k) lies between the cells (i - 1, j, k) and (i, j, k), for i = 1 .. nx + 1. Ghosts make every
stencil the same everywhere; which face lets air pass is decided by its conductance alone. A corner of cells has the
index of the cell of which it is the lowest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sim.core.domain import DomainParameters, Face
from sim.shapes.solid import HasSignedDistance
from sim.smoke.cut_cells import FAR, ROUNDING, is_split
from sim.smoke.parameters import WHOLE, SmokeParameters

Index3 = tuple[int, int, int]

LOWEST, CENTRE = (0.0, 0.0, 0.0), (0.5, 0.5, 0.5)  # corner and centre of a cell, in cells off its lower corner


@dataclass(frozen=True)
class Window:
    """A part of a smoke's box that is computed, whole cells of it."""

    first: Index3  # its lowest cell, counted from that of the box; negative where the box has no end
    cells: Index3  # how many along x, y, z

    @classmethod
    def around(cls, box: NDArray[np.float64], parameters: SmokeParameters, domain: DomainParameters) -> Window:
        """The cells around a box between two corners [m], (2, 3), as far as the smoke can be there."""
        corner, counts = np.asarray(parameters.min or domain.min), parameters.cell_counts(domain)
        limits = np.array(parameters.limits(domain))
        first, last = np.where(np.isinf(limits), limits, [(0, 0, 0), np.subtract(counts, 1)])
        low = np.clip(np.floor((box[0] - corner) / parameters.cell_size) - 1, first, last)
        high = np.clip(np.ceil((box[1] - corner) / parameters.cell_size), low, last)
        a, b, c = (int(n) for n in low)
        x, y, z = (int(n) for n in high - low + 1)
        return cls((a, b, c), (x, y, z))

    def inner_faces(self, box: Index3) -> frozenset[Face]:
        """Its sides that are not sides of a box of so many cells."""
        faces: tuple[tuple[Face, Face], ...] = (("x-", "x+"), ("y-", "y+"), ("z-", "z+"))
        return frozenset(
            face
            for pair, first, n, end in zip(faces, self.first, self.cells, box, strict=True)
            for face, is_inner in zip(pair, (first != 0, first + n != end), strict=True)
            if is_inner
        )


@dataclass(frozen=True)
class SmokeGrid:
    """A box of cubic cells, its open sides and the solids in it that stand still.

    Solids cut cells and their faces (`cut_cells`); flow along them slips.
    """

    origin: tuple[float, float, float]  # lower corner [m]
    cell_size: float  # edge of a cell [m]
    cells: Index3  # how many cells along x, y, z
    open_faces: frozenset[Face]  # sides of the box that air passes freely; the others are walls
    distance: NDArray[np.float32]  # of corners from these solids, (nx + 1, ny + 1, nz + 1), not beyond `FAR` [cells]
    inflow_faces: frozenset[Face] = frozenset()  # where wind comes in at a given speed; walls to the pressure
    first: Index3 = (0, 0, 0)  # its lowest cell, counted from that of the smoke's box (`Window`)

    @classmethod
    def build(
        cls,
        parameters: SmokeParameters,
        domain: DomainParameters,
        solids: Sequence[HasSignedDistance] = (),
        window: Window | None = None,
    ) -> SmokeGrid:
        """The grid of a smoke: its own box, or the domain's where it names none, or a window of that.

        A box that is no whole number of cells long is rounded up, keeping its lower corner.

        Raises:
            ValueError: the box is empty, solids fill it, or its sides cannot take the wind.
        """
        for axis, low, high in zip("xyz", parameters.min or domain.min, parameters.max or domain.max, strict=True):
            if high <= low:
                raise ValueError(
                    f'smoke "{parameters.name}": max must be above min on every axis, '
                    f"got {axis} from {low:g} to {high:g} m"
                )
        if problem := parameters.wind_problem():
            raise ValueError(f'smoke "{parameters.name}": wind {problem}')
        empty = cls.of_box(parameters, domain, window)
        if not solids:
            return empty
        for region in solids:
            if empty.misses(region):
                thinnest = float(np.ptp(region.bounds, axis=0).min())
                raise ValueError(
                    f'smoke "{parameters.name}": an obstacle {thinnest:.3g} m thin falls between its cells of '
                    f"{parameters.cell_size:g} m, and would not be there; use a smaller cell_size or a thicker body"
                )
        grid = empty.with_solids(solids)
        if grid.solid.all():
            raise ValueError(f'smoke "{parameters.name}": solids fill its whole box; there is no air to move')
        return grid

    @classmethod
    def of_box(cls, parameters: SmokeParameters, domain: DomainParameters, window: Window | None = None) -> SmokeGrid:
        """The cells of a smoke's box, or of a window, of which none is solid; the box must not be empty.

        Where a window ends, and the box does not, air passes.
        """
        cells, inflow = parameters.cell_counts(domain), frozenset(parameters.windward_faces)
        is_open, lower = frozenset(parameters.open_faces), parameters.min or domain.min
        if window is not None:
            is_open |= window.inner_faces(cells)
            x, y, z = (low + n * parameters.cell_size for low, n in zip(lower, window.first, strict=True))
            lower, cells = (x, y, z), window.cells
        grid = cls.of_cells(lower, parameters.cell_size, cells, is_open - inflow, inflow)
        return grid if window is None else replace(grid, first=window.first)

    @classmethod
    def of_cells(
        cls,
        origin: tuple[float, float, float],
        cell_size: float,
        cells: Index3,
        open_faces: frozenset[Face],
        inflow_faces: frozenset[Face] = frozenset(),
    ) -> SmokeGrid:
        """A box of so many cells, without solids."""
        corners = tuple(n + 1 for n in cells)
        far = np.broadcast_to(np.float32(FAR), corners)  # which takes no memory
        return cls(origin, cell_size, cells, open_faces, far, inflow_faces)

    def with_solids(self, solids: Sequence[HasSignedDistance]) -> SmokeGrid:
        """The same box with these solids in it as well."""
        distance = self.distance.copy()
        for region in solids:
            # A cell that is cut has a corner inside of the bounds, and none more than an edge beyond.
            spans, near = self._distances(region, distance.shape, LOWEST, margin=self.cell_size * (1.0 + WHOLE))
            scaled = near / self.cell_size
            scaled[np.abs(scaled) < ROUNDING] = 0.0
            distance[spans] = np.minimum(distance[spans], scaled.astype(np.float32))
        return replace(self, distance=distance)

    def with_solids_of(self, others: Sequence[SmokeGrid]) -> SmokeGrid:
        """The same cells with the solids of other windows of the box in them as well."""
        distance = self.distance
        for other in others:
            shift = np.subtract(other.first, self.first)
            low, high = np.maximum(0, shift), np.minimum(distance.shape, shift + other.distance.shape)
            if np.all(low < high):
                distance = distance.copy() if distance is self.distance else distance
                own, theirs = tuple(map(slice, low, high)), tuple(map(slice, low - shift, high - shift))
                distance[own] = np.minimum(distance[own], other.distance[theirs])
        return replace(self, distance=distance)

    def misses(self, region: HasSignedDistance) -> bool:
        """Whether a region that reaches into the box is thinner than a cell, and holds no corner of one."""
        lower, upper = region.bounds
        rounding = WHOLE * self.cell_size
        low, high = np.asarray(self.origin) + rounding, np.asarray(self.upper) - rounding
        is_thin = np.all((lower < high) & (upper > low)) and np.min(upper - lower) < self.cell_size
        return bool(is_thin and not (self._distances(region, self.distance.shape, LOWEST)[1] <= 0.0).any())

    @cached_property
    def has_solids(self) -> bool:
        """Whether any corner lies in a solid."""
        return bool((self.distance <= 0.0).any())

    @cached_property
    def solid(self) -> NDArray[np.bool_]:
        """Cells that hold no air, (nx, ny, nz), but for small ones that no others keep (`cut_cells`)."""
        outside = np.zeros(self.cells, np.int32)
        for corner in range(8):
            outside |= (cell_corners(self.distance, corner) > 0.0).astype(np.int32) << corner
        solid: NDArray[np.bool_] = (outside == 0) | is_split(outside)
        return solid

    @property
    def window(self) -> Window:
        """Which cells of the smoke's box it has."""
        return Window(self.first, self.cells)

    @property
    def padded(self) -> Index3:
        """Shape of every array, ghosts included."""
        nx, ny, nz = self.cells
        return nx + 2, ny + 2, nz + 2

    @property
    def size(self) -> int:
        """Length of every flat array."""
        return math.prod(self.padded)

    @property
    def upper(self) -> tuple[float, float, float]:
        """Upper corner [m]."""
        x, y, z = (low + n * self.cell_size for low, n in zip(self.origin, self.cells, strict=True))
        return x, y, z

    def is_open(self, axis: int, side: int) -> bool:
        """Whether air passes the lower (side 0) or upper (side 1) side of the box along an axis as it likes."""
        return f"{'xyz'[axis]}{'-+'[side]}" in self.open_faces

    @property
    def open_sides(self) -> tuple[tuple[int, int], ...]:
        """Axis and side, 0 or 1, of those that air passes as it likes."""
        return tuple((axis, side) for axis in range(3) for side in (0, 1) if self.is_open(axis, side))

    def lets_in(self, axis: int, side: int) -> bool:
        """Whether air from outside may come in through a side: one that is open, or that wind blows in through."""
        return self.is_open(axis, side) or f"{'xyz'[axis]}{'-+'[side]}" in self.inflow_faces

    def cut_off_faces(self) -> list[Face]:
        """Sides that wind blows in through where static solids shut some air behind them off from every open side."""
        number = self.air_regions()
        is_open = np.zeros(number.max() + 1, bool)
        is_open[0] = True  # solids
        for axis, side in self.open_sides:
            is_open[np.moveaxis(number, axis, 0)[-side]] = True
        return [
            face
            for face in sorted(self.inflow_faces)
            if not is_open[np.moveaxis(number, "xyz".index(face[0]), 0)[0 if face[1] == "-" else -1]].all()
        ]

    def air_regions(self) -> NDArray[np.int64]:
        """Number, from 1, of the region of air that is connected through open faces, (nx, ny, nz); 0 in solid cells."""
        index = np.arange(self.solid.size).reshape(self.cells)
        pairs = []
        for axis in range(3):
            cells, is_open = np.moveaxis(index, axis, 0), np.moveaxis(self.open_area[axis], axis, 0)[1:-1]
            pairs.append(np.stack([cells[:-1][is_open], cells[1:][is_open]]))
        below, above = np.concatenate(pairs, axis=1)
        graph = coo_array((np.ones(len(below), bool), (below, above)), shape=(index.size, index.size))
        number = connected_components(graph, directed=False)[1].reshape(self.cells) + 1
        return np.where(self.solid, 0, number)

    def cell_centres(self) -> NDArray[np.float64]:
        """Positions [m], (nx * ny * nz, 3)."""
        return _points(self._axes(self.cells, CENTRE))

    def face_centres(self, axis: int) -> NDArray[np.float64]:
        """Positions [m] of the faces across an axis, (n, 3), in the order of `face_shape`."""
        return _points(self._axes(self.face_shape(axis), _face_offset(axis)))

    def face_shape(self, axis: int) -> Index3:
        """How many faces across an axis there are along x, y, z."""
        nx, ny, nz = (n + (a == axis) for a, n in enumerate(self.cells))
        return nx, ny, nz

    @cached_property
    def open_area(self) -> tuple[NDArray[np.bool_], ...]:
        """Which faces air passes in part at least, by axis, `face_shape(axis)`."""
        return tuple(self._open_area(axis) for axis in range(3))

    def pad(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Cell or face values with their ghosts, `padded`, zero where there were none."""
        padded = np.zeros(self.padded, values.dtype)
        padded[tuple(slice(1, 1 + n) for n in values.shape)] = values
        return padded

    def trim(self, values: NDArray[np.generic], shape: Index3) -> NDArray[np.generic]:
        """The inner part, of a given shape, of a flat or padded array."""
        return values.reshape(self.padded)[tuple(slice(1, 1 + n) for n in shape)]

    def _axes(self, shape: Sequence[int], offset: Sequence[float]) -> list[NDArray[np.float64]]:
        """Positions [m] along x, y and z of places that are `offset` cells off the lower corners."""
        return [
            low + (np.arange(n) + shift) * self.cell_size
            for low, n, shift in zip(self.origin, shape, offset, strict=True)
        ]

    def _distances(
        self, region: HasSignedDistance, shape: tuple[int, ...], offset: Sequence[float], *, margin: float = 0.0
    ) -> tuple[tuple[slice, ...], NDArray[np.float64]]:
        """The places within a margin [m] of a region's bounds, and their distances [m]: these are dear for meshes."""
        axes = self._axes(shape, offset)
        lower, upper = region.bounds
        spans = tuple(
            slice(int(np.searchsorted(axis, low - margin)), int(np.searchsorted(axis, high + margin, "right")))
            for axis, low, high in zip(axes, lower, upper, strict=True)
        )
        near = [axis[span] for axis, span in zip(axes, spans, strict=True)]
        counts = tuple(map(len, near))
        if 0 in counts:
            return spans, np.zeros(counts)
        distance: NDArray[np.float64] = region.signed_distance(_points(near))
        return spans, distance.reshape(counts)

    def _open_area(self, axis: int) -> NDArray[np.bool_]:
        air = np.moveaxis(~self.solid, axis, 0)
        corners = np.moveaxis(self.distance, axis, 0) > 0.0
        area = corners[:, 1:, 1:] | corners[:, 1:, :-1] | corners[:, :-1, 1:] | corners[:, :-1, :-1]
        area[1:-1] &= air[1:] & air[:-1]
        area[0] &= air[0] & self.is_open(axis, 0)
        area[-1] &= air[-1] & self.is_open(axis, 1)
        return np.moveaxis(area, 0, axis)


def cell_corners(values: NDArray[np.float32], corner: int) -> NDArray[np.float32]:
    """Of each cell the value at one of its corners, 4 dx + 2 dy + dz."""
    shifts = corner >> 2, corner >> 1 & 1, corner & 1
    return values[tuple(slice(shift, n - 1 + shift) for shift, n in zip(shifts, values.shape, strict=True))]


def _face_offset(axis: int) -> tuple[float, ...]:
    """Where the centres of the faces across an axis lie, in cells off the lower corners of their cells."""
    return tuple(0.0 if a == axis else 0.5 for a in range(3))


def _points(axes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Every combination of positions along x, y and z, (n, 3), in C order."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
