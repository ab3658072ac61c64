"""Continue velocity a few cells into solids, so that look-ups next to a surface mix in no faces without a value.

Each layer of closed faces takes the mean of its neighbours in the layers before (Houston et al. 2003 do the same with
the nearest fluid value). Across the surface the velocity is then made that of the solid (Houston, Bond & Wiebe 2003;
Batty, Bertails & Bridson 2007): the flow is continued along the surface, so it slips. On closed sides of the box the
normal velocity is that of the side.
"""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, cell_counts, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Obstacles, Solids, flux_part

KNOWN = 0  # layer of faces with a value of their own: those that are open in part, and sides of the box
NOWHERE, DEEP = 254, 255  # layers of what is not in the grid, and of what lies deeper in a solid than the last layer
FLAT = 1.0e-3  # slope of the distance below which a place is deep inside, and moves with its solid [cells per cell]


class Extrapolation:
    """Fills the closed faces next to air in the velocity of one grid.

    Attributes:
        words: the layers of the faces across x, y, z at each place, a byte each, int32; None without solids, where
            there is nothing to fill.
    """

    def __init__(
        self, obstacles: Obstacles, velocity: Faces, work: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray], *, reach: float
    ) -> None:
        """Prepare for look-ups that come so many cells into solids; there are three arrays to work in."""
        self._obstacles, self._velocity, self._work = obstacles, velocity, Faces(*work)
        self._layers = range(1, math.ceil(reach) + 2)
        self.words: ti.Ndarray | None = None
        if obstacles.solids.cuts:
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
        """Set the closed faces near air."""
        if self.words is not None:
            for layer in self._layers:
                _fill_layer(self._obstacles.box, self.words, self._velocity, layer)
            given = self._obstacles.box, self._obstacles.solids, self.words, self._velocity, self._work
            _find_constrained(*given)
            _store_constrained(self._obstacles.box, self.words, self._velocity, self._work)


@kernel
def _find_known(box: Grid, solids: Solids, words: Integers):
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            in_x, in_y, in_z = int(i <= box.nx), int(j <= box.ny), int(k <= box.nz)
            exists = ti.Vector([in_y * in_z, in_x * in_z, in_x * in_y])
            word = 0
            for axis in ti.static(range(3)):
                is_open = flux_part(solids, axis, at) > 0.0
                layer = ti.select(exists[axis] == 0, NOWHERE, ti.select(is_open, KNOWN, DEEP))
                word |= layer << ti.static(8 * axis)
            words[at] = word


@kernel
def _grow(box: Grid, words: Integers, layer: ti.i32):
    """Deep places beside those of the layers before become this layer.

    Other threads may see a word before or after its change: neither is in a layer before.
    """
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            word = words[at]
            for kind in ti.static(range(3)):
                if _layer(words, at, kind) == DEEP:
                    beside = DEEP
                    for step in ti.static((box.step_x, box.step_y, 1)):
                        beside = ti.min(beside, _layer(words, at - step, kind), _layer(words, at + step, kind))
                    if beside < layer:
                        word += (layer - DEEP) << ti.static(8 * kind)
            words[at] = word


@kernel
def _fill_layer(box: Grid, words: Integers, velocity: Faces, layer: ti.i32):
    for at in range(box.step_x, words.shape[0] - box.step_x):
        if (words[at] & 0xFFFFFF) != KNOWN:
            _fill_place(box, words, velocity.x, 0, at, layer)
            _fill_place(box, words, velocity.y, 1, at, layer)
            _fill_place(box, words, velocity.z, 2, at, layer)


@kernel
def _find_constrained(box: Grid, solids: Solids, words: Integers, velocity: Faces, constrained: Faces):
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            if (words[at] & 0xFFFFFF) != KNOWN:
                for axis, found in ti.static(((0, constrained.x), (1, constrained.y), (2, constrained.z))):
                    if _is_filled(words, at, axis):
                        found[at] = _constrained_face(axis, box, solids, velocity, at, ti.Vector([i, j, k]))


@kernel
def _store_constrained(box: Grid, words: Integers, velocity: Faces, constrained: Faces):
    for at in range(box.step_x, words.shape[0] - box.step_x):
        if (words[at] & 0xFFFFFF) != KNOWN:
            for axis, face, found in ti.static(
                (
                    (0, velocity.x, constrained.x),
                    (1, velocity.y, constrained.y),
                    (2, velocity.z, constrained.z),
                )
            ):
                if _is_filled(words, at, axis):
                    face[at] = found[at]


@func
def _constrained_face(axis: ti.template(), box: Grid, solids: Solids, velocity: Faces, at: ti.i32, here) -> ti.f32:
    """Velocity across a face, of which the part across the nearest surface is that of the solid there.

    Faces on the sides of the box have their neighbours inside.
    """
    first, second = ti.static((axis + 1) % 3, (axis + 2) % 3)
    along, a, b = steps(box)[axis], steps(box)[first], steps(box)[second]
    low = at - along * int(here[axis] > 1)
    high = at + along * int(here[axis] <= cell_counts(box)[axis])
    distance, faces = ti.static((solids.distance, (velocity.x, velocity.y, velocity.z)))
    slope, flow, wall = ti.math.vec3(0.0), ti.math.vec3(0.0), ti.math.vec3(0.0)
    rise = (distance[high] + distance[high + a]) + (distance[high + b] + distance[high + a + b])
    rise -= (distance[low] + distance[low + a]) + (distance[low + b] + distance[low + a + b])
    slope[axis] = 0.25 * rise * along / ti.cast(high - low, ti.f32)
    slope[first] = 0.5 * ((distance[at + a] - distance[at]) + (distance[at + a + b] - distance[at + b]))
    slope[second] = 0.5 * ((distance[at + b] - distance[at]) + (distance[at + a + b] - distance[at + a]))
    below = low
    above = at - along * int(here[axis] > cell_counts(box)[axis])
    flow[axis] = faces[axis][at]
    flow[first] = 0.25 * (
        (faces[first][below] + faces[first][below + a]) + (faces[first][above] + faces[first][above + a])
    )
    flow[second] = 0.25 * (
        (faces[second][below] + faces[second][below + b]) + (faces[second][above] + faces[second][above + b])
    )
    if ti.static(solids.moving):
        for component, speed in ti.static(enumerate((solids.velocity.x, solids.velocity.y, solids.velocity.z))):
            wall[component] = 0.25 * ((speed[at] + speed[at + a]) + (speed[at + b] + speed[at + a + b]))
    length, result = slope.norm(), wall[axis]
    if length > FLAT:
        normal = slope / length
        # The normal parts one by one: along an axis the solid's velocity is taken to the bit.
        result = flow[axis] - normal[axis] * flow.dot(normal) + normal[axis] * wall.dot(normal)
    return result


@func
def _is_filled(words: Integers, at: ti.i32, axis: ti.template()):
    layer = _layer(words, at, axis)
    return layer != KNOWN and layer < NOWHERE


@func
def _layer(words: Integers, at: ti.i32, kind: ti.template()):
    return (words[at] >> ti.static(8 * kind)) & 255


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
