"""Carry smoke and heat along the flow as fluxes between cells: flux-corrected transport.

Every flux leaves one cell and enters another, so nothing is made or lost but through open sides, and nothing passes a
closed face. A donor cell gives the share c = u dt/h of what it holds through each face that the air leaves by, which is
positive while no cell gives more than it has, but spreads: it is a random walk, by one cell along an axis with the
probability c. The moments that this walk has beyond its mean, the way of the flow, are taken back as fluxes

    A_x = |c_x| (1 - |c_x|) / 2 dL/dx - c_x c_y / 2 dL/dy - c_x c_z / 2 dL/dz
          - c_x (1 - |c_x|) (1 - 2 |c_x|) / 6 d2L/dx2

of the result L of the walk (Boris & Book 1976 call that form phoenical), and as far as no cell leaves the range of what
it held and was given (Zalesak 1979, J. Comput. Phys. 31:335-362, section 4). Such limits act on the front and the rear
of a cloud alike and do not shift it; limited corrections of cells, as MacCormack's scheme has them, cut its rear alone.
"""

import math

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces
from sim.smoke.lanes import cell_counts, fill_row, fill_rows, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Air, is_solid
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place

KEEPS_OFF = 1.0e-6
"""Part of the way to a bound that limited fluxes leave: more than rounding of their sum."""


class Transport:
    """Carries the density and the excess temperature of one grid.

    What comes in through open sides is clean air at the air's temperature. Into and out of solids that move flows what
    was continued into them; the cells in them keep that.

    Args:
        air: whose state is carried.
        work: six arrays to work in.
        sharpens: whether what the donor cells spread is taken back.
    """

    def __init__(self, air: Air, work: tuple[ti.Ndarray, ...], *, sharpens: bool) -> None:
        self._air, self._rows, self._sharpens = air, new_rows(air.box), sharpens
        self._spread, self._fluxes, self._kept = work[0], Faces(*work[1:4]), work[4:6]

    def advance(self, step: float) -> None:
        """Carry both by a step over the edge of a cell [s/m], in parts in which no cell gives more than it has."""
        given, _ = _largest_outflow(self._air, step, self._rows)
        parts = max(1, math.ceil(given))
        for values in (self._air.state.density, self._air.state.excess):
            for _ in range(parts):
                self._carry(values, step / parts)

    def _carry(self, values: ti.Ndarray, step: float) -> None:
        air, spread, fluxes, (leaving, coming) = self._air, self._spread, self._fluxes, self._kept
        _spread(air, values, spread, step)
        if self._sharpens:
            _find_fluxes(air, spread, fluxes, step)
            _limit(air, values, spread, fluxes, leaving, coming, step)
            _sharpen(air, values, spread, fluxes, leaving, coming)
        else:
            _store(air, values, spread)


@kernel
def _largest_outflow(air: Air, step: ti.f32, rows: Rows) -> Pair:
    """The largest share of itself that a cell of air gives in a step over the edge of a cell [-]."""
    box, velocity = ti.static((air.box, air.state.velocity))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        largest = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at, given = row_start(box, i, j) + lane_place(box, n, lane), 0.0
            for axis in ti.static(range(3)):
                face = ti.static((velocity.x, velocity.y, velocity.z)[axis])
                given += ti.max(face[at + steps(box)[axis]], 0.0) + ti.max(-face[at], 0.0)
            largest = ti.max(largest, ti.select(is_solid(air.solids, at), 0.0, step * given))
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([largest, 0.0])
    find_maxima(rows)
    return rows.nodes[0]


@kernel
def _spread(air: Air, values: Floats, spread: Floats, step: ti.f32):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        given = ti.static((i, j, air, values, step))
        fill_row(air.box, spread, row_start(air.box, i, j), air.box.nz, lane, _spread_cell, given)


@kernel
def _find_fluxes(air: Air, spread: Floats, fluxes: Faces, step: ti.f32):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        outs, given = ti.static((fluxes.x, fluxes.y, fluxes.z), (i, j, air, spread, step))
        fill_rows(air.box, outs, row_start(air.box, i, j), air.box.nz, lane, _fluxes_into, given)


@kernel
def _limit(air: Air, values: Floats, spread: Floats, fluxes: Faces, leaving: Floats, coming: Floats, step: ti.f32):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        outs, given = ti.static((leaving, coming), (i, j, air, values, spread, fluxes, step))
        fill_rows(air.box, outs, row_start(air.box, i, j), air.box.nz, lane, _kept_shares, given)


@kernel
def _sharpen(air: Air, values: Floats, spread: Floats, fluxes: Faces, leaving: Floats, coming: Floats):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        given = ti.static((i, j, air, values, spread, fluxes, leaving, coming))
        fill_row(air.box, values, row_start(air.box, i, j), air.box.nz, lane, _sharpened, given)


@kernel
def _store(air: Air, values: Floats, spread: Floats):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        for n in range(lane_items(air.box, air.box.nz, lane)):
            at = row_start(air.box, i, j) + lane_place(air.box, n, lane)
            if not is_solid(air.solids, at):
                values[at] = spread[at]


@func
def _spread_cell(k: ti.i32, i: ti.i32, j: ti.i32, air: Air, values: Floats, step: ti.f32) -> ti.f32:
    at, here = row_start(air.box, i, j) + k, ti.Vector([i, j, k])
    lost = 0.0
    for axis in ti.static(range(3)):
        along = steps(air.box)[axis]
        lost += _given(at + along, here[axis] + 1, axis, air, values, step) - _given(
            at, here[axis], axis, air, values, step
        )
    return values[at] - lost


