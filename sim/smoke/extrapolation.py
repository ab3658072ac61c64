"""Continue fields a few cells into solids, so that look-ups next to a surface mix in no empty cells.

Each layer of solid cells takes the mean of its neighbours in the layers before (Houston et al. 2003 do the same with
the nearest fluid value). Velocity on faces between two solid cells continues the flow along the surface, so it slips.
Cells that a solid leaves start with what was continued into them. Cells deeper inside hold no smoke and no heat.
"""

import math

import numpy as np
import taichi as ti

from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.obstacles import Obstacles

KNOWN = 0
"""Layer of what has a value of its own: cells of air, and faces with air on at least one side."""

NOWHERE, DEEP = 254, 255
"""Layers of what is not in the grid, and of what lies deeper in a solid than the last layer."""

FACES_X, FACES_Y, FACES_Z, CELLS = range(4)
"""The byte of a place's word that holds the layer of its three faces and of its cell."""


@ti.data_oriented
class Extrapolation:
    """Fills the solid cells next to air in the cell and face fields of one grid.

    Attributes:
        fields: what it has allocated, four bytes a value.

    Args:
        obstacles: in the grid where the fields live.
        velocity: the three face velocities, flat fields.
        cell_fields: density and temperature excess, flat fields.
        reach: how many cells into a solid a look-up may come.
    """

    def __init__(self, obstacles: Obstacles, *, velocity: tuple, cell_fields: tuple, reach: float) -> None:
        grid = obstacles.grid
        self._obstacles = obstacles
        self._lanes = lane_count()
        self._nx, self._ny, self._nz = grid.cells
        self._size = grid.size
        self._steps = (grid.padded[1] * grid.padded[2], grid.padded[2], 1)
        self._u, self._v, self._w = velocity
        self._density, self._excess = cell_fields
        self._layers = math.ceil(reach) + 1
        # Without solids there is nothing to fill, and no field to allocate.
        self._has_solids = obstacles.moving or bool(grid.solid.any())
        self.fields: list[ti.Field] = []
        if self._has_solids:
            self._words = ti.field(ti.i32, shape=grid.size)
            self.fields.append(self._words)
            self._words.from_numpy(np.full(grid.size, NOWHERE * 0x01010101, np.uint32).view(np.int32))
            self.update()

    def update(self) -> None:
        """Follow the obstacles."""
        if self._has_solids:
            self._find_known()
            for layer in range(1, self._layers + 1):
                self._grow(layer)

    def fill(self) -> None:
        """Set the solid cells and faces near air."""
        if self._has_solids:
            for layer in range(1, self._layers + 1):
                self._fill_layer(layer)
            self._clear_depths()

    @ti.func
    def _layer(self, at: ti.i32, kind: ti.template()):
        return (self._words[at] >> ti.static(8 * kind)) & 255

    @ti.func
    def _is_air(self, i: ti.i32, j: ti.i32, k: ti.i32):
        inside = 0 < i <= self._nx and 0 < j <= self._ny and 0 < k <= self._nz
        at = i * self._steps[0] + j * self._steps[1] + k
        return int(inside and not self._obstacles.is_solid(at))

    @ti.kernel
    def _find_known(self):
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            for n in range(lane_items(self._nz + 1, lane)):
                k = lane_place(n, lane)
                in_x, in_y, in_z = int(i <= self._nx), int(j <= self._ny), int(k <= self._nz)
                exists = ti.Vector([in_y * in_z, in_x * in_z, in_x * in_y, in_x * in_y * in_z])
                here = self._is_air(i, j, k)
                known = ti.Vector([here, here, here, here])
                known[0] += self._is_air(i - 1, j, k)
                known[1] += self._is_air(i, j - 1, k)
                known[2] += self._is_air(i, j, k - 1)
                word = 0
                for kind in ti.static(range(4)):
                    layer = ti.select(exists[kind] == 0, NOWHERE, ti.select(known[kind] > 0, KNOWN, DEEP))
                    word |= layer << ti.static(8 * kind)
                self._words[i * self._steps[0] + j * self._steps[1] + k] = word

    @ti.kernel
    def _grow(self, layer: ti.i32):
        """Deep places beside those of the layers before become this layer.

        Other threads may see a word before or after its change: neither is in a layer before.
        """
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            for n in range(lane_items(self._nz + 1, lane)):
                k = lane_place(n, lane)
                at = i * self._steps[0] + j * self._steps[1] + k
                word = self._words[at]
                for kind in ti.static(range(4)):
                    if self._layer(at, kind) == DEEP:
                        beside = DEEP
                        for step in ti.static(self._steps):
                            beside = ti.min(beside, self._layer(at - step, kind), self._layer(at + step, kind))
                        if beside < layer:
                            word += (layer - DEEP) << ti.static(8 * kind)
                self._words[at] = word

    @ti.kernel
    def _fill_layer(self, layer: ti.i32):
        for at in range(self._steps[0], self._size - self._steps[0]):
            if self._words[at] != KNOWN:
                self._fill_place(self._u, FACES_X, at, layer)
                self._fill_place(self._v, FACES_Y, at, layer)
                self._fill_place(self._w, FACES_Z, at, layer)
                self._fill_place(self._density, CELLS, at, layer)
                self._fill_place(self._excess, CELLS, at, layer)

    @ti.func
    def _fill_place(self, field: ti.template(), kind: ti.template(), at: ti.i32, layer: ti.i32):
        if self._layer(at, kind) == layer:
            total = 0.0
            count = 0.0
            for step in ti.static(self._steps):
                for neighbour in ti.static((-step, step)):
                    if self._layer(at + neighbour, kind) < layer:
                        total += field[at + neighbour]
                        count += 1.0
            field[at] = total / count

    @ti.kernel
    def _clear_depths(self):
        for at in range(self._size):
            if self._layer(at, CELLS) == DEEP:
                self._density[at] = 0.0
                self._excess[at] = 0.0
