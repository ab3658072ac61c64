"""Bend springs and cells of a rectangle, eight lines at a time (see `row_blocks`)."""

import taichi as ti

from sim.cloth.bundles import Lines, Rectangle
from sim.cloth.device_cells import over_relaxed
from sim.cloth.device_springs import TINY_LENGTH
from sim.cloth.row_blocks import LANES, Block, turn_displacements, turn_displacements_back, two_blocks
from sim.core.arrays import Floats
from sim.core.launch import kernel

BEND_COLOURS = 3
"""Bend springs along a line that share no node: every third one."""


@kernel
def bend_lines(
    blocks: ti.template(),
    along: Lines,
    stiffness: Floats,
    quantum: ti.f32,
    dt_squared: ti.f32,
    gamma: ti.f32,
    is_short: ti.template(),
):
    """The bend springs of all lines along one direction, colour by colour; `solve_bend` has the formula.

    Args:
        blocks: workspace.
        along: the lines.
        stiffness: of the springs of each line [N/m], (strips * LANES,).
        quantum: unit of the lattice [m].
        dt_squared: [s²].
        gamma: damping over stiffness and dt [-].
        is_short: see `sim.core.scheduling`.
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(along.strips):
        first = 0
        if along.is_turned:
            first = blocks.turned
            turn_displacements(blocks, strip, along.other_strips, along.strips)
        strength = Block(0.0)
        for at in range(LANES):
            strength[at] = dt_squared * stiffness[strip * LANES + at]
        for colour in range(BEND_COLOURS):
            for m in range((along.length - colour) // BEND_COLOURS):
                a = first + (colour + BEND_COLOURS * m) * along.strips + strip
                b, c = a + along.strips, a + 2 * along.strips
                a_x, a_y, a_z, w_a = blocks.u_x[a], blocks.u_y[a], blocks.u_z[a], blocks.inverse_mass[a]
                b_x, b_y, b_z, w_b = blocks.u_x[b], blocks.u_y[b], blocks.u_z[b], blocks.inverse_mass[b]
                c_x, c_y, c_z, w_c = blocks.u_x[c], blocks.u_y[c], blocks.u_z[c], blocks.inverse_mass[c]
                p_x, p_y, p_z = blocks.lattice_x[a], blocks.lattice_y[a], blocks.lattice_z[a]
                q_x, q_y, q_z = blocks.lattice_x[b], blocks.lattice_y[b], blocks.lattice_z[b]
                r_x, r_y, r_z = blocks.lattice_x[c], blocks.lattice_y[c], blocks.lattice_z[c]
                for at in range(LANES):
                    moved_x = a_x[at] - 2.0 * b_x[at] + c_x[at]
                    moved_y = a_y[at] - 2.0 * b_y[at] + c_y[at]
                    moved_z = a_z[at] - 2.0 * b_z[at] + c_z[at]
                    d_x = quantum * ti.cast((p_x[at] - q_x[at]) + (r_x[at] - q_x[at]), ti.f32) + moved_x
                    d_y = quantum * ti.cast((p_y[at] - q_y[at]) + (r_y[at] - q_y[at]), ti.f32) + moved_y
                    d_z = quantum * ti.cast((p_z[at] - q_z[at]) + (r_z[at] - q_z[at]), ti.f32) + moved_z
                    squared = d_x * d_x + d_y * d_y + d_z * d_z
                    error = squared + gamma * (d_x * moved_x + d_y * moved_y + d_z * moved_z)
                    weight = strength[at] * (w_a[at] + 4.0 * w_b[at] + w_c[at])
                    floor = ti.max(squared, TINY_LENGTH * TINY_LENGTH)  # flat cloth has no error either
                    f = -strength[at] * error / (floor * (weight * (1.0 + gamma) + 1.0))
                    a_x[at] += w_a[at] * f * d_x
                    a_y[at] += w_a[at] * f * d_y
                    a_z[at] += w_a[at] * f * d_z
                    b_x[at] -= 2.0 * w_b[at] * f * d_x
                    b_y[at] -= 2.0 * w_b[at] * f * d_y
                    b_z[at] -= 2.0 * w_b[at] * f * d_z
                    c_x[at] += w_c[at] * f * d_x
                    c_y[at] += w_c[at] * f * d_y
                    c_z[at] += w_c[at] * f * d_z
                blocks.u_x[a], blocks.u_y[a], blocks.u_z[a] = a_x, a_y, a_z
                blocks.u_x[b], blocks.u_y[b], blocks.u_z[b] = b_x, b_y, b_z
                blocks.u_x[c], blocks.u_y[c], blocks.u_z[c] = c_x, c_y, c_z
        if along.is_turned:
            turn_displacements_back(blocks, strip, along.other_strips, along.strips)


@ti.func
def keep_two_blocks(values: ti.template(), block, pair, keeps_both):
    """Write both blocks back, or the first."""
    one, next_one = Block(0.0), Block(0.0)
    for at in ti.static(range(LANES)):
        one[at] = pair[at]
        next_one[at] = pair[LANES + at]
    values[block] = one
    if keeps_both:
        values[block + 1] = next_one


@kernel
def solve_cells_in_rows(
    blocks: ti.template(),
    parity: ti.i32,
    grid: Rectangle,
    steps: ti.math.vec2,
    stiffness: ti.f32,
    quantum: ti.f32,
    dt_squared: ti.f32,
    is_first: ti.i32,
    is_short: ti.template(),
):
    """The shear of all cells in every second row of cells, from row `parity` on; `solve_shear` has the formula.

    In each row every second cell first, then those between, which share nodes with them: all are computed alike, eight
    at a time, and every second one acts. `steps` are the lengths of a cell [m], `stiffness` is G times its area [J].
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for pair in range((grid.rows - parity) // 2):
        lower = (2 * pair + parity) * grid.strips
        strength = stiffness * dt_squared
        half = ti.sqrt(0.5)
        along, across = 0.5 / steps[0], 0.5 / steps[1]
        for way in range(2):
            for k in range(grid.strips):
                a, b = lower + k, lower + grid.strips + k
                a_x, a_y = two_blocks(blocks.u_x, a, a + 1), two_blocks(blocks.u_y, a, a + 1)
                a_z, w_a = two_blocks(blocks.u_z, a, a + 1), two_blocks(blocks.inverse_mass, a, a + 1)
                b_x, b_y = two_blocks(blocks.u_x, b, b + 1), two_blocks(blocks.u_y, b, b + 1)
                b_z, w_b = two_blocks(blocks.u_z, b, b + 1), two_blocks(blocks.inverse_mass, b, b + 1)
                p_x, p_y = two_blocks(blocks.lattice_x, a, a + 1), two_blocks(blocks.lattice_y, a, a + 1)
                p_z, q_z = two_blocks(blocks.lattice_z, a, a + 1), two_blocks(blocks.lattice_z, b, b + 1)
                q_x, q_y = two_blocks(blocks.lattice_x, b, b + 1), two_blocks(blocks.lattice_y, b, b + 1)
                multiplier = blocks.cell_multiplier[a]
                rise_x, rise_y, rise_z = Block(0.0), Block(0.0), Block(0.0)
                fall_x, fall_y, fall_z = Block(0.0), Block(0.0), Block(0.0)
                cells = grid.columns - 1 - k * LANES
                for at in range(LANES):
                    # From each corner to the opposite one, upwards and downwards.
                    up_x = quantum * ti.cast(q_x[at + 1] - p_x[at], ti.f32) + (b_x[at + 1] - a_x[at])
                    up_y = quantum * ti.cast(q_y[at + 1] - p_y[at], ti.f32) + (b_y[at + 1] - a_y[at])
                    up_z = quantum * ti.cast(q_z[at + 1] - p_z[at], ti.f32) + (b_z[at + 1] - a_z[at])
                    down_x = quantum * ti.cast(p_x[at + 1] - q_x[at], ti.f32) + (a_x[at + 1] - b_x[at])
                    down_y = quantum * ti.cast(p_y[at + 1] - q_y[at], ti.f32) + (a_y[at + 1] - b_y[at])
                    down_z = quantum * ti.cast(p_z[at + 1] - q_z[at], ti.f32) + (a_z[at + 1] - b_z[at])
                    # d_u + d_v and d_u - d_v, and their directions n and m.
                    total, between = along + across, along - across
                    n_x, n_y, n_z = (
                        total * up_x + between * down_x,
                        total * up_y + between * down_y,
                        total * up_z + between * down_z,
                    )
                    m_x, m_y, m_z = (
                        total * down_x + between * up_x,
                        total * down_y + between * up_y,
                        total * down_z + between * up_z,
                    )
                    longer = ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), TINY_LENGTH)
                    shorter = ti.max(ti.sqrt(m_x * m_x + m_y * m_y + m_z * m_z), TINY_LENGTH)
                    n_x, n_y, n_z = n_x / longer, n_y / longer, n_z / longer
                    m_x, m_y, m_z = m_x / shorter, m_y / shorter, m_z / shorter
                    # Derivatives of e_s by the corners: r of the upper right one, t of the lower right one.
                    more, less = half * total, half * between
                    r_x, r_y, r_z = more * n_x - less * m_x, more * n_y - less * m_y, more * n_z - less * m_z
                    t_x, t_y, t_z = less * n_x - more * m_x, less * n_y - more * m_y, less * n_z - more * m_z
                    weight = (w_a[at] + w_b[at + 1]) * (r_x * r_x + r_y * r_y + r_z * r_z) + (w_a[at + 1] + w_b[at]) * (
                        t_x * t_x + t_y * t_y + t_z * t_z
                    )
                    acts = at < cells and at % 2 == way
                    before = ti.select(is_first, 0.0, multiplier[at])
                    error = strength * half * (longer - shorter) + before
                    stiff = strength * weight
                    change = ti.select(acts, -over_relaxed(stiff) * error / (stiff + 1.0), 0.0)
                    multiplier[at] = ti.select(acts, before + change, multiplier[at])
                    rise_x[at], rise_y[at], rise_z[at] = change * r_x, change * r_y, change * r_z
                    fall_x[at], fall_y[at], fall_z[at] = change * t_x, change * t_y, change * t_z
                for at in range(LANES):
                    a_x[at] -= w_a[at] * rise_x[at]
                    a_y[at] -= w_a[at] * rise_y[at]
                    a_z[at] -= w_a[at] * rise_z[at]
                    b_x[at] -= w_b[at] * fall_x[at]
                    b_y[at] -= w_b[at] * fall_y[at]
                    b_z[at] -= w_b[at] * fall_z[at]
                for at in range(LANES):
                    a_x[at + 1] += w_a[at + 1] * fall_x[at]
                    a_y[at + 1] += w_a[at + 1] * fall_y[at]
                    a_z[at + 1] += w_a[at + 1] * fall_z[at]
                    b_x[at + 1] += w_b[at + 1] * rise_x[at]
                    b_y[at + 1] += w_b[at + 1] * rise_y[at]
                    b_z[at + 1] += w_b[at + 1] * rise_z[at]
                blocks.cell_multiplier[a] = multiplier
                is_inner = k + 1 < grid.strips
                keep_two_blocks(blocks.u_x, a, a_x, is_inner)
                keep_two_blocks(blocks.u_y, a, a_y, is_inner)
                keep_two_blocks(blocks.u_z, a, a_z, is_inner)
                keep_two_blocks(blocks.u_x, b, b_x, is_inner)
                keep_two_blocks(blocks.u_y, b, b_y, is_inner)
                keep_two_blocks(blocks.u_z, b, b_z, is_inner)