@func
def _given(at: ti.i32, p: ti.i32, axis: ti.template(), air: Air, values: Floats, step: ti.f32) -> ti.f32:
    """What the donor gives through the face before the p-th cell along an axis, which is at `at`."""
    crossed = step * _face_velocity(air, axis, at)
    before = ti.select(p > 1, values[at - steps(air.box)[axis]], 0.0)
    after = ti.select(p <= cell_counts(air.box)[axis], values[at], 0.0)
    return ti.max(crossed, 0.0) * before + ti.min(crossed, 0.0) * after


@func
def _face_velocity(air: Air, axis: ti.template(), at: ti.i32) -> ti.f32:
    return ti.static((air.state.velocity.x, air.state.velocity.y, air.state.velocity.z)[axis])[at]


@func
def _fluxes_into(k: ti.i32, i: ti.i32, j: ti.i32, air: Air, spread: Floats, step: ti.f32):
    at, here = row_start(air.box, i, j) + k, ti.Vector([i, j, k])
    return (
        _flux(at, here, 0, air, spread, step),
        _flux(at, here, 1, air, spread, step),
        _flux(at, here, 2, air, spread, step),
    )


@func
def _flux(at: ti.i32, here, axis: ti.template(), air: Air, spread: Floats, step: ti.f32) -> ti.f32:
    """What is taken back, into the cell at `at` from the one before it along the axis; nothing through sides."""
    openness = ti.static((air.openness.x, air.openness.y, air.openness.z)[axis])
    count, along, p = cell_counts(air.box), steps(air.box)[axis], here[axis]
    crossed = step * _face_velocity(air, axis, at)
    moved = ti.abs(crossed)
    # In the planes beside the sides the cells beyond are in memory, but none.
    ahead, behind = at + along, at - 2 * along
    if ti.static(axis == 0):
        ahead, behind = at + along * int(p < count[axis]), at - along - along * int(p > 2)
    bend = (spread[ahead] - spread[at]) - (spread[at - along] - spread[behind])
    lean = ti.select((p > 2) & (p < count[axis]), crossed * (1.0 - moved) * (1.0 - 2.0 * moved) / 12.0, 0.0)
    flux = 0.5 * moved * (1.0 - moved) * (spread[at] - spread[at - along]) - lean * bend
    for other in ti.static((axis + 1) % 3, (axis + 2) % 3):
        across, q = steps(air.box)[other], here[other]
        aside = _face_velocity(air, other, at) + _face_velocity(air, other, at + across)
        aside += _face_velocity(air, other, at - along) + _face_velocity(air, other, at - along + across)
        rise = (spread[at + across] - spread[at - across]) + (spread[at - along + across] - spread[at - along - across])
        is_inner = (q > 1) & (q < count[other])
        flux -= ti.select(is_inner, crossed * (step * aside) * rise / 32.0, 0.0)
    is_open = (p > 1) & (openness[at] > 0.0)
    return ti.select(is_open, flux, 0.0)


@func
def _kept_shares(
    k: ti.i32, i: ti.i32, j: ti.i32, air: Air, values: Floats, spread: Floats, fluxes: Faces, step: ti.f32
):
    """Shares of what leaves a cell and of what comes in that keep it in its range."""
    at, here = row_start(air.box, i, j) + k, ti.Vector([i, j, k])
    low, high, losses, gains = values[at], values[at], 0.0, 0.0
    for axis in ti.static(range(3)):
        along, count = steps(air.box)[axis], cell_counts(air.box)[axis]
        flux = ti.static((fluxes.x, fluxes.y, fluxes.z)[axis])
        into, out = flux[at], ti.select(here[axis] < count, flux[at + along], 0.0)
        gains += ti.max(into, 0.0) + ti.max(-out, 0.0)
        losses += ti.max(-into, 0.0) + ti.max(out, 0.0)
        before = ti.select(here[axis] > 1, values[at - along], 0.0)
        after = ti.select(here[axis] < count, values[at + along], 0.0)
        before = ti.select(step * _face_velocity(air, axis, at) > 0.0, before, values[at])
        after = ti.select(step * _face_velocity(air, axis, at + along) < 0.0, after, values[at])
        low, high = ti.min(low, ti.min(before, after)), ti.max(high, ti.max(before, after))
    return _share(spread[at] - low, losses), _share(high - spread[at], gains)


@ti.func
def _share(room: ti.f32, wanted: ti.f32) -> ti.f32:
    """Part of what is wanted that there is room for [-]."""
    room = ti.max(room, 0.0) * ti.static(1.0 - KEEPS_OFF)
    return ti.select(wanted > room, room / ti.max(wanted, 1.0e-30), 1.0)


@func
def _sharpened(
    k: ti.i32,
    i: ti.i32,
    j: ti.i32,
    air: Air,
    values: Floats,
    spread: Floats,
    fluxes: Faces,
    leaving: Floats,
    coming: Floats,
) -> ti.f32:
    at, here = row_start(air.box, i, j) + k, ti.Vector([i, j, k])
    change = 0.0
    for axis in ti.static(range(3)):
        along = steps(air.box)[axis]
        flux = ti.static((fluxes.x, fluxes.y, fluxes.z)[axis])
        out = _limited(flux[at + along], at + along, along, leaving, coming)
        change += _limited(flux[at], at, along, leaving, coming) - ti.select(
            here[axis] < cell_counts(air.box)[axis], out, 0.0
        )
    return ti.select(is_solid(air.solids, at), values[at], spread[at] + change)


@func
def _limited(flux: ti.f32, at: ti.i32, along: ti.i32, leaving: Floats, coming: Floats) -> ti.f32:
    """A flux into the cell at `at` from the one before, as far as both bear it."""
    forth, back = ti.min(leaving[at - along], coming[at]), ti.min(leaving[at], coming[at - along])
    return flux * ti.select(flux > 0.0, forth, back)
