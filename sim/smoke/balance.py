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
    which no factor in [0, 1] reaches it. Through open sides and the sides of moving solids flows what an upwind scheme
    has flow in the step: their smoke is balanced to first order.

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
                    missing += (field[at] - corrected[at]) - step * self._outflow(field, i, j, k, at)
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
    def _outflow(self, field: ti.template(), i: ti.i32, j: ti.i32, k: ti.i32, at: ti.i32):
        """What leaves the air through the faces of a cell, times a velocity [m/s]."""
        x, y, z = ti.static(self._step_x, self._step_y, 1)
        return (
            self._through(field, at, at - x, i == 1, -self._u[at])
            + self._through(field, at, at + x, i == self._nx, self._u[at + x])
            + self._through(field, at, at - y, j == 1, -self._v[at])
            + self._through(field, at, at + y, j == self._ny, self._v[at + y])
            + self._through(field, at, at - z, k == 1, -self._w[at])
            + self._through(field, at, at + z, k == self._nz, self._w[at + z])
        )

    @ti.func
    def _through(self, field: ti.template(), at: ti.i32, neighbour: ti.i32, is_side: ti.i32, speed: ti.f32):
        """Upwind flux out of the air; clean air comes in from outside, and what was continued into solids from them."""
        flux = 0.0
        if is_side or self._obstacles.is_solid(neighbour):
            inside, beyond = field[at], ti.select(is_side, 0.0, field[neighbour])
            flux = ti.max(speed, 0.0) * inside + ti.min(speed, 0.0) * beyond
        return flux
