"""Continue fields a few cells into solids, so that look-ups next to a surface mix in no empty cells.

Each layer of solid cells takes the mean of its neighbours in the layers before (Houston et al. 2003 do the same with
the nearest fluid value). Velocity on faces between two solid cells continues the flow along the surface, so it slips.
Cells that a solid leaves start with what was continued into them. Cells deeper inside hold no smoke and no heat.
"""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import State
from sim.smoke.lanes import Grid, lane_items, lane_place, row_start
from sim.smoke.obstacles import Obstacles, Solids, is_solid

KNOWN = 0  # layer of what has a value of its own: cells of air, and faces with air on at least one side
NOWHERE, DEEP = 254, 255  # layers of what is not in the grid, and of what lies deeper in a solid than the last layer
FACES_X, FACES_Y, FACES_Z, CELLS = range(4)  # byte of a place's word with the layer of its faces and of its cell


class Extrapolation:
    """Fills the solid cells next to air in the values of one grid.

    Attributes:
        words: the layers of each place, int32; None without solids, where there is nothing to fill.
    """

    def __init__(self, obstacles: Obstacles, state: State, *, reach: float) -> None:
        """Prepare for look-ups that come so many cells into solids."""
        self._obstacles, self._state = obstacles, state
        self._layers = range(1, math.ceil(reach) + 2)
        self.words: ti.Ndarray | None = None
        if obstacles.moving or obstacles.grid.solid.any():
            self.words = ti.ndarray(ti.i32, obstacles.grid.size)
            self.words.from_numpy(np.full(obstacles.grid.size, NOWHERE * 0x01010101, np.uint32).view(np.int32))
            self.update()

    def update(self) -> None:
        """Follow the obstacles."""
        if self.words is not None:
            _find_known(self._obstacles.box, self._obstacles.solids, self.words)
            for layer in self._layers:
                _grow(self._obstacles.box, self.words, layer)

    def fill(self) -> None:
        """Set the solid cells and faces near air."""
        if self.words is not None:
            for layer in self._layers:
                _fill_layer(self._obstacles.box, self.words, self._state, layer)
            _clear_depths(self.words, self._state)


@kernel
def _find_known(box: Grid, solids: Solids, words: Integers):
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            in_x, in_y, in_z = int(i <= box.nx), int(j <= box.ny), int(k <= box.nz)
            exists = ti.Vector([in_y * in_z, in_x * in_z, in_x * in_y, in_x * in_y * in_z])
            here = _is_air(box, solids, i, j, k)
            known = ti.Vector([here, here, here, here])
            known[0] += _is_air(box, solids, i - 1, j, k)
            known[1] += _is_air(box, solids, i, j - 1, k)
            known[2] += _is_air(box, solids, i, j, k - 1)
            word = 0
            for kind in ti.static(range(4)):
                layer = ti.select(exists[kind] == 0, NOWHERE, ti.select(known[kind] > 0, KNOWN, DEEP))
                word |= layer << ti.static(8 * kind)
            words[row_start(box, i, j) + k] = word


@kernel
def _grow(box: Grid, words: Integers, layer: ti.i32):
    """Deep places beside those of the layers before become this layer.

    Other threads may see a word before or after its change: neither is in a layer before.
    """
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            word = words[at]
            for kind in ti.static(range(4)):
                if _layer(words, at, kind) == DEEP:
                    beside = DEEP
                    for step in ti.static((box.step_x, box.step_y, 1)):
                        beside = ti.min(beside, _layer(words, at - step, kind), _layer(words, at + step, kind))
                    if beside < layer:
                        word += (layer - DEEP) << ti.static(8 * kind)
            words[at] = word


@kernel
def _fill_layer(box: Grid, words: Integers, state: State, layer: ti.i32):
    for at in range(box.step_x, words.shape[0] - box.step_x):
        if words[at] != KNOWN:
            _fill_place(box, words, state.velocity.x, FACES_X, at, layer)
            _fill_place(box, words, state.velocity.y, FACES_Y, at, layer)
            _fill_place(box, words, state.velocity.z, FACES_Z, at, layer)
            _fill_place(box, words, state.density, CELLS, at, layer)
            _fill_place(box, words, state.excess, CELLS, at, layer)


@kernel
def _clear_depths(words: Integers, state: State):
    for at in range(words.shape[0]):
        if _layer(words, at, CELLS) == DEEP:
            state.density[at] = 0.0
            state.excess[at] = 0.0


@func
def _layer(words: Integers, at: ti.i32, kind: ti.template()):
    return (words[at] >> ti.static(8 * kind)) & 255


@func
def _is_air(box: Grid, solids: Solids, i: ti.i32, j: ti.i32, k: ti.i32):
    inside = 0 < i <= box.nx and 0 < j <= box.ny and 0 < k <= box.nz
    return int(inside and not is_solid(solids, row_start(box, i, j) + k))


@func
def _fill_place(box: Grid, words: Integers, values: Floats, kind: ti.template(), at: ti.i32, layer: ti.i32):
    if _layer(words, at, kind) == layer:
        total = 0.0
        count = 0.0
        for step in ti.static((box.step_x, box.step_y, 1)):
            for neighbour in ti.static((-step, step)):
                if _layer(words, at + neighbour, kind) < layer:
                    total += values[at + neighbour]
                    count += 1.0
        values[at] = total / count
