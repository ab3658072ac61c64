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

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, lane_items, lane_place, row_start
from sim.smoke.obstacles import Air, Solids, is_solid
from sim.smoke.reductions import Rows, partial_place, sum_up


@kernel
def restore_total(
    air: Air,
    values: Floats,
    predicted: Floats,
    corrected: Floats,
    missing_rows: Rows,
    correction_rows: Rows,
    step: ti.f32,
):
    """Bring the total of the corrected values of cells to what it must be.

    Exact for the total over all air cells of a closed box without moving obstacles, but for rounding and for steps in
    which no factor in [0, 1] reaches it. What leaves through open sides is balanced to second order; through the sides
    of moving solids flows what an upwind scheme has flow in the step, so their smoke is balanced to first order.

    Values are those before the step, of a length over the edge of a cell [s/m], `predicted` the semi-Lagrangian result
    and `corrected` the limited one, which is changed.
    """
    box, solids, velocity = ti.static((air.box, air.solids, air.state.velocity))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        missing, raised, lowered = 0.0, 0.0, 0.0
        for n in range(lane_items(box, box.nz, lane)):
            k = lane_place(box, n, lane)
            at = row_start(box, i, j) + k
            if not is_solid(solids, at):
                correction = corrected[at] - predicted[at]
                raised += ti.max(correction, 0.0)
                lowered += ti.min(correction, 0.0)
                missing += (values[at] - corrected[at]) - _outflow(box, solids, velocity, values, i, j, k, step)
        place = partial_place(box, i, j, lane)
        missing_rows.partial[place] = ti.Vector([missing, 0.0])
        correction_rows.partial[place] = ti.Vector([raised, lowered])
    sum_up(missing_rows)
    sum_up(correction_rows)
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        missing, both = missing_rows.nodes[0][0], correction_rows.nodes[0]
        keep_raised, keep_lowered = 1.0, 1.0
        if missing < 0.0:
            keep_raised = _kept(missing, both[0])
        else:
            keep_lowered = _kept(missing, both[1])
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            correction = corrected[at] - predicted[at]
            if correction > 0.0:
                corrected[at] = predicted[at] + keep_raised * correction
            else:
                corrected[at] = predicted[at] + keep_lowered * correction


@func
def _kept(missing: ti.f32, corrections: ti.f32):
    """Part of the corrections, of the sign opposite to what is missing, that closes the balance."""
    part = 1.0
    if corrections != 0.0:
        part = ti.max(0.0, ti.min(1.0 + missing / corrections, 1.0))
    return part


@func
def _outflow(box: Grid, solids: Solids, velocity: Faces, values: Floats, i: ti.i32, j: ti.i32, k: ti.i32, step: ti.f32):
    """What leaves the air through the faces of a cell in the step, in cells full of it."""
    at, x, y = row_start(box, i, j) + k, box.step_x, box.step_y
    return (
        _through(solids, values, at, -x, i == 1, -step * velocity.x[at])
        + _through(solids, values, at, x, i == box.nx, step * velocity.x[at + x])
        + _through(solids, values, at, -y, j == 1, -step * velocity.y[at])
        + _through(solids, values, at, y, j == box.ny, step * velocity.y[at + y])
        + _through(solids, values, at, -1, k == 1, -step * velocity.z[at])
        + _through(solids, values, at, 1, k == box.nz, step * velocity.z[at + 1])
    )


@func
def _through(solids: Solids, values: Floats, at: ti.i32, beside: ti.i32, is_side: ti.i32, crossed: ti.f32):
    """Flux out of the air through a face, of air that crosses so many cells in the step.

    Clean air comes in from outside, and what was continued into solids from them. What leaves through a side is
    what a straight line through the last two cells has within the way to it; between nothing and twice as much
    as the last one holds, as beyond its foot such a line goes below zero.
    """
    flux = 0.0
    if is_side or is_solid(solids, at + beside):
        inside, beyond = values[at], values[at + beside]
        if is_side:
            leaving = inside + 0.5 * (1.0 - crossed) * (inside - values[at - beside])
            twice = 2.0 * inside
            inside, beyond = ti.max(ti.min(leaving, ti.max(twice, 0.0)), ti.min(twice, 0.0)), 0.0
        flux = ti.max(crossed, 0.0) * inside + ti.min(crossed, 0.0) * beyond
    return flux
