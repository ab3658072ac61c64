"""The window: the part of a smoke's box that is computed, a box of cells around where there is something.

A smoke whose grid follows is fitted at the start of frames. What has to be in the window is called *busy*: cells with
smoke, heat or fuel, and air that moves against the wind, unless all air is stirred; sources that emit; bodies that the
air may push; and where the air's own velocity takes all this within the frame. Around it lie `MARGIN` cells, and ends
lie on blocks of `BLOCK` cells, counted from the lower corner of the smoke's box. Where the window ends, and the box
does not, its sides are open to air as it is outside (`sim.smoke.sides`): at rest, or with the wind.

The window is left as it is while the next frame fits and it is not much too large; a new one is fitted to some frames
ahead, so that a front that moves does not ask for one in each.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.domain import DomainParameters
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.grid import Index3, SmokeGrid, Window
from sim.smoke.lanes import Grid, cell_counts, lane_items, lane_place, row_start
from sim.smoke.obstacles import Air
from sim.smoke.parameters import SmokeParameters
from sim.smoke.reductions import Pair, Rows, find_maxima, partial_place

Ends = NDArray[np.float64]
"""Lower and upper end along x, y, z, (2, 3); in cells from the lower corner of the smoke's box, or in metres."""

BLOCK = 8  # cells: short enough that rounding a window up to blocks adds little to a plume of a hundred cells
MARGIN = 4  # cells around what is busy, over which flow about it fades and pressure falls to that outside
FRAMES_AHEAD = 4.0  # that a new window is fitted to
TOO_LARGE = 1.5  # volume over that of a window that is fitted now, from which on it is made smaller
LEAST_DENSITY = 2.0**-14  # of cells that are busy [-]: a hundred metres of it at 1 per metre take half a per cent
LEAST_HEAT_K = 0.5  # of cells that are busy, off the air's temperature [K]: nothing of less is written to volumes
LEAST_MOTION = 0.25  # of air that is busy, off the wind, over the fastest [-]: an eddy, not the flow around one
CREEP = 0.1  # cells a frame that air goes at most without being busy, however slow all of it is


class Fitting:
    """Fits windows of one smoke.

    Attributes:
        follows: whether the grid is a window at all; without, it is the whole box for ever.
    """

    def __init__(
        self, parameters: SmokeParameters, domain: DomainParameters, frame_s: float, *, is_stirred: bool
    ) -> None:
        """Take a smoke, which may have the domain for its box, and the length of a frame [s].

        Where gusts or winds stir all air, its motion alone does not count: fresh air would be busy at once.
        """
        self._counts_motion = not is_stirred
        self.follows = parameters.grid != "box"
        self._parameters, self._frame_s = parameters, frame_s
        self._corner = np.asarray(parameters.min or domain.min)
        limits = np.array(parameters.limits(domain))
        self._ends = np.where(np.isinf(limits), limits, [(0, 0, 0), parameters.cell_counts(domain)])

    def first(self, sources: Iterable[Ends]) -> Window | None:
        """The window to start with, around all sources, each between two corners [m]; None for the whole box."""
        ends = self._in_cells(sources)
        return None if ends is None or not self.follows else self._fitted(ends)

    def next(
        self,
        air: Air,
        fuel: ti.Ndarray | None,
        window: Window,
        wind: Vector3,
        there: Callable[[float], Iterable[Ends]],
        rows: Rows,
    ) -> Window:
        """The window of the coming frame: the present one, unless that is too small or much too large.

        Air outside has the velocity of a wind [m/s]. What is there within so many frames are sources that emit in the
        coming one, and bodies, each between the corners of where it is [m]. Where neither they nor anything else is
        left, the middle of the window stays.
        """
        soon, later = (
            _union(self._in_cells(there(frames)), self._busy(air, fuel, window, wind, frames, rows))
            for frames in (1.0, FRAMES_AHEAD)
        )
        low, high = np.asarray(window.first), np.asarray(window.first) + window.cells
        nothing = np.stack([0.5 * (low + high)] * 2)
        fitted = self._fitted(nothing if later is None else later)
        needed = self._clipped(_with_margin(nothing if soon is None else soon))
        is_in = bool(np.all(low <= needed[0]) and np.all(needed[1] <= high))
        return window if is_in and math.prod(window.cells) <= TOO_LARGE * math.prod(fitted.cells) else fitted

    def _in_cells(self, boxes: Iterable[Ends]) -> Ends | None:
        """What is around all boxes, given in metres."""
        ends = None
        for box in boxes:
            ends = _union(ends, (np.asarray(box) - self._corner) / self._parameters.cell_size)
        return ends

    def _busy(
        self, air: Air, fuel: ti.Ndarray | None, window: Window, outside: Vector3, frames: float, rows: Rows
    ) -> Ends | None:
        """Where what is in a window will be busy in so many frames."""
        wind, step = ti.math.vec3(outside), self._frame_s / self._parameters.cell_size
        least = np.inf
        if self._counts_motion:
            least = max(LEAST_MOTION * _find_motion(air, wind, rows)[0], CREEP / step)
        gas = air.state.density if fuel is None else fuel
        ends = np.zeros((2, 3))
        for axis in range(3):
            down, up = _find_ends(axis, air, gas, wind, least, frames * step, rows)
            if up == 0.0:
                return None
            ends[:, axis] = window.first[axis] + window.cells[axis] - down, window.first[axis] + up
        return ends

    def _fitted(self, ends: Ends) -> Window:
        """Blocks around what is busy."""
        around = _with_margin(ends)
        low, high = self._clipped(np.stack([np.floor(around[0] / BLOCK), np.ceil(around[1] / BLOCK)]) * BLOCK)
        x, y, z = (int(n) for n in low)
        return Window((x, y, z), _counts(high - low))

    def _clipped(self, ends: Ends) -> Ends:
        """Within the box, of which at least a block is left."""
        low = np.clip(ends[0], self._ends[0], np.maximum(self._ends[0], self._ends[1] - BLOCK))
        return np.stack([low, np.clip(np.maximum(ends[1], low + BLOCK), None, self._ends[1])])


