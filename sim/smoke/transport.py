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

Cells that solids cut have a part V of their volume, and parts A of their faces: A u flows through, and a cell holds V
times its density. Small cells share what they hold with their keeper (`sim.smoke.cut_cells`) after each walk. Where
solids move the air that has flowed out of a cell, sum A u dt/h, is not the change of V to the last bit: it is counted,
V - sum A u dt/h, and smoke has the density that it has in that air; so even smoke stays even, and what is in a cell
that is covered goes to its keeper. Beside solids the moments across axes and the third ones are left.
"""

import math

import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces, new_floats
from sim.smoke.combustion import Combustion
from sim.smoke.cut_cells import CHANGES, KEEPER, LEAST_VOLUME, NEAR_SOLIDS, keeper_of, way
from sim.smoke.lanes import Grid, cell_counts, fill_row, fill_rows, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Air, Solids, flux_part, mean_volume
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place

# Rows of cells, counted from the nearest one that holds anything, in which each part of a step is computed: beyond them
# it would find 0. A walk goes one row, what small cells share two; what is taken back acts three beyond that. Each part
# has from the one before it what it reads around itself.
SHARPENED, LIMITED, FLUXES, KEPT, SPREAD = 6, 7, 8, 10, 12
LEAST_ROOM = 1.0e-3  # of cells beside moving solids that tells a density [cells]
KEEPS_OFF = 1.0e-6
"""Part of the way to a bound that limited fluxes leave: more than rounding of their sum."""


class Transport:
    """Carries the density and the excess temperature of one grid, and the fuel if there is any.

    What comes in through open sides is clean air at the air's temperature. Cells in solids hold nothing. Where gas
    expands its smoke is spread over more room; heat and fuel are those of the gas, and stay.

    Args:
        air: whose state is carried.
        work: six arrays to work in.
        sharpens: whether what the donor cells spread is taken back.
        combustion: the fuel, and how much gas expands.
    """

    def __init__(
        self, air: Air, work: tuple[ti.Ndarray, ...], *, sharpens: bool, combustion: Combustion | None = None
    ) -> None:
        of_gas = [air.state.excess] if combustion is None else [air.state.excess, combustion.fuel]
        self._carried = [(air.state.density, False), *((values, combustion is not None) for values in of_gas)]
        self._expansion = new_floats(1) if combustion is None else combustion.expansion
        self._expands = combustion is not None
        self._air, self._rows, self._sharpens = air, new_rows(air.box), sharpens
        self._spread, self._fluxes, self._kept = work[0], Faces(*work[1:4]), work[4:6]
        solids = air.solids
        self._room = new_floats(solids.volume.shape[0]) if solids.moving else solids.volume
        # Donor cells alone take so little that nothing is left out, as if all rows held something.
        self._filled, self._beside, self._near = (ti.ndarray(ti.i32, air.box.nx * air.box.ny) for _ in range(3))

    def advance(self, step: float) -> None:
        """Carry all by a step over the edge of a cell [s/m], in parts in which no cell gives more than it has."""
        given, _ = _largest_outflow(self._air, step, self._rows)
        parts = max(1, math.ceil(given))
        for values, grows in self._carried:
            if self._air.solids.moving:
                _start(self._air, values, self._room)
            for part in range(parts):
                self._carry(values, step / parts, grows=grows, is_last=part == parts - 1)

    def _carry(self, values: ti.Ndarray, step: float, *, grows: bool, is_last: bool) -> None:
        air, spread, fluxes, (leaving, coming) = self._air, self._spread, self._fluxes, self._kept
        volume, near = self._room, self._near
        if self._sharpens:
            _find_near(air.box, values, self._filled, self._beside, near)
        if air.solids.cuts:
            _spread(air, near, values, volume, fluxes.x, step, self._expansion, grows)
            if air.solids.moving:
                _drain(air, self._room, step, self._expansion, self._expands)
                volume = air.solids.volume if is_last else volume
            _keep(air, near, fluxes.x, values, self._room, volume, spread)
        else:
            _spread(air, near, values, volume, spread, step, self._expansion, grows)
        if self._sharpens:
            _find_fluxes(air, near, spread, fluxes, step)
            _limit(air, near, values, spread, fluxes, volume, leaving, coming, step)
            _sharpen(air, near, values, spread, fluxes, volume, leaving, coming)
        else:
            values.copy_from(spread)


@kernel
def _largest_outflow(air: Air, step: ti.f32, rows: Rows) -> Pair:
    """The largest share of itself that a cell, with those that it keeps, gives in a step over the edge of one [-]."""
    box, solids = ti.static((air.box, air.solids))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        largest = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            given = step * _outflow(air, at)
            if ti.static(air.solids.cuts):
                code, held = solids.words[at] & 7, _held(solids, at)
                if code == KEEPER:
                    for direction in ti.static(range(6)):
                        there = at + way(box, direction)
                        if (solids.words[there] & 7) == ti.static((direction ^ 1) + 1):
                            given += step * _outflow(air, there)
                            held += _held(solids, there)
                is_counted = keeper_of(code, at, box) == at and held > 0.0
                given = ti.select(is_counted, given / ti.max(held, ti.static(LEAST_VOLUME)), 0.0)
            largest = ti.max(largest, given)
        rows.partial[partial_place(box, i, j, lane)] = ti.Vector([largest, 0.0])
    find_maxima(rows)
    return rows.nodes[0]


@func
def _outflow(air: Air, at: ti.i32) -> ti.f32:
    """Velocity of what leaves a cell, summed over its faces [m/s]."""
    given = 0.0
    for axis in ti.static(range(3)):
        given += ti.max(_face_flux(air, axis, at + steps(air.box)[axis]), 0.0) + ti.max(-_face_flux(air, axis, at), 0.0)
    return given


@func
def _held(solids: Solids, at: ti.i32) -> ti.f32:
    """The least open part of a cell in a step, of a cell that is covered that of before."""
    held = solids.volume[at]
    if ti.static(solids.moving):
        held = ti.select(held > 0.0, ti.min(held, solids.before[at]), solids.before[at])
    return held


@func
def _size(solids: Solids, volume: Floats, at: ti.i32) -> ti.f32:
    """Open part of a cell, where there are solids [-]."""
    size = 1.0
    if ti.static(solids.cuts):
        size = volume[at]
    return size


@kernel
def _start(air: Air, values: Floats, room: Floats):
    """Begin with the open parts of before the step; cells that were closed give at first what is around them."""
    box, solids = ti.static((air.box, air.solids))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            room[at] = solids.before[at]
            if solids.before[at] == 0.0 and solids.volume[at] > 0.0:
                total, count = 0.0, 0.0
                for axis, openness in ti.static(enumerate((air.openness.x, air.openness.y, air.openness.z))):
                    pair, along = 0.0, steps(box)[axis]
                    for side in ti.static(range(2)):
                        there = at + ti.static(2 * side - 1) * along
                        # Ghosts hold nothing, and air from outside is clean.
                        if solids.before[there] > 0.0 and openness[at + side * along] > 0.0:
                            pair += values[there]
                            count += 1.0
                    total += pair
                values[at] = total / ti.max(count, 1.0)


@kernel
def _find_near(box: Grid, values: Floats, filled: Integers, beside: Integers, near: Integers):
    """How many rows each row of cells is off the nearest one that holds anything, along x or y, `SPREAD` + 1 at most.

    `filled` and `beside` are to work in: whether a row holds anything, and the distance along y alone.
    """
    for row in range(box.nx * box.ny):
        filled[row] = 0
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        holds = 0
        for n in range(lane_items(box, box.nz, lane)):
            holds |= int(values[row_start(box, i, j) + lane_place(box, n, lane)] != 0.0)
        if holds != 0:
            filled[_row(box, i, j)] = 1  # whichever lanes do so
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        least = SPREAD + 1
        for other in range(ti.max(1, j - SPREAD), ti.min(box.ny, j + SPREAD) + 1):
            if filled[_row(box, i, other)] != 0:
                least = ti.min(least, ti.abs(other - j))
        beside[_row(box, i, j)] = least
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        least = SPREAD + 1
        for other in range(ti.max(1, i - SPREAD), ti.min(box.nx, i + SPREAD) + 1):
            least = ti.min(least, ti.max(ti.abs(other - i), beside[_row(box, other, j)]))
        near[_row(box, i, j)] = least


@func
def _row(box: Grid, i: ti.i32, j: ti.i32) -> ti.i32:
    """Number of a row of cells, from 0."""
    return (i - 1) * box.ny + j - 1


@kernel
def _spread(
    air: Air,
    near: Integers,
    values: Floats,
    room: Floats,
    spread: Floats,
    step: ti.f32,
    expansion: Floats,
    grows: ti.template(),
):
    """What each cell holds after the walk; what grows with the gas is as much more as that expands."""
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        given = ti.static((i, j, air, values, room, step, expansion, grows))
        if near[_row(air.box, i, j)] <= SPREAD:
            fill_row(air.box, spread, row_start(air.box, i, j), air.box.nz, lane, _spread_cell, given)


@kernel
def _drain(air: Air, room: Floats, step: ti.f32, expansion: Floats, expands: ti.template()):
    """Take what has flowed out, but for what has expanded, of the room of cells beside solids that have moved."""
    box, solids = ti.static((air.box, air.solids))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            if (solids.words[at] & CHANGES) != 0:
                lost = 0.0
                for axis in ti.static(range(3)):
                    lost += _face_flux(air, axis, at + steps(box)[axis]) - _face_flux(air, axis, at)
                if ti.static(expands):
                    lost -= mean_volume(solids, at) * expansion[at]
                room[at] -= step * lost


@ti.func
def _in_range(density: ti.f32, low: ti.f32, high: ti.f32, size: ti.f32, before: ti.f32, word: ti.i32) -> ti.f32:
    """Density beside solids that have moved: none that was not around, and that of before where no air tells it."""
    bounded = ti.max(low, ti.min(high, density)) if size > LEAST_ROOM else before
    return bounded if (word & CHANGES) != 0 else density


@kernel
def _keep(air: Air, near: Integers, held: Floats, values: Floats, room: Floats, volume: Floats, spread: Floats):
    """Density of what cells hold, the same in small ones and their keepers."""
    box, solids = ti.static((air.box, air.solids))
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane) * int(near[_row(box, i, j)] <= KEPT)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            word = solids.words[at]
            keeper = keeper_of(word, at, box)
            amount, size = held[keeper], room[keeper]
            low, high = values[keeper], values[keeper]
            if (word & (KEEPER | CHANGES)) != 0:
                for direction in ti.static(range(6)):
                    there = keeper + way(box, direction)
                    low, high = ti.min(low, values[there]), ti.max(high, values[there])
                    if (solids.words[there] & 7) == ti.static((direction ^ 1) + 1):
                        amount += held[there]
                        size += room[there]
            density = amount / ti.max(size, LEAST_ROOM)
            if ti.static(solids.moving):
                density = _in_range(density, low, high, size, values[keeper], solids.words[keeper])
            spread[at] = density if volume[at] > 0.0 else 0.0


@kernel
def _find_fluxes(air: Air, near: Integers, spread: Floats, fluxes: Faces, step: ti.f32):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        outs, given = ti.static((fluxes.x, fluxes.y, fluxes.z), (i, j, air, spread, step))
        if near[_row(air.box, i, j)] <= FLUXES:
            fill_rows(air.box, outs, row_start(air.box, i, j), air.box.nz, lane, _fluxes_into, given)


@kernel
def _limit(
    air: Air,
    near: Integers,
    values: Floats,
    spread: Floats,
    fluxes: Faces,
    volume: Floats,
    leaving: Floats,
    coming: Floats,
    step: ti.f32,
):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        outs, given = ti.static((leaving, coming), (i, j, air, values, spread, fluxes, volume, step))
        if near[_row(air.box, i, j)] <= LIMITED:
            fill_rows(air.box, outs, row_start(air.box, i, j), air.box.nz, lane, _kept_shares, given)


@kernel
def _sharpen(
    air: Air,
    near: Integers,
    values: Floats,
    spread: Floats,
    fluxes: Faces,
    volume: Floats,
    leaving: Floats,
    coming: Floats,
):
    for i, j, lane in ti.ndrange((1, air.box.nx + 1), (1, air.box.ny + 1), air.box.lanes):
        given = ti.static((i, j, air, spread, fluxes, volume, leaving, coming))
        if near[_row(air.box, i, j)] <= SHARPENED:
            fill_row(air.box, values, row_start(air.box, i, j), air.box.nz, lane, _sharpened, given)


@func
def _spread_cell(
    k: ti.i32,
    i: ti.i32,
    j: ti.i32,
    air: Air,
    values: Floats,
    room: Floats,
    step: ti.f32,
    expansion: Floats,
    grows: ti.template(),
) -> ti.f32:
    at, here = row_start(air.box, i, j) + k, ti.Vector([i, j, k])
    lost = 0.0
    for axis in ti.static(range(3)):
        along = steps(air.box)[axis]
        lost += _given(at + along, here[axis] + 1, axis, air, values, step) - _given(
            at, here[axis], axis, air, values, step
        )
    if ti.static(grows):
        lost -= step * mean_volume(air.solids, at) * expansion[at] * values[at]
    return _size(air.solids, room, at) * values[at] - lost


@func
def _given(at: ti.i32, p: ti.i32, axis: ti.template(), air: Air, values: Floats, step: ti.f32) -> ti.f32:
    """What the donor gives through the face before the p-th cell along an axis, which is at `at`."""
    crossed = step * _face_flux(air, axis, at)
    before = ti.select(p > 1, values[at - steps(air.box)[axis]], 0.0)
    after = ti.select(p <= cell_counts(air.box)[axis], values[at], 0.0)
    return ti.max(crossed, 0.0) * before + ti.min(crossed, 0.0) * after


@func
def _face_velocity(air: Air, axis: ti.template(), at: ti.i32) -> ti.f32:
    return ti.static((air.state.velocity.x, air.state.velocity.y, air.state.velocity.z)[axis])[at]


@func
def _face_flux(air: Air, axis: ti.template(), at: ti.i32) -> ti.f32:
    return flux_part(air.solids, axis, at) * _face_velocity(air, axis, at)


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
    is_whole = True
    if ti.static(air.solids.cuts):
        is_whole = ((air.solids.words[at] | air.solids.words[at - along]) & NEAR_SOLIDS) == 0
    is_far = is_whole & (p > 2) & (p < count[axis])
    lean = ti.select(is_far, crossed * (1.0 - moved) * (1.0 - 2.0 * moved) / 12.0, 0.0)
    flux = 0.5 * moved * (1.0 - moved) * (spread[at] - spread[at - along]) - lean * bend
    for other in ti.static((axis + 1) % 3, (axis + 2) % 3):
        across, q = steps(air.box)[other], here[other]
        aside = _face_velocity(air, other, at) + _face_velocity(air, other, at + across)
        aside += _face_velocity(air, other, at - along) + _face_velocity(air, other, at - along + across)
        rise = (spread[at + across] - spread[at - across]) + (spread[at - along + across] - spread[at - along - across])
        is_inner = is_whole & (q > 1) & (q < count[other])
        flux -= ti.select(is_inner, crossed * (step * aside) * rise / 32.0, 0.0)
    is_open = (p > 1) & (openness[at] > 0.0)
    return ti.select(is_open, flux_part(air.solids, axis, at) * flux, 0.0)


@func
def _kept_shares(
    k: ti.i32,
    i: ti.i32,
    j: ti.i32,
    air: Air,
    values: Floats,
    spread: Floats,
    fluxes: Faces,
    volume: Floats,
    step: ti.f32,
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
        before = ti.select(step * _face_flux(air, axis, at) > 0.0, before, values[at])
        after = ti.select(step * _face_flux(air, axis, at + along) < 0.0, after, values[at])
        low, high = ti.min(low, ti.min(before, after)), ti.max(high, ti.max(before, after))
    size = _size(air.solids, volume, at)
    return _share(size * (spread[at] - low), losses), _share(size * (high - spread[at]), gains)


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
    spread: Floats,
    fluxes: Faces,
    volume: Floats,
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
    if ti.static(air.solids.cuts):
        change = ti.select(volume[at] > 0.0, change / ti.max(volume[at], 1.0e-30), 0.0)
    return spread[at] + change


@func
def _limited(flux: ti.f32, at: ti.i32, along: ti.i32, leaving: Floats, coming: Floats) -> ti.f32:
    """A flux into the cell at `at` from the one before, as far as both bear it."""
    forth, back = ti.min(leaving[at - along], coming[at]), ti.min(leaving[at], coming[at - along])
    return flux * ti.select(flux > 0.0, forth, back)
