"""Keep the total of what MacCormack's limiter advects.

The limiter cuts corrections that would leave the range of the values around, most of all those that go below zero at
the foot of the smoke, and leaves the opposite ones, at its crests, as they are. What was cut is made in every step: a
plume in a closed box held twice what its source had given after two seconds.

So the limited corrections of one sign are weakened by a common factor in [0, 1], chosen so that the total is that of
before, less what flowed out (a quasi-monotone scheme made conservative by what it may still choose, as in Bermejo &
Conde 2002, Mon. Weather Rev. 130:423-430, with the semi-Lagrangian result for the monotone one). Values stay between
that result and the limited one, hence in their range. Where the limiter cuts nothing, the factor is 1 but for the error
of the scheme, and its order remains.
"""

import taichi as ti

from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.obstacles import Obstacles
from sim.smoke.reductions import RowReductions


@ti.data_oriented
class CorrectionBalance:
    """Weakens corrections of one advected cell field after another.

    Exact for the total over all air cells of a closed box without moving obstacles, but for rounding and for steps in
    which no factor in [0, 1] reaches it. What leaves through open sides is balanced to second order; through the sides
    of moving solids flows what an upwind scheme has flow in the step, so their smoke is balanced to first order.

    Attributes:
        reductions: what it reduces rows with.

    Args:
        obstacles: in the grid where the fields live.
        velocity: the three face velocities [m/s], flat fields.
    """

    def __init__(self, obstacles: Obstacles, velocity: tuple) -> None:
        grid = obstacles.grid
        self._obstacles = obstacles
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._u, self._v, self._w = velocity
        self._lanes = lane_count()
        self._missing, self._corrections = (RowReductions(self._nx, self._ny) for _ in range(2))
        self.reductions = [self._missing, self._corrections]

    @ti.kernel
    def restore(self, field: ti.template(), predicted: ti.template(), corrected: ti.template(), step: ti.f32):
        """Bring the total of the corrected field to what it must be.

        Args:
            field: before the step, flat.
            predicted: the semi-Lagrangian result, flat.
            corrected: the limited result, flat; changed.
            step: length of the step over the edge of a cell [s/m].
        """
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            missing, raised, lowered = 0.0, 0.0, 0.0
            for n in range(lane_items(self._nz, lane)):
                k = lane_place(n, lane)
                at = row + k
                if not self._obstacles.is_solid(at):
                    correction = corrected[at] - predicted[at]
                    raised += ti.max(correction, 0.0)
                    lowered += ti.min(correction, 0.0)
                    missing += (field[at] - corrected[at]) - self._outflow(field, i, j, k, at, step)
            place = self._missing.place(i, j, lane)
            self._missing.partial[place] = ti.Vector([missing, 0.0])
            self._corrections.partial[place] = ti.Vector([raised, lowered])
        self._missing.sum_up()
        self._corrections.sum_up()
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            missing, both = self._missing.result[None][0], self._corrections.result[None]
            keep_raised, keep_lowered = 1.0, 1.0
            if missing < 0.0:
                keep_raised = self._kept(missing, both[0])
            else:
                keep_lowered = self._kept(missing, both[1])
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                correction = corrected[at] - predicted[at]
                if correction > 0.0:
                    corrected[at] = predicted[at] + keep_raised * correction
                else:
                    corrected[at] = predicted[at] + keep_lowered * correction

    @ti.func
    def _kept(self, missing: ti.f32, corrections: ti.f32):
        """Part of the corrections, of the sign opposite to what is missing, that closes the balance."""
        part = 1.0
        if corrections != 0.0:
            part = ti.max(0.0, ti.min(1.0 + missing / corrections, 1.0))
        return part

    @ti.func
    def _outflow(self, field: ti.template(), i: ti.i32, j: ti.i32, k: ti.i32, at: ti.i32, step: ti.f32):
        """What leaves the air through the faces of a cell in the step, in cells full of it."""
        x, y, z = ti.static(self._step_x, self._step_y, 1)
        return (
            self._through(field, at, -x, i == 1, -step * self._u[at])
            + self._through(field, at, x, i == self._nx, step * self._u[at + x])
            + self._through(field, at, -y, j == 1, -step * self._v[at])
            + self._through(field, at, y, j == self._ny, step * self._v[at + y])
            + self._through(field, at, -z, k == 1, -step * self._w[at])
            + self._through(field, at, z, k == self._nz, step * self._w[at + z])
        )

    @ti.func
    def _through(self, field: ti.template(), at: ti.i32, beside: ti.i32, is_side: ti.i32, crossed: ti.f32):
        """Flux out of the air through a face, of air that crosses so many cells in the step.

        Clean air comes in from outside, and what was continued into solids from them. What leaves through a side is
        what a straight line through the last two cells has within the way to it; between nothing and twice as much
        as the last one holds, as beyond its foot such a line goes below zero.
        """
        flux = 0.0
        if is_side or self._obstacles.is_solid(at + beside):
            inside, beyond = field[at], field[at + beside]
            if is_side:
                leaving = inside + 0.5 * (1.0 - crossed) * (inside - field[at - beside])
                twice = 2.0 * inside
                inside, beyond = ti.max(ti.min(leaving, ti.max(twice, 0.0)), ti.min(twice, 0.0)), 0.0
            flux = ti.max(crossed, 0.0) * inside + ti.min(crossed, 0.0) * beyond
        return flux
