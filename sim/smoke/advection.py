"""Carry velocity along the flow: semi-Lagrangian (Stam 1999), or MacCormack with clamping (Selle et al. 2008).

Positions are counted in cells in the index space of the faces that are looked up, so a face value is traced from its
own face and no offset of half a cell can creep in. The trace is one straight step with the velocity at its end, which
is first-order in time by itself; MacCormack's second pass corrects the error of the trace as well as of the look-up.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.smoke.arrays import Faces
from sim.smoke.grid import SmokeGrid
from sim.smoke.lanes import Grid, cell_counts, fill_row, lane_items, lane_place, row_start
from sim.smoke.obstacles import Air

FAR = 1.0e9  # beyond every box [cells]


@bundle
class Outside(NamedTuple):
    """The air outside of the box."""

    low: ti.math.vec3  # centres below or above which it mixes in [cells]; walls keep it out, so theirs are far away
    high: ti.math.vec3
    wind: ti.math.vec3  # its velocity [m/s]


class Advection:
    """Advects the velocity of one grid.

    What is carried in through an open side has along it the velocity of the air outside; across it that on the side
    itself, which the pressure gives it. Beyond walls everything has the value of the nearest place inside.
    """

    def __init__(
        self,
        grid: SmokeGrid,
        air: Air,
        work: tuple[ti.Ndarray, ...],
        *,
        maccormack: bool,
    ) -> None:
        """Take the air of a grid, and six arrays to work in."""
        self._air, self._cells_per_metre = air, 1.0 / grid.cell_size
        self._predicted, self._corrected = Faces(*work[:3]), Faces(*work[3:])
        self._maccormack = maccormack
        low = (1.0 if grid.lets_in(axis, 0) else -FAR for axis in range(3))
        high = (float(n) if grid.lets_in(axis, 1) else FAR for axis, n in enumerate(grid.cells))
        self._low, self._high = ti.math.vec3(*low), ti.math.vec3(*high)

    def advance(self, dt: float, wind: Vector3 = (0.0, 0.0, 0.0)) -> None:
        """Advect by dt [s] with the present velocity; the air outside has that of a wind [m/s]."""
        step, outside = dt * self._cells_per_metre, Outside(self._low, self._high, ti.math.vec3(wind))
        box, state = self._air.box, self._air.state
        predicted, corrected = self._predicted, self._corrected
        for axis in range(3):
            _predict_faces(axis, box, outside, state.velocity, predicted[axis], step)
        if self._maccormack:
            for axis in range(3):
                _correct_faces(axis, box, outside, state.velocity, predicted[axis], corrected[axis], step)
        _store_faces(box, state.velocity, corrected if self._maccormack else predicted)


@kernel
def _predict_faces(axis: ti.template(), box: Grid, outside: Outside, velocity: Faces, predicted: Floats, step: ti.f32):
    extra_x, extra_y, extra_z = ti.static(int(axis == 0), int(axis == 1), int(axis == 2))
    for i, j, lane in ti.ndrange((1, box.nx + 1 + extra_x), (1, box.ny + 1 + extra_y), box.lanes):
        given = ti.static((i, j, axis, box, outside, velocity, step))
        fill_row(box, predicted, row_start(box, i, j), box.nz + extra_z, lane, _predicted_face, given)


@kernel
def _correct_faces(
    axis: ti.template(),
    box: Grid,
    outside: Outside,
    velocity: Faces,
    predicted: Floats,
    corrected: Floats,
    step: ti.f32,
):
    extra_x, extra_y, extra_z = ti.static(int(axis == 0), int(axis == 1), int(axis == 2))
    for i, j, lane in ti.ndrange((1, box.nx + 1 + extra_x), (1, box.ny + 1 + extra_y), box.lanes):
        given = ti.static((i, j, axis, box, outside, velocity, predicted, step))
        fill_row(box, corrected, row_start(box, i, j), box.nz + extra_z, lane, _corrected_face, given)


@kernel
def _store_faces(box: Grid, velocity: Faces, result: Faces):
    """Copy the faces; beyond the last cells, only those across the axis exist."""
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        for n in range(lane_items(box, box.nz + 1, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            if j <= box.ny and k <= box.nz:
                velocity.x[at] = result.x[at]
            if i <= box.nx and k <= box.nz:
                velocity.y[at] = result.y[at]
            if i <= box.nx and j <= box.ny:
                velocity.z[at] = result.z[at]


@func
def _predicted_face(
    k: ti.i32, i: ti.i32, j: ti.i32, axis: ti.template(), box: Grid, outside: Outside, velocity: Faces, step: ti.f32
):
    face = ti.static((velocity.x, velocity.y, velocity.z)[axis])
    departure = ti.Vector([float(i), float(j), float(k)]) - step * _velocity_at_face(box, velocity, axis, i, j, k)
    there, offset = _locate(box, departure, axis)
    kept = _kept(outside, departure, axis)
    return kept * _interpolate(box, face, there, offset) + (1.0 - kept) * outside.wind[axis]


@func
def _corrected_face(
    k: ti.i32,
    i: ti.i32,
    j: ti.i32,
    axis: ti.template(),
    box: Grid,
    outside: Outside,
    velocity: Faces,
    predicted: Floats,
    step: ti.f32,
):
    face = ti.static((velocity.x, velocity.y, velocity.z)[axis])
    at = row_start(box, i, j) + k
    here = ti.Vector([float(i), float(j), float(k)])
    shift = step * _velocity_at_face(box, velocity, axis, i, j, k)
    there, offset = _locate(box, here + shift, axis)
    value = predicted[at] + 0.5 * (face[at] - _interpolate(box, predicted, there, offset))
    origin, _ = _locate(box, here - shift, axis)
    value = _clamp_to_corners(box, value, face, origin)
    return ti.select(_has_past(outside, here, shift, axis), value, predicted[at])


@func
def _velocity_at_cell(box: Grid, velocity: Faces, at: ti.i32):
    return ti.Vector(
        [
            0.5 * (velocity.x[at] + velocity.x[at + box.step_x]),
            0.5 * (velocity.y[at] + velocity.y[at + box.step_y]),
            0.5 * (velocity.z[at] + velocity.z[at + 1]),
        ]
    )


@func
def _velocity_at_face(box: Grid, velocity: Faces, axis: ti.template(), i: ti.i32, j: ti.i32, k: ti.i32):
    """Own component on the face, mean of the four nearest faces for each other one."""
    # The cells on both sides of the face; beyond the box the one inside counts twice.
    below, above = ti.Vector([i, j, k]), ti.Vector([i, j, k])
    below[axis] = ti.max(below[axis] - 1, 1)
    above[axis] = ti.min(above[axis], cell_counts(box)[axis])
    at_below = row_start(box, below[0], below[1]) + below[2]
    at_above = row_start(box, above[0], above[1]) + above[2]
    mean = 0.5 * (_velocity_at_cell(box, velocity, at_below) + _velocity_at_cell(box, velocity, at_above))
    mean[axis] = ti.static((velocity.x, velocity.y, velocity.z)[axis])[row_start(box, i, j) + k]
    return mean


@func
def _locate(box: Grid, position, axis: ti.template()):
    """The lowest of the eight places around a position in cells, and the position's offset from it.

    Positions are in the index space of the faces across an axis, or of cells for axis 3.
    """
    place = ti.Vector([0, 0, 0])
    offset = ti.Vector([0.0, 0.0, 0.0])
    last = cell_counts(box)
    if ti.static(axis < 3):
        last[axis] += 1
    for a in ti.static(range(3)):
        inside = ti.max(1.0, ti.min(position[a], float(last[a])))
        place[a] = ti.max(1, ti.min(int(inside), last[a] - 1))
        offset[a] = inside - place[a]
    return row_start(box, place[0], place[1]) + place[2], offset


@func
def _interpolate(box: Grid, values: Floats, at: ti.i32, offset):
    """Trilinear value.

    Weights (1 - s) and s, not a + s (b - a): they give back a stored value to the bit at both ends of a cell.
    """
    x, y, z = offset[0], offset[1], offset[2]
    f = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for n in ti.static(range(4)):
        corner = at + (n // 2) * box.step_x + (n % 2) * box.step_y
        f[n] = (1.0 - z) * values[corner] + z * values[corner + 1]
    return (1.0 - x) * ((1.0 - y) * f[0] + y * f[1]) + x * ((1.0 - y) * f[2] + y * f[3])


@func
def _clamp_to_corners(box: Grid, value: ti.f32, values: Floats, at: ti.i32):
    """Selle et al. 2008, section 4: no new extremum beyond the values that the look-up mixed."""
    low, high = values[at], values[at]
    for n in ti.static(range(1, 8)):
        corner = values[at + (n // 4) * box.step_x + (n // 2 % 2) * box.step_y + n % 2]
        low, high = ti.min(low, corner), ti.max(high, corner)
    return ti.max(low, ti.min(value, high))


@func
def _kept(outside: Outside, position, axis: ti.template()):
    """Weight of the nearest place inside in a look-up at a position; the rest is that of the air outside.

    As if it filled a layer of cells around the box: air that comes in mixes into the first cells from the start.
    Nothing counts as beyond the sides across the axis of the faces.
    """
    beyond = ti.Vector([0.0, 0.0, 0.0])
    for a in ti.static(range(3)):
        if ti.static(a != axis):
            beyond[a] = ti.min(ti.max(outside.low[a] - position[a], position[a] - outside.high[a], 0.0), 1.0)
    return (1.0 - beyond[0]) * (1.0 - beyond[1]) * (1.0 - beyond[2])


@func
def _has_past(outside: Outside, here, shift, axis: ti.template()):
    """Whether neither the trace back nor the one ahead ends beyond the last place before an open side.

    Without branches, so that loops can be vectorized.
    """
    is_beyond = 0
    for a in ti.static(range(3)):
        last = outside.high[a] + ti.static(1.0 if a == axis else 0.0)
        low, high = here[a] - ti.abs(shift[a]), here[a] + ti.abs(shift[a])
        is_beyond |= int(low < outside.low[a]) | int(high > last)
    return is_beyond == 0