def _counts(values: NDArray[np.float64]) -> Index3:
    x, y, z = (int(n) for n in values)
    return x, y, z


def _with_margin(ends: Ends) -> Ends:
    return np.stack([np.floor(ends[0]) - MARGIN, np.ceil(ends[1]) + MARGIN])


def _union(first: Ends | None, second: Ends | None) -> Ends | None:
    if first is None or second is None:
        return second if first is None else first
    return np.stack([np.minimum(first[0], second[0]), np.maximum(first[1], second[1])])


def carry_over(
    arrays: Mapping[str, ti.Ndarray],
    old: tuple[SmokeGrid, Grid],
    into: Mapping[str, ti.Ndarray],
    new: tuple[SmokeGrid, Grid],
) -> None:
    """Copy what both windows have, of faces across x, y, z, which come first, and of cells; each with its grids."""
    (old_grid, old_box), (new_grid, new_box) = old, new
    shift = np.subtract(new_grid.window.first, old_grid.window.first)
    for axis, (name, source) in enumerate(arrays.items()):
        target = into[name]
        own = np.arange(3) == axis  # a face more than cells along the own axis
        low = np.maximum(1, 1 + shift)
        high = np.minimum(np.add(old_grid.cells, own), np.add(new_grid.cells, own) + shift)
        if np.all(low <= high):
            given = (ti.math.ivec3(values.tolist()) for values in (low, high, shift))
            _copy_places(*given, old_box, source, new_box, target)


@kernel
def _copy_places(
    low: ti.math.ivec3,
    high: ti.math.ivec3,
    shift: ti.math.ivec3,
    old: Grid,
    source: Floats,
    new: Grid,
    target: Floats,
):
    """Copy the places from `low` to `high` of the old grid."""
    for i, j in ti.ndrange((low[0], high[0] + 1), (low[1], high[1] + 1)):
        row, new_row = row_start(old, i, j), row_start(new, i - shift[0], j - shift[1]) - shift[2]
        for k in range(low[2], high[2] + 1):
            target[new_row + k] = source[row + k]


@kernel
def _find_motion(air: Air, wind: ti.math.vec3, rows: Rows) -> Pair:
    """The largest velocity off the wind's at centres of cells [m/s]."""
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        largest = 0.0
        for n in range(lane_items(air.box, air.box.nz, lane)):
            at = row_start(air.box, i, j) + lane_place(air.box, n, lane)
            largest = ti.max(largest, (_velocity(air, at) - wind).norm())
        rows.partial[partial_place(air.box, i, j, lane)] = ti.Vector([largest, 0.0])
    find_maxima(rows)
    return rows.nodes[0]


@kernel
def _find_ends(
    axis: ti.template(), air: Air, fuel: Floats, wind: ti.math.vec3, least: ti.f32, step: ti.f32, rows: Rows
) -> Pair:
    """How far below the upper side of the window, and above its lower side, what is busy reaches, or will [cells].

    It goes with the air for a step over the edge of a cell [s/m]. Nothing is busy where the second number is 0.
    """
    box, state = ti.static((air.box, air.state))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        down, up = 0.0, 0.0
        for n in range(lane_items(box, box.nz, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            velocity = _velocity(air, at)
            is_busy = ti.max(state.density[at], fuel[at]) > LEAST_DENSITY or ti.abs(state.excess[at]) > LEAST_HEAT_K
            if is_busy or (velocity - wind).norm() > least:
                place, way = ti.cast(ti.Vector([i, j, k])[axis], ti.f32), step * velocity[axis]
                down = ti.max(down, ti.cast(cell_counts(box)[axis], ti.f32) - place + 1.0 - ti.min(way, 0.0))
                up = ti.max(up, place + ti.max(way, 0.0))
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([down, up])
    find_maxima(rows)
    return rows.nodes[0]


@func
def _velocity(air: Air, at: ti.i32):
    """At the centre of a cell [m/s]."""
    box, velocity = ti.static((air.box, air.state.velocity))
    return 0.5 * ti.Vector(
        [
            velocity.x[at] + velocity.x[at + box.step_x],
            velocity.y[at] + velocity.y[at + box.step_y],
            velocity.z[at] + velocity.z[at + 1],
        ]
    )
