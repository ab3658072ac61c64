"""Guides: a coarser simulation of the same smoke says where all goes, and the finer one adds what is smaller.

The velocity u of the fine smoke is drawn towards that of the guide u_g in what both can hold: with R, the mean over the
fine faces on a face of the guide, and P, linear interpolation between the guide's faces, u += k P (u_g - R u) before
the projection, k = 1 - exp(-dt/tau). That is the low-pass blend of guided smoke (Nielsen & Bridson 2011), whose product
with the projection is what minimizing the distance to the guide under div u = 0 comes to (Forootaninia & Narain 2020);
R keeps the flux through each face, so u_g - R u is as free of divergence as both are. Smaller eddies, the smoke and the
heat are the fine simulation's own.

A guide keeps its own steps, those that it takes alone. Between two frames of it u_g is linear in time. Beside solids,
where a face of either grid is closed in part, and outside of the guide's grid nothing is drawn anywhere.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.solver import Arrays, SimulationDivergedError
from sim.core.world import World
from sim.smoke.arrays import Faces, new_faces
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid, cell_counts, fill_row, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Air, flux_part
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place, sum_up

RESPONSE_FRAMES = 1.0
"""Time tau in which the fine smoke takes on the guide's motion, in frames."""
NOT_GUIDED = 1.0e30
"""Marks faces that a guide says nothing about [m/s]."""
COUNT_AND_PRODUCT, FIRST, SECOND = range(3)  # moments of two velocities


class CoarseSmoke(Protocol):
    """What a guide has to know of the smoke that it computes.

    Attributes:
        air: its fields.
        grid: its cells.
        refusal: of more cells (`sim.core.solver.Grows`).
    """

    air: Air
    grid: SmokeGrid
    refusal: Callable[[float], str | None] | None

    @property
    def unfinished_solves(self) -> int:
        """Projections of the frame that have hit their limit."""

    def begin_frame(self, time_s: float) -> None:
        """A frame starts at a simulated time [s]."""


class Guide:
    """The coarser simulation of one smoke, a frame ahead of it.

    Args:
        world: the coarse smoke, and what moves in it.
        smoke: that smoke.
        refinement: edge of its cells over that of the fine ones, whole.
        frame_s: time between two frames [s].
    """

    def __init__(self, world: World, smoke: CoarseSmoke, *, refinement: int, frame_s: float) -> None:
        self._world, self._smoke, self._refinement, self._frame_s = world, smoke, refinement, frame_s
        self._start_s, self._is_due, self._speed = 0.0, False, 0.0
        self._make_room()

    def _make_room(self) -> None:
        size = self._smoke.grid.size
        self._grid, self._before, self._missing = self._smoke.grid, new_faces(size), new_faces(size)
        self._rows = new_rows(self._smoke.air.box)

    def begin_frame(self, time_s: float, refusal: Callable[[float], str | None] | None) -> None:
        """A frame starts at a simulated time [s]; what is asked before a window grows is the fine smoke's refusal.

        Raises OutgrownError: there is no memory for the window that the guide needs; nothing has moved yet.
        """
        self._smoke.refusal = refusal
        self._smoke.begin_frame(time_s)
        if self._grid is not self._smoke.grid:
            self._make_room()
        for kept, now in zip(self._before, self._smoke.air.state.velocity, strict=True):
            kept.copy_from(now)
        self._start_s, self._is_due = time_s, True

    def largest_speed(self) -> float:
        """Largest velocity of its faces at the start and the end of the frame [m/s]."""
        self._go_ahead()
        return self._speed

    def draw(self, air: Air, grid: SmokeGrid, time_s: float, dt: float) -> None:
        """Draw the velocity of a fine smoke for dt [s] towards that of the guide at a simulated time [s]."""
        self._go_ahead()
        part = min(1.0, max(0.0, (time_s - self._start_s) / self._frame_s))
        first, coarse = self._first(grid), self._smoke.air
        _find_missing(air, coarse, self._before, self._missing, first, self._refinement, part, 0.0)
        strength = -math.expm1(-dt / (RESPONSE_FRAMES * self._frame_s))
        _add_missing(air, coarse.box, self._missing, first, self._refinement, strength)

    def correlation(self, air: Air, grid: SmokeGrid) -> float:
        """Correlation of a fine smoke's velocity, on the guide's faces, with the guide's at the end of the frame [-].

        Of all guided faces but the last ones along each axis, off the mean of each component; 1 where both are at rest.
        """
        coarse = self._smoke.air
        given = self._before, self._missing, self._first(grid), self._refinement, 1.0
        _find_missing(air, coarse, *given, NOT_GUIDED)
        both = square = own_square = 0.0
        for missing, now in zip(self._missing, coarse.state.velocity, strict=True):
            arrays, rows = (coarse.box, missing, now), self._rows
            count = _sum_moments(*arrays, 0.0, 0.0, COUNT_AND_PRODUCT, rows)[0]
            if count > 0.0:
                means = [total / count for total in _sum_moments(*arrays, 0.0, 0.0, FIRST, rows)]
                squares = _sum_moments(*arrays, *means, SECOND, rows)
                square, own_square = square + squares[0], own_square + squares[1]
                both += _sum_moments(*arrays, *means, COUNT_AND_PRODUCT, rows)[1]
        if square == own_square == 0.0:
            return 1.0
        return both / math.sqrt(square * own_square) if square * own_square > 0.0 else 0.0

    def unfinished_solves(self) -> int:
        """How many of its projections of the frame have hit their limit."""
        return self._smoke.unfinished_solves

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Its world at the end of a frame."""
        return {f"guide/{name}": values for name, values in self._world.checkpoint().items()}

    def restore(self, arrays: Arrays, time_s: float) -> None:
        """Continue from a checkpoint of a frame's end, at a simulated time [s]. Raises ValueError: it does not fit."""
        own = {name.removeprefix("guide/"): values for name, values in arrays.items() if name.startswith("guide/")}
        self._world.restore(round(time_s / self._frame_s), own)
        self._make_room()
        self._is_due = False

    def _first(self, grid: SmokeGrid) -> ti.math.ivec3:
        """The lowest cell of a fine grid, counted in its cells from the lowest one of the guide's."""
        shift = np.subtract(grid.first, np.multiply(self._refinement, self._smoke.grid.first))
        return ti.math.ivec3(shift.tolist())

    def _go_ahead(self) -> None:
        """Compute the frame, unless that is done: all that may refuse it has been asked at its start."""
        if not self._is_due:
            return
        try:
            self._world.go_to_next_frame()
        except SimulationDivergedError as error:
            finding = f"{error.quantity}, in the simulation that guides it"
            raise SimulationDivergedError(error.body, error.frame, error.time_s, finding, error.hint) from error
        if self._grid is not self._smoke.grid:
            raise RuntimeError("the window of a guide moved within its frame")
        self._is_due = False
        self._speed = max(_find_speeds(self._smoke.air, self._before, self._rows))


