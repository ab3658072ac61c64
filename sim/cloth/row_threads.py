"""Threads of a rectangle, eight at a time (see `row_blocks`); `threads` has the method, and does the same for lists."""

import taichi as ti

from sim.cloth.bundles import Lines
from sim.cloth.device_springs import TINY_LENGTH
from sim.cloth.row_blocks import (
    LANES,
    Block,
    Blocks,
    turn_displacements,
    turn_displacements_back,
    turn_strip,
    turn_strip_back,
)
from sim.cloth.springs import SEGMENT_LENGTH
from sim.cloth.threads import LEAST_ALIKE, STRAIGHTENED, TURNED_EXPLICITLY
from sim.core.arrays import Floats
from sim.core.launch import kernel

LEAST_WEIGHT = 1.0e-20
"""Inverse masses [1/kg] of two nodes that both are held are taken for this, in divisions."""


@ti.func
def piece_count(length):
    """Pieces of lines of so many nodes."""
    return (length - 1 + SEGMENT_LENGTH - 1) // SEGMENT_LENGTH


@kernel
def solve_lines(
    blocks: ti.template(),
    along: Lines,
    stiffness: Floats,
    rest: ti.f32,
    quantum: ti.f32,
    dt_squared: ti.f32,
    is_first: ti.i32,
    multipliers: Blocks,
    poisson: ti.f32,
    across: Blocks,
    is_short: ti.template(),
):
    """The threads along one direction, piece by piece, even pieces first; arguments as of `bend_lines`.

    `rest` is the length of a spring [m]; `multipliers` of the spring that leads on from each node start at 0 if
    `is_first`; `across` are the strains at nodes along the other direction, if `poisson` is not 0.
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(along.strips):
        first = 0
        if along.is_turned:
            first = blocks.turned
            turn_displacements(blocks, strip, along.other_strips, along.strips)
        compliance = Block(0.0)
        for at in range(LANES):
            compliance[at] = 1.0 / (dt_squared * stiffness[strip * LANES + at])
        pieces = piece_count(along.length)
        for parity in range(2):
            for half in range((pieces + 1 - parity) // 2):
                piece = 2 * half + parity
                start = piece * SEGMENT_LENGTH
                stop = ti.min(start + SEGMENT_LENGTH, along.length - 1)
                solve_pieces(
                    blocks,
                    first + strip,
                    along.strips,
                    start,
                    stop,
                    compliance,
                    rest,
                    quantum,
                    is_first,
                    multipliers,
                    first + strip * pieces + piece,
                    0.5 * poisson * rest,
                    across,
                )
        if along.is_turned:
            turn_displacements_back(blocks, strip, along.other_strips, along.strips)


@ti.func
def solve_pieces(
    blocks: ti.template(),
    line,
    strips,
    start,
    stop,
    compliance,
    rest,
    quantum,
    is_first,
    multipliers: Blocks,
    number,
    contraction,
    across: Blocks,
):
    """One piece of LANES threads exactly: the Thomas algorithm forth, then back, where nodes move."""
    n_x, n_y, n_z = Block(0.0), Block(0.0), Block(0.0)
    inverse_pivot, solved = Block(0.0), Block(0.0)
    for k in range(start, stop):
        a = line + k * strips
        b = a + strips
        a_x, a_y, a_z, w_a = blocks.u_x[a], blocks.u_y[a], blocks.u_z[a], blocks.inverse_mass[a]
        b_x, b_y, b_z, w_b = blocks.u_x[b], blocks.u_y[b], blocks.u_z[b], blocks.inverse_mass[b]
        p_x, p_y, p_z = blocks.lattice_x[a], blocks.lattice_y[a], blocks.lattice_z[a]
        q_x, q_y, q_z = blocks.lattice_x[b], blocks.lattice_y[b], blocks.lattice_z[b]
        multiplier = multipliers[a]
        inverse_length, factor, shift = Block(0.0), Block(0.0), Block(0.0)
        if contraction > 0.0:
            shift = contraction * (across[a] + across[b])
        for at in range(LANES):
            s_x = quantum * ti.cast(p_x[at] - q_x[at], ti.f32)
            s_y = quantum * ti.cast(p_y[at] - q_y[at], ti.f32)
            s_z = quantum * ti.cast(p_z[at] - q_z[at], ti.f32)
            d_x = s_x + (a_x[at] - b_x[at])
            d_y = s_y + (a_y[at] - b_y[at])
            d_z = s_z + (a_z[at] - b_z[at])
            length = ti.max(ti.sqrt(d_x * d_x + d_y * d_y + d_z * d_z), TINY_LENGTH)
            start_length = ti.max(ti.sqrt(s_x * s_x + s_y * s_y + s_z * s_z), TINY_LENGTH)
            inverse = 1.0 / length
            is_alike = s_x * d_x + s_y * d_y + s_z * d_z > LEAST_ALIKE * start_length * length
            over = ti.select(is_alike, 1.0 / start_length, inverse)
            m_x = over * ti.select(is_alike, s_x, d_x)
            m_y = over * ti.select(is_alike, s_y, d_y)
            m_z = over * ti.select(is_alike, s_z, d_z)
            before = ti.select(is_first, 0.0, multiplier[at])
            coupling = -w_a[at] * (m_x * n_x[at] + m_y * n_y[at] + m_z * n_z[at])  # n is of the spring before
            lower = coupling * inverse_pivot[at]
            pivot = 1.0 / (w_a[at] + w_b[at] + compliance[at] - coupling * lower)
            solved[at] = (rest - shift[at] - length - compliance[at] * before - coupling * solved[at]) * pivot
            inverse_pivot[at] = pivot
            factor[at] = lower
            inverse_length[at] = inverse
            multiplier[at] = before
            n_x[at] = m_x
            n_y[at] = m_y
            n_z[at] = m_z
        blocks.n_x[a], blocks.n_y[a], blocks.n_z[a] = n_x, n_y, n_z
        blocks.change[a], blocks.factor[a], blocks.inverse_length[a] = solved, factor, inverse_length
        multipliers[a] = multiplier
    factor_after, change = Block(0.0), Block(0.0)
    after_x, after_y, after_z = Block(0.0), Block(0.0), Block(0.0)  # the push of the spring after the node
    largest = Block(0.0)
    for m in range(stop - start):
        a = line + (stop - 1 - m) * strips
        b = a + strips
        b_x, b_y, b_z, w_b = blocks.u_x[b], blocks.u_y[b], blocks.u_z[b], blocks.inverse_mass[b]
        s_x, s_y, s_z, w_a = blocks.n_x[a], blocks.n_y[a], blocks.n_z[a], blocks.inverse_mass[a]
        forward, factor, inverse_length = blocks.change[a], blocks.factor[a], blocks.inverse_length[a]
        multiplier = multipliers[a]
        tension = Block(0.0)
        for at in range(LANES):
            own = forward[at] - factor_after[at] * change[at]
            push_x, push_y, push_z = own * s_x[at], own * s_y[at], own * s_z[at]
            b_x[at] += w_b[at] * (after_x[at] - push_x)
            b_y[at] += w_b[at] * (after_y[at] - push_y)
            b_z[at] += w_b[at] * (after_z[at] - push_z)
            after_x[at] = push_x
            after_y[at] = push_y
            after_z[at] = push_z
            factor_after[at] = factor[at]
            change[at] = own
            multiplier[at] += own
            weight = ti.max(w_a[at] + w_b[at], LEAST_WEIGHT)
            excess = ti.max(-multiplier[at] * inverse_length[at] - TURNED_EXPLICITLY / weight, 0.0)
            tension[at] = STRAIGHTENED * excess
            largest[at] = ti.max(largest[at], excess)
        blocks.u_x[b], blocks.u_y[b], blocks.u_z[b] = b_x, b_y, b_z
        multipliers[a], blocks.tension[a] = multiplier, tension
    head = line + start * strips
    a_x, a_y, a_z, w_a = blocks.u_x[head], blocks.u_y[head], blocks.u_z[head], blocks.inverse_mass[head]
    for at in range(LANES):
        a_x[at] += w_a[at] * after_x[at]
        a_y[at] += w_a[at] * after_y[at]
        a_z[at] += w_a[at] * after_z[at]
    blocks.u_x[head], blocks.u_y[head], blocks.u_z[head] = a_x, a_y, a_z
    blocks.is_taut[number] = ti.cast(largest.max() > 0.0, ti.i32)


@kernel
def measure_lines(
    blocks: ti.template(), along: Lines, rest: ti.f32, quantum: ti.f32, strain: Blocks, is_short: ti.template()
):
    """Strains at the nodes of all lines along one direction, of the two springs there or the one, in both layouts."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(along.strips):
        first = 0
        if along.is_turned:
            first = blocks.turned
            turn_displacements(blocks, strip, along.other_strips, along.strips)
        before = Block(0.0)
        for k in range(along.length):
            a = first + strip + k * along.strips
            after = Block(0.0)
            if k + 1 < along.length:
                b = a + along.strips
                a_x, a_y, a_z = blocks.u_x[a], blocks.u_y[a], blocks.u_z[a]
                b_x, b_y, b_z = blocks.u_x[b], blocks.u_y[b], blocks.u_z[b]
                p_x, p_y, p_z = blocks.lattice_x[a], blocks.lattice_y[a], blocks.lattice_z[a]
                q_x, q_y, q_z = blocks.lattice_x[b], blocks.lattice_y[b], blocks.lattice_z[b]
                for at in range(LANES):
                    d_x = quantum * ti.cast(p_x[at] - q_x[at], ti.f32) + (a_x[at] - b_x[at])
                    d_y = quantum * ti.cast(p_y[at] - q_y[at], ti.f32) + (a_y[at] - b_y[at])
                    d_z = quantum * ti.cast(p_z[at] - q_z[at], ti.f32) + (a_z[at] - b_z[at])
                    after[at] = ti.sqrt(d_x * d_x + d_y * d_y + d_z * d_z) / rest - 1.0
            weight = 0.5
            if k == 0 or k + 1 == along.length:
                weight = 1.0
            strain[a] = weight * (before + after)
            before = after
        if along.is_turned:
            turn_strip_back(strain, blocks.turned, strip, along.other_strips, along.strips)
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(ti.select(along.is_turned, 0, along.other_strips)):
        turn_strip(strain, blocks.turned, strip, along.strips, along.other_strips)


