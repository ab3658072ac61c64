"""Carry fields along the flow: semi-Lagrangian (Stam 1999), or MacCormack with clamping (Selle et al. 2008).

Positions are counted in cells in the index space of the field that is looked up, so a face value is traced from its
own face and no offset of half a cell can creep in. The trace is one straight step with the velocity at its end, which
is first-order in time by itself; MacCormack's second pass corrects the error of the trace as well as of the look-up.
"""

import taichi as ti

from sim.core.parameters import Vector3
from sim.smoke.balance import CorrectionBalance
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import (
    RUN,
    has_runs,
    lane_count,
    lane_items,
    lane_place,
    lane_runs,
    new_run,
    rest_items,
    rest_place,
    run_start,
)


@ti.data_oriented
class Advection:
    """Advects cell and face fields of one grid.

    What is carried in through an open side is clean air at the air's temperature (0 in every cell field). It has the
    velocity of the air outside along the side; across it that on the side itself, which the pressure gives it. Beyond
    walls everything has the value of the nearest place inside.

    Args:
        grid: where the fields live.
        velocity: the three face velocities [m/s], flat fields.
        cell_fields: density and temperature excess, flat fields.
        work: six flat fields to work in.
        maccormack: whether to correct the semi-Lagrangian result.
        wind: velocity of the air outside [m/s].
        balance: keeps the totals of the cell fields in spite of the limiter, if given.
    """

    def __init__(
        self,
        grid: SmokeGrid,
        *,
        velocity: tuple,
        cell_fields: tuple,
        work: tuple,
        maccormack: bool,
        wind: Vector3 = (0.0, 0.0, 0.0),
        balance: CorrectionBalance | None = None,
    ) -> None:
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._size = grid.size
        self._u, self._v, self._w = velocity
        self._density, self._excess = cell_fields
        self._predicted_x, self._predicted_y, self._predicted_z, self._result_x, self._result_y, self._result_z = work
        self._cells_per_metre = 1.0 / grid.cell_size
        self._maccormack, self._wind, self._balance = maccormack, wind, balance
        self._lanes, self._in_runs = lane_count(), has_runs(grid.cells)
        # From these centres on outside air mixes in; walls keep smoke in, so theirs are out of reach.
        far = 1.0e9
        self._low = tuple(1.0 if grid.lets_in(axis, 0) else -far for axis in range(3))
        self._high = tuple(float(n) if grid.lets_in(axis, 1) else far for axis, n in enumerate(grid.cells))

    def advance(self, dt: float) -> None:
        """Advect all fields by dt [s] with the present velocity."""
        step = dt * self._cells_per_metre
        self._predict_cells(step)
        if self._maccormack:
            self._correct_cells(step)
            if self._balance is not None:
                self._balance.restore(self._density, self._predicted_x, self._result_x, step)
                self._balance.restore(self._excess, self._predicted_y, self._result_y, step)
            self._store_cells(self._result_x, self._result_y)
        else:
            self._store_cells(self._predicted_x, self._predicted_y)
        self._predict_faces(0, self._u, self._predicted_x, step)
        self._predict_faces(1, self._v, self._predicted_y, step)
        self._predict_faces(2, self._w, self._predicted_z, step)
        if self._maccormack:
            self._correct_faces(0, self._u, self._predicted_x, self._result_x, step)
            self._correct_faces(1, self._v, self._predicted_y, self._result_y, step)
            self._correct_faces(2, self._w, self._predicted_z, self._result_z, step)
            self._store_faces(self._result_x, self._result_y, self._result_z)
        else:
            self._store_faces(self._predicted_x, self._predicted_y, self._predicted_z)

    @ti.func
    def _velocity_at_cell(self, at: ti.i32):
        return ti.Vector(
            [
                0.5 * (self._u[at] + self._u[at + self._step_x]),
                0.5 * (self._v[at] + self._v[at + self._step_y]),
                0.5 * (self._w[at] + self._w[at + 1]),
            ]
        )

    @ti.func
    def _velocity_at_face(self, axis: ti.template(), i: ti.i32, j: ti.i32, k: ti.i32):
        """Own component on the face, mean of the four nearest faces for each other one."""
        # The cells on both sides of the face; beyond the box the one inside counts twice.
        below = self._row(i - 1, j, k)
        above = self._row(i, j, k)
        if ti.static(axis == 0):
            below, above = self._row(ti.max(i - 1, 1), j, k), self._row(ti.min(i, self._nx), j, k)
        elif ti.static(axis == 1):
            below, above = self._row(i, ti.max(j - 1, 1), k), self._row(i, ti.min(j, self._ny), k)
        else:
            below, above = self._row(i, j, ti.max(k - 1, 1)), self._row(i, j, ti.min(k, self._nz))
        velocity = 0.5 * (self._velocity_at_cell(below) + self._velocity_at_cell(above))
        own = self._row(i, j, k)
        if ti.static(axis == 0):
            velocity[0] = self._u[own]
        elif ti.static(axis == 1):
            velocity[1] = self._v[own]
        else:
            velocity[2] = self._w[own]
        return velocity

    @ti.func
    def _row(self, i: ti.i32, j: ti.i32, k: ti.i32):
        return i * self._step_x + j * self._step_y + k

    @ti.func
    def _locate(self, position, axis: ti.template()):
        """The lowest of the eight places around a position, and the position's offset from it in cells.

        Args:
            position: in cells.
            axis: across which the field's faces lie; 3 for cell fields.
        """
        place = ti.Vector([0, 0, 0])
        offset = ti.Vector([0.0, 0.0, 0.0])
        last = ti.static((self._nx + (axis == 0), self._ny + (axis == 1), self._nz + (axis == 2)))
        for a in ti.static(range(3)):
            inside = ti.max(1.0, ti.min(position[a], float(last[a])))
            place[a] = ti.max(1, ti.min(int(inside), last[a] - 1))
            offset[a] = inside - place[a]
        return self._row(place[0], place[1], place[2]), offset

    @ti.func
    def _interpolate(self, field: ti.template(), at: ti.i32, offset):
        """Trilinear value.

        Weights (1 - s) and s, not a + s (b - a): they give back a stored value to the bit at both ends of a cell.
        """
        x, y, z = offset[0], offset[1], offset[2]
        f = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for n in ti.static(range(4)):
            corner = at + (n // 2) * self._step_x + (n % 2) * self._step_y
            f[n] = (1.0 - z) * field[corner] + z * field[corner + 1]
        return (1.0 - x) * ((1.0 - y) * f[0] + y * f[1]) + x * ((1.0 - y) * f[2] + y * f[3])

    @ti.func
    def _clamp_to_corners(self, value: ti.f32, field: ti.template(), at: ti.i32):
        """Selle et al. 2008, section 4: no new extremum beyond the values that the look-up mixed."""
        low, high = field[at], field[at]
        for n in ti.static(range(1, 8)):
            corner = field[at + (n // 4) * self._step_x + (n // 2 % 2) * self._step_y + n % 2]
            low, high = ti.min(low, corner), ti.max(high, corner)
        return ti.max(low, ti.min(value, high))

    @ti.func
    def _beyond(self, position, axis: ti.template()):
        """How far the position of a cell lies beyond the last centres before open sides, by axis, in cells, up to 1.

        Args:
            position: in cells.
            axis: across which the field's faces lie, and where nothing counts as beyond; 3 for cell fields.
        """
        beyond = ti.Vector([0.0, 0.0, 0.0])
        for a in ti.static(range(3)):
            if ti.static(a != axis):
                beyond[a] = ti.min(ti.max(self._low[a] - position[a], position[a] - self._high[a], 0.0), 1.0)
        return beyond

    @ti.func
    def _kept(self, position, axis: ti.template()):
        """Weight of the nearest place inside in a look-up at a position; the rest is that of the air outside.

        As if it filled a layer of cells around the box: air that comes in mixes into the first cells from the start.
        """
        beyond = self._beyond(position, axis)
        return (1.0 - beyond[0]) * (1.0 - beyond[1]) * (1.0 - beyond[2])

    @ti.func
    def _has_no_past(self, position, axis: ti.template()):
        """Whether the position of a face across an axis, or of a cell, lies beyond the last place before a side."""
        is_beyond = False
        for a in ti.static(range(3)):
            half = ti.static(1.0 if a == axis else 0.0)
            is_beyond = is_beyond or position[a] < self._low[a] or position[a] > self._high[a] + half
        return is_beyond

    @ti.kernel
    def _predict_cells(self, step: ti.f32):
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = self._row(i, j, 0)
            if ti.static(self._in_runs):
                for run in range(lane_runs(self._nz)):
                    first = run_start(run)
                    densities, excesses = new_run(), new_run()
                    for m in range(RUN):
                        densities[m], excesses[m] = self._predicted_cell(i, j, first + m, step)
                    for m in range(RUN):
                        self._predicted_x[row + first + m] = densities[m]
                        self._predicted_y[row + first + m] = excesses[m]
            for n in range(rest_items(self._nz, lane, self._in_runs)):
                k = rest_place(self._nz, n, lane, self._in_runs)
                self._predicted_x[row + k], self._predicted_y[row + k] = self._predicted_cell(i, j, k, step)

    @ti.func
    def _predicted_cell(self, i: ti.i32, j: ti.i32, k: ti.i32, step: ti.f32):
        departure = ti.Vector([float(i), float(j), float(k)]) - step * self._velocity_at_cell(self._row(i, j, k))
        there, offset = self._locate(departure, 3)
        kept = self._kept(departure, 3)
        density = kept * self._interpolate(self._density, there, offset)
        return density, kept * self._interpolate(self._excess, there, offset)

    @ti.kernel
    def _correct_cells(self, step: ti.f32):
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = self._row(i, j, 0)
            if ti.static(self._in_runs):
                for run in range(lane_runs(self._nz)):
                    first = run_start(run)
                    densities, excesses = new_run(), new_run()
                    for m in range(RUN):
                        densities[m], excesses[m] = self._corrected_cell(i, j, first + m, step)
                    for m in range(RUN):
                        self._result_x[row + first + m] = densities[m]
                        self._result_y[row + first + m] = excesses[m]
            for n in range(rest_items(self._nz, lane, self._in_runs)):
                k = rest_place(self._nz, n, lane, self._in_runs)
                self._result_x[row + k], self._result_y[row + k] = self._corrected_cell(i, j, k, step)

    @ti.func
    def _corrected_cell(self, i: ti.i32, j: ti.i32, k: ti.i32, step: ti.f32):
        """phi = phi^ + (phi_n - phi_) / 2, where phi_ is phi^ carried back (Selle et al. 2008, eq. 5)."""
        at = self._row(i, j, k)
        here = ti.Vector([float(i), float(j), float(k)])
        shift = step * self._velocity_at_cell(at)
        there, offset = self._locate(here + shift, 3)
        density = self._predicted_x[at]
        excess = self._predicted_y[at]
        density += 0.5 * (self._density[at] - self._interpolate(self._predicted_x, there, offset))
        excess += 0.5 * (self._excess[at] - self._interpolate(self._predicted_y, there, offset))
        origin, _ = self._locate(here - shift, 3)
        density = self._clamp_to_corners(density, self._density, origin)
        excess = self._clamp_to_corners(excess, self._excess, origin)
        # Outside air has no past to compare with: there the first-order value stands. Selected, not branched over, so
        # that the loop can be vectorized.
        has_past = not (self._has_no_past(here - shift, 3) or self._has_no_past(here + shift, 3))
        density = ti.select(has_past, density, self._predicted_x[at])
        return density, ti.select(has_past, excess, self._predicted_y[at])

    @ti.kernel
    def _predict_faces(self, axis: ti.template(), field: ti.template(), predicted: ti.template(), step: ti.f32):
        for i, j, lane in ti.ndrange((1, self._nx + 1 + (axis == 0)), (1, self._ny + 1 + (axis == 1)), self._lanes):
            row, nz = self._row(i, j, 0), self._nz + (axis == 2)
            if ti.static(self._in_runs):
                for run in range(lane_runs(nz)):
                    first = run_start(run)
                    values = new_run()
                    for m in range(RUN):
                        values[m] = self._predicted_face(axis, field, i, j, first + m, step)
                    for m in range(RUN):
                        predicted[row + first + m] = values[m]
            for n in range(rest_items(nz, lane, self._in_runs)):
                k = rest_place(nz, n, lane, self._in_runs)
                predicted[row + k] = self._predicted_face(axis, field, i, j, k, step)

    @ti.func
    def _predicted_face(self, axis: ti.template(), field: ti.template(), i: ti.i32, j: ti.i32, k: ti.i32, step: ti.f32):
        departure = ti.Vector([float(i), float(j), float(k)]) - step * self._velocity_at_face(axis, i, j, k)
        there, offset = self._locate(departure, axis)
        kept = self._kept(departure, axis)
        return kept * self._interpolate(field, there, offset) + (1.0 - kept) * self._wind[axis]

    @ti.kernel
    def _correct_faces(
        self,
        axis: ti.template(),
        field: ti.template(),
        predicted: ti.template(),
        result: ti.template(),
        step: ti.f32,
    ):
        for i, j, lane in ti.ndrange((1, self._nx + 1 + (axis == 0)), (1, self._ny + 1 + (axis == 1)), self._lanes):
            row, nz = self._row(i, j, 0), self._nz + (axis == 2)
            if ti.static(self._in_runs):
                for run in range(lane_runs(nz)):
                    first = run_start(run)
                    values = new_run()
                    for m in range(RUN):
                        values[m] = self._corrected_face(axis, field, predicted, i, j, first + m, step)
                    for m in range(RUN):
                        result[row + first + m] = values[m]
            for n in range(rest_items(nz, lane, self._in_runs)):
                k = rest_place(nz, n, lane, self._in_runs)
                result[row + k] = self._corrected_face(axis, field, predicted, i, j, k, step)

    @ti.func
    def _corrected_face(
        self,
        axis: ti.template(),
        field: ti.template(),
        predicted: ti.template(),
        i: ti.i32,
        j: ti.i32,
        k: ti.i32,
        step: ti.f32,
    ):
        at = self._row(i, j, k)
        here = ti.Vector([float(i), float(j), float(k)])
        shift = step * self._velocity_at_face(axis, i, j, k)
        there, offset = self._locate(here + shift, axis)
        value = predicted[at] + 0.5 * (field[at] - self._interpolate(predicted, there, offset))
        origin, _ = self._locate(here - shift, axis)
        value = self._clamp_to_corners(value, field, origin)
        has_past = not (self._has_no_past(here - shift, axis) or self._has_no_past(here + shift, axis))
        return ti.select(has_past, value, predicted[at])

    @ti.kernel
    def _store_cells(self, density: ti.template(), excess: ti.template()):
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            for n in range(lane_items(self._nz, lane)):
                k = lane_place(n, lane)
                at = self._row(i, j, k)
                self._density[at] = density[at]
                self._excess[at] = excess[at]

    @ti.kernel
    def _store_faces(self, u: ti.template(), v: ti.template(), w: ti.template()):
        """Copy the faces; beyond the last cells, only those across the axis exist."""
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            for n in range(lane_items(self._nz + 1, lane)):
                k = lane_place(n, lane)
                at = self._row(i, j, k)
                if j <= self._ny and k <= self._nz:
                    self._u[at] = u[at]
                if i <= self._nx and k <= self._nz:
                    self._v[at] = v[at]
                if i <= self._nx and j <= self._ny:
                    self._w[at] = w[at]