@kernel
def _find_speeds(air: Air, before: Faces, rows: Rows) -> Pair:
    """Largest velocities of faces, of `before` and now."""
    box, velocity = ti.static((air.box, air.state.velocity))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        first = 0.0
        second = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            for step in ti.static(range(2)):
                x, y, z = at + step * box.step_x, at + step * box.step_y, at + step
                first = ti.max(first, ti.abs(before.x[x]), ti.abs(before.y[y]), ti.abs(before.z[z]))
                second = ti.max(second, ti.abs(velocity.x[x]), ti.abs(velocity.y[y]), ti.abs(velocity.z[z]))
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([first, second])
    find_maxima(rows)
    return rows.nodes[0]


@kernel
def _find_missing(
    fine: Air,
    coarse: Air,
    before: Faces,
    missing: Faces,
    first: ti.math.ivec3,
    refinement: ti.i32,
    part: ti.f32,
    nothing: ti.f32,
):
    """u_g - R u on the coarse faces, `part` of the way from `before` to now; `nothing` where a face is not open."""
    box, later, openness = ti.static((coarse.box, coarse.state.velocity, coarse.openness))
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            corner = refinement * ti.Vector([i - 1, j - 1, k - 1]) - first + 1
            for axis, out, earlier, now, is_open in ti.static(
                (
                    (0, missing.x, before.x, later.x, openness.x),
                    (1, missing.y, before.y, later.y, openness.y),
                    (2, missing.z, before.z, later.z, openness.z),
                )
            ):
                mean = ti.math.vec2(0.0)
                if is_open[at] > 0.0 and flux_part(coarse.solids, axis, at) == 1.0:
                    mean = _mean_of_faces(fine, axis, corner, refinement)
                value = nothing
                if mean.y == 1.0:
                    value = earlier[at] + part * (now[at] - earlier[at]) - mean.x
                out[at] = value