@kernel
def straighten_lines(blocks: ti.template(), along: Lines, is_short: ti.template()):
    """Let tension turn with the threads along one direction, where any piece of a strip has too much of it."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(along.strips):
        first = 0
        if along.is_turned:
            first = blocks.turned
        pieces = piece_count(along.length)
        taut = 0
        for piece in range(pieces):
            taut += blocks.is_taut[first + strip * pieces + piece]
        if taut > 0:
            if along.is_turned:
                turn_displacements(blocks, strip, along.other_strips, along.strips)
                for values in ti.static((blocks.predicted_x, blocks.predicted_y, blocks.predicted_z)):
                    turn_strip(values, blocks.turned, strip, along.other_strips, along.strips)
            for parity in range(2):
                for half in range((pieces + 1 - parity) // 2):
                    piece = 2 * half + parity
                    start = piece * SEGMENT_LENGTH
                    stop = ti.min(start + SEGMENT_LENGTH, along.length - 1)
                    if blocks.is_taut[first + strip * pieces + piece]:
                        straighten_pieces(blocks, first + strip, along.strips, start, stop)
            if along.is_turned:
                turn_displacements_back(blocks, strip, along.other_strips, along.strips)


@ti.func
def straighten_pieces(blocks: ti.template(), line, strips, start, stop):
    """Solve (1 + w_i (t_i-1 + t_i)) e_i - w_i t_i-1 e_i-1 - w_i t_i e_i+1 = e~_i for one piece of LANES threads.

    Forth, with what the head was moved by as the first row, and back; `n` and `factor` of a spring hold what is solved
    at the node that it leads from.
    """
    e_x, e_y, e_z, share, t_before = Block(0.0), Block(0.0), Block(0.0), Block(0.0), Block(0.0)
    for k in range(start, stop + 1):
        a = line + k * strips
        u_x, u_y, u_z, w_a = blocks.u_x[a], blocks.u_y[a], blocks.u_z[a], blocks.inverse_mass[a]
        v_x, v_y, v_z = blocks.predicted_x[a], blocks.predicted_y[a], blocks.predicted_z[a]
        t_after = blocks.tension[a]
        is_last = k == stop  # the next piece has its own tension there
        for at in range(LANES):
            pull = w_a[at] * t_before[at]
            t_l = ti.select(is_last, 0.0, t_after[at])
            onward = w_a[at] * t_l
            pivot = 1.0 / (1.0 + onward + pull * (1.0 - share[at]))
            e_x[at] = pivot * (u_x[at] - v_x[at] + pull * e_x[at])
            e_y[at] = pivot * (u_y[at] - v_y[at] + pull * e_y[at])
            e_z[at] = pivot * (u_z[at] - v_z[at] + pull * e_z[at])
            share[at] = pivot * onward
            t_before[at] = t_l
        blocks.n_x[a], blocks.n_y[a], blocks.n_z[a], blocks.factor[a] = e_x, e_y, e_z, share
    e_x, e_y, e_z = Block(0.0), Block(0.0), Block(0.0)
    for m in range(stop + 1 - start):
        a = line + (stop - m) * strips
        s_x, s_y, s_z, share_a = blocks.n_x[a], blocks.n_y[a], blocks.n_z[a], blocks.factor[a]
        v_x, v_y, v_z = blocks.predicted_x[a], blocks.predicted_y[a], blocks.predicted_z[a]
        for at in range(LANES):
            e_x[at] = s_x[at] + share_a[at] * e_x[at]
            e_y[at] = s_y[at] + share_a[at] * e_y[at]
            e_z[at] = s_z[at] + share_a[at] * e_z[at]
            s_x[at] = v_x[at] + e_x[at]
            s_y[at] = v_y[at] + e_y[at]
            s_z[at] = v_z[at] + e_z[at]
        blocks.u_x[a], blocks.u_y[a], blocks.u_z[a] = s_x, s_y, s_z
