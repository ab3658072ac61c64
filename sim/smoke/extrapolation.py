"""Continue fields a few cells into solids, so that look-ups next to a surface mix in no empty cells.

Each layer of solid cells takes the mean of its neighbours in the layers before (Houston et al. 2003 do the same with
the nearest fluid value). Velocity on faces between two solid cells continues the flow along the surface, so it slips.
"""

import math
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.smoke.grid import SmokeGrid

NO_NEIGHBOUR = -1


@dataclass(frozen=True)
class Band:
    """Places to fill, layer after layer.

    Attributes:
        places: flat indices, (n,) int32.
        neighbours: flat indices of their known neighbours, (n, 6) int32, `NO_NEIGHBOUR` where there is none.
        layer_ends: where each layer ends in `places`.
    """

    places: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    layer_ends: tuple[int, ...]


def build_band(grid: SmokeGrid, known: NDArray[np.bool_], layers: int) -> Band:
    """The unknown places within some layers of the known ones.

    Args:
        grid: whose arrays are filled.
        known: which places have a value, in the shape of cells or of faces across one axis.
        layers: how many cells deep.
    """
    exists = grid.pad(np.ones(known.shape, bool))
    filled = grid.pad(known)
    strides = (grid.padded[1] * grid.padded[2], grid.padded[2], 1)
    shifts = [sign * stride for stride in strides for sign in (-1, 1)]
    rolls = [(sign, axis) for axis in range(3) for sign in (1, -1)]
    places: list[NDArray[np.int32]] = [np.empty(0, np.int32)]
    neighbours: list[NDArray[np.int32]] = [np.empty((0, 6), np.int32)]
    for _ in range(layers):
        beside = np.stack([np.roll(filled, sign, axis) for sign, axis in rolls], axis=-1)
        layer = np.flatnonzero(exists & ~filled & beside.any(axis=-1)).astype(np.int32)
        usable = beside.reshape(-1, 6)[layer]
        places.append(layer)
        neighbours.append(np.where(usable, layer[:, None] + np.array(shifts, np.int32), NO_NEIGHBOUR))
        filled.reshape(-1)[layer] = True
    ends = np.cumsum([len(layer) for layer in places])[1:]
    return Band(np.concatenate(places), np.concatenate(neighbours), tuple(int(end) for end in ends))


@ti.data_oriented
class Extrapolation:
    """Fills the solid cells next to air in the cell and face fields of one grid.

    Args:
        grid: where the fields live.
        velocity: the three face velocities, flat fields.
        cell_fields: density and temperature excess, flat fields.
        reach: how many cells into a solid a look-up may come.
    """

    def __init__(self, grid: SmokeGrid, *, velocity: tuple, cell_fields: tuple, reach: float) -> None:
        layers = math.ceil(reach) + 1
        self._targets = [*velocity, *cell_fields]
        bands = [build_band(grid, _faces_of_air(grid, axis), layers) for axis in range(3)]
        bands += [build_band(grid, ~grid.solid, layers)] * len(cell_fields)
        # Without solids there is nothing to fill, and no field to allocate.
        self._bands = bands if grid.solid.any() else []
        self._places = []
        self._neighbours = []
        for band in self._bands:
            count = max(1, len(band.places))
            self._places.append(ti.field(ti.i32, shape=count))
            self._neighbours.append(ti.field(ti.i32, shape=(count, 6)))
        for band, places, neighbours in zip(self._bands, self._places, self._neighbours, strict=True):
            if len(band.places):
                places.from_numpy(band.places)
                neighbours.from_numpy(band.neighbours)

    def fill(self) -> None:
        """Set the solid cells and faces near air."""
        for number, band in enumerate(self._bands):
            start = 0
            for end in band.layer_ends:
                self._fill_layer(self._targets[number], self._places[number], self._neighbours[number], start, end)
                start = end

    @ti.kernel
    def _fill_layer(
        self, field: ti.template(), places: ti.template(), neighbours: ti.template(), start: ti.i32, end: ti.i32
    ):
        for n in range(start, end):
            total = 0.0
            count = 0.0
            for m in ti.static(range(6)):
                at = neighbours[n, m]
                if at != ti.static(NO_NEIGHBOUR):
                    total += field[at]
                    count += 1.0
            field[places[n]] = total / count


def _faces_of_air(grid: SmokeGrid, axis: int) -> NDArray[np.bool_]:
    """Faces across an axis with air on at least one side; a side of the box has only one."""
    solid = np.moveaxis(grid.solid, axis, 0)
    known = np.ones((solid.shape[0] + 1, *solid.shape[1:]), bool)
    known[1:-1] = ~(solid[1:] & solid[:-1])
    known[0], known[-1] = ~solid[0], ~solid[-1]
    return np.moveaxis(known, 0, axis)