@kernel
def _sum_moments(
    box: Grid,
    missing: Floats,
    given: Floats,
    given_mean: ti.f32,
    own_mean: ti.f32,
    moments: ti.template(),
    rows: Rows,
) -> Pair:
    """Sums over guided faces of 1 and a b, of a and b, or of their squares: a of the guide, b of the fine smoke."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        first = 0.0
        second = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            counts = missing[at] < 0.5 * NOT_GUIDED
            a = ti.select(counts, given[at] - given_mean, 0.0)
            b = ti.select(counts, given[at] - missing[at] - own_mean, 0.0)
            if ti.static(moments == COUNT_AND_PRODUCT):
                first += ti.select(counts, 1.0, 0.0)
                second += a * b
            elif ti.static(moments == FIRST):
                first += a
                second += b
            else:
                first += a * a
                second += b * b
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([first, second])
    sum_up(rows)
    return rows.nodes[0]


@func
def _mean_of_faces(fine: Air, axis: ti.template(), corner: ti.template(), refinement: ti.i32):
    """Mean velocity of the fine faces on a coarse one [m/s], and 1 if all of them are there and wholly open, or 0."""
    box, velocities, openings = ti.static((fine.box, fine.state.velocity, fine.openness))
    velocity = ti.static((velocities.x, velocities.y, velocities.z)[axis])
    openness = ti.static((openings.x, openings.y, openings.z)[axis])
    across = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    last = cell_counts(box)
    last[axis] += 1
    end = corner
    end[across[0]] += refinement - 1
    end[across[1]] += refinement - 1
    total, counts = 0.0, 0.0
    if (corner >= 1).all() and (end <= last).all():
        counts = 1.0
        start = row_start(box, corner[0], corner[1]) + corner[2]
        for a in range(refinement):
            for b in range(refinement):
                at = start + a * steps(box)[across[0]] + b * steps(box)[across[1]]
                total += velocity[at]
                if openness[at] == 0.0 or flux_part(fine.solids, axis, at) < 1.0:
                    counts = 0.0
    return ti.math.vec2(total / (refinement * refinement), counts)


@kernel
def _add_missing(fine: Air, coarse: Grid, missing: Faces, first: ti.math.ivec3, refinement: ti.i32, strength: ti.f32):
    """u += k P (u_g - R u) on open faces of the fine grid."""
    box, velocity, openness = ti.static((fine.box, fine.state.velocity, fine.openness))
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        row = row_start(box, i, j)
        for axis, face, is_open, values in ti.static(
            (
                (0, velocity.x, openness.x, missing.x),
                (1, velocity.y, openness.y, missing.y),
                (2, velocity.z, openness.z, missing.z),
            )
        ):
            x, below_x, above_x = _beside(i - 1 + first.x, refinement, axis == 0, coarse.nx)
            y, below_y, above_y = _beside(j - 1 + first.y, refinement, axis == 1, coarse.ny)
            rows = ti.math.ivec4(row_start(coarse, x, y), row_start(coarse, x, y + 1), row_start(coarse, x + 1, y), 0)
            rows.w = rows.y + rows.z - rows.x
            weights = strength * ti.math.vec4(
                below_x * below_y, below_x * above_y, above_x * below_y, above_x * above_y
            )
            given = ti.static((row, axis, face, is_open, values, rows, weights, first.z, refinement, coarse.nz))
            fill_row(box, face, row, box.nz + 1, lane, _with_missing, given)


@func
def _with_missing(
    k: ti.i32,
    row: ti.i32,
    axis: ti.template(),
    face: Floats,
    openness: Floats,
    values: Floats,
    rows: ti.template(),
    weights: ti.template(),
    first: ti.i32,
    refinement: ti.i32,
    cells: ti.i32,
):
    z, below, above = _beside(k - 1 + first, refinement, axis == 2, cells)
    change = 0.0
    for n in ti.static(range(4)):
        change += weights[n] * (below * values[rows[n] + z] + above * values[rows[n] + z + 1])
    return face[row + k] + ti.select(openness[row + k] > 0.0, change, 0.0)


@func
def _beside(place: ti.i32, refinement: ti.i32, along: ti.template(), cells: ti.i32):
    """The coarse place below a fine one, from 0 to `cells`, and the weights of that and the next one; 0 outside.

    Of places `along` the axis that faces lie across the first ones coincide, of others the first cells begin together.
    """
    at = (ti.cast(place, ti.f32) + 0.5) / refinement + 0.5
    if ti.static(along):
        at = ti.cast(place, ti.f32) / refinement + 1.0
    below = ti.min(ti.max(ti.floor(at, ti.i32), 0), cells)
    part = at - below
    is_in = part >= 0.0 and part <= 1.0
    return below, ti.select(is_in, 1.0 - part, 0.0), ti.select(is_in, part, 0.0)
