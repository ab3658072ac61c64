"""The staggered grid of a smoke: where its values live, which cells are solid and which faces are open.

Every array is stored flat with one layer of ghost cells around it, C order, so that a value of cell (i, j, k),
counted from 1, stands at index (i * (ny + 2) + j) * (nz + 2) + k. A face has the index of the cell on its upper side:
`u_face_x` at (i, j, k) lies between the cells (i - 1, j, k) and (i, j, k), for i = 1 .. nx + 1. Ghosts make every
stencil the same everywhere; which face lets air pass is decided by its conductance alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.core.domain import DomainParameters, Face
from sim.shapes.solid import HasSignedDistance
from sim.smoke.parameters import WHOLE, SmokeParameters

Index3 = tuple[int, int, int]

CENTRE = (0.5, 0.5, 0.5)  # of a cell, in cells off its lower corner


@dataclass(frozen=True)
class SmokeGrid:
    """A box of cubic cells, its open sides and the solid cells in it.

    Solids are voxelized: a cell is solid if its centre lies inside a solid, and a face of a solid cell is closed. The
    surface is thus a staircase, wrong by up to half a cell; flow along it slips.
    """

    origin: tuple[float, float, float]  # lower corner [m]
    cell_size: float  # edge of a cell [m]
    cells: Index3  # how many cells along x, y, z
    open_faces: frozenset[Face]  # sides of the box that air passes freely; the others are walls
    solid: NDArray[np.bool_]  # (nx, ny, nz) bool, which cells are in solids that stand still
    inflow_faces: frozenset[Face] = frozenset()  # where wind comes in at a given speed; walls to the pressure

    @classmethod
    def build(
        cls, parameters: SmokeParameters, domain: DomainParameters, solids: Sequence[HasSignedDistance] = ()
    ) -> SmokeGrid:
        """The grid of a smoke: its own box, or the domain's where it names none.

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
        empty = cls.of_box(parameters, domain)
        if not solids:
            return empty
        masks = [empty.cells_inside(region) for region in solids]
        for region, mask in zip(solids, masks, strict=True):
            if not mask.any() and empty.misses(region):
                thinnest = float(np.ptp(region.bounds, axis=0).min())
                raise ValueError(
                    f'smoke "{parameters.name}": an obstacle {thinnest:.3g} m thin falls between its cells of '
                    f"{parameters.cell_size:g} m, and would not be there; use a smaller cell_size or a thicker body"
                )
        solid = np.any(masks, axis=0)
        if solid.all():
            raise ValueError(f'smoke "{parameters.name}": solids fill its whole box; there is no air to move')
        return replace(empty, solid=solid)

    @classmethod
    def of_box(cls, parameters: SmokeParameters, domain: DomainParameters) -> SmokeGrid:
        """The cells of a smoke's box, of which none is solid; the box must not be empty."""
        cells, inflow = parameters.cell_counts(domain), frozenset(parameters.windward_faces)
        is_open, lower = frozenset(parameters.open_faces) - inflow, parameters.min or domain.min
        return cls(lower, parameters.cell_size, cells, is_open, np.zeros(cells, bool), inflow)

    def misses(self, region: HasSignedDistance) -> bool:
        """Whether a region that reaches into the box is thinner than a cell, and holds no centre of one.

        On a closed side one counts from the first layer of centres on: below that the side is there in its place.
        """
        lower, upper = region.bounds
        from_side = [[WHOLE if self.lets_in(axis, side) else 0.5 for axis in range(3)] for side in (0, 1)]
        low, high = self.cell_size * np.asarray(from_side)
        reaches_in = np.all((lower < np.asarray(self.upper) - high) & (upper > np.asarray(self.origin) + low))
        is_thin = np.min(upper - lower) < self.cell_size
        return bool(reaches_in and is_thin and not self._near(region, self.cells, CENTRE)[1].any())

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
        number, count = ndimage.label(~self.solid)
        is_open = np.zeros(count + 1, bool)
        is_open[0] = True  # solids
        for axis, side in self.open_sides:
            is_open[np.moveaxis(number, axis, 0)[-side]] = True
        return [
            face
            for face in sorted(self.inflow_faces)
            if not is_open[np.moveaxis(number, "xyz".index(face[0]), 0)[0 if face[1] == "-" else -1]].all()
        ]

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

    def cells_inside(self, region: HasSignedDistance) -> NDArray[np.bool_]:
        """Cells whose centre lies in a region, (nx, ny, nz)."""
        return self._inside(region, self.cells, CENTRE)

    def faces_inside(self, region: HasSignedDistance, axis: int) -> NDArray[np.bool_]:
        """Faces whose centre lies in a region, `face_shape(axis)`."""
        return self._inside(region, self.face_shape(axis), _face_offset(axis))

    @cached_property
    def open_area(self) -> tuple[NDArray[np.bool_], ...]:
        """Which faces air passes, by axis, `face_shape(axis)`."""
        return tuple(self._open_area(axis) for axis in range(3))

    def pad(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """Cell or face values with their ghosts, `padded`, zero where there were none."""
        padded = np.zeros(self.padded, values.dtype)
        padded[tuple(slice(1, 1 + n) for n in values.shape)] = values
        return padded

    def trim(self, values: NDArray[np.generic], shape: Index3) -> NDArray[np.generic]:
        """The inner part, of a given shape, of a flat or padded array."""
        return values.reshape(self.padded)[tuple(slice(1, 1 + n) for n in shape)]

    def _axes(self, shape: Index3, offset: Sequence[float]) -> list[NDArray[np.float64]]:
        """Positions [m] along x, y and z of places that are `offset` cells off the lower corners."""
        return [
            low + (np.arange(n) + shift) * self.cell_size
            for low, n, shift in zip(self.origin, shape, offset, strict=True)
        ]

    def _inside(self, region: HasSignedDistance, shape: Index3, offset: Sequence[float]) -> NDArray[np.bool_]:
        """Which places lie inside a region."""
        inside = np.zeros(shape, bool)
        spans, near = self._near(region, shape, offset)
        inside[spans] = near
        return inside

    def _near(
        self, region: HasSignedDistance, shape: Index3, offset: Sequence[float]
    ) -> tuple[tuple[slice, ...], NDArray[np.bool_]]:
        """The places within a region's bounds, and which of them lie inside: distances are dear for meshes."""
        axes = self._axes(shape, offset)
        lower, upper = region.bounds
        spans = tuple(
            slice(int(np.searchsorted(axis, low)), int(np.searchsorted(axis, high, "right")))
            for axis, low, high in zip(axes, lower, upper, strict=True)
        )
        near = [axis[span] for axis, span in zip(axes, spans, strict=True)]
        counts = tuple(map(len, near))
        if 0 in counts:
            return spans, np.zeros(counts, bool)
        inside: NDArray[np.bool_] = region.signed_distance(_points(near)) < 0.0
        return spans, inside.reshape(counts)

    def _open_area(self, axis: int) -> NDArray[np.bool_]:
        air = np.moveaxis(~self.solid, axis, 0)
        area = np.zeros((air.shape[0] + 1, *air.shape[1:]), bool)
        area[1:-1] = air[1:] & air[:-1]
        area[0] = air[0] & self.is_open(axis, 0)
        area[-1] = air[-1] & self.is_open(axis, 1)
        return np.moveaxis(area, 0, axis)


def _face_offset(axis: int) -> tuple[float, ...]:
    """Where the centres of the faces across an axis lie, in cells off the lower corners of their cells."""
    return tuple(0.0 if a == axis else 0.5 for a in range(3))


def _points(axes: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Every combination of positions along x, y and z, (n, 3), in C order."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
