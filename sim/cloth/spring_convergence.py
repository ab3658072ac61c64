"""Springs that have not converged: longer than their tension makes them, as the sweeps of XPBD leave them.

Where a spring is solved, its multiplier is -k dt² times its stretch. What is solved after it moves its nodes on, and
what that leaves is no stretch of the material: it falls with every sweep, and with the square of the step. Rubber that
is drawn to twice its length has none of it.
"""

import taichi as ti

from sim.cloth.bundles import Lines, Nodes, SpringArrays
from sim.cloth.row_blocks import LANES, Blocks
from sim.core.arrays import Floats, Integers
from sim.core.bundles import func
from sim.core.launch import kernel

LARGEST_RESIDUAL = 0.5
"""Residual in rest lengths from which a spring counts as not converged: at a third of it cloth looks well still, as a
rubber sheet does that a heavy ball falls into; a bag of water that hangs from four nodes is drawn out to spikes."""


@func
def excess_of(
    i: ti.i32,
    j: ti.i32,
    rest: ti.f32,
    shift: ti.f32,
    stiffness: ti.f32,
    multiplier: ti.f32,
    nodes: Nodes,
    dt_squared: ti.f32,
) -> ti.f32:
    """(|d| - rest + shift + l/(k dt²)) / rest, nothing for a spring between two nodes that are held."""
    d = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[j], ti.f32) + (
        nodes.displacement[i] - nodes.displacement[j]
    )
    excess = (d.norm() - rest + shift + multiplier / (stiffness * dt_squared)) / rest
    return ti.select(nodes.inverse_mass[i] + nodes.inverse_mass[j] > 0.0, excess, 0.0)


@kernel
def measure_excess(
    springs: SpringArrays, count: ti.i32, multiplier: Floats, nodes: Nodes, dt_squared: ti.f32, found: Integers
) -> ti.math.vec2:
    """Largest excess of springs of threads in lists, and how many have not converged; two numbers are `found`."""
    end = count
    found[0], found[1] = 0, 0
    for s in range(end):
        i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
        excess = excess_of(
            i, j, springs.law[s][0], springs.shift[s], springs.law[s][1], multiplier[s], nodes, dt_squared
        )
        bits = ti.bit_cast(excess, ti.i32)  # those of numbers from 0 on are in their order
        if excess > 0.0 and bits > found[0]:  # all others would wait in line to change nothing
            ti.atomic_max(found[0], bits)
        if excess > LARGEST_RESIDUAL:
            ti.atomic_add(found[1], 1)
    return ti.math.vec2(ti.bit_cast(found[0], ti.f32), ti.cast(found[1], ti.f32))


@kernel
def measure_excess_in_lines(
    multipliers: Blocks,
    along: Lines,
    stiffness: Floats,
    rest: ti.f32,
    poisson: ti.f32,
    across: Blocks,
    nodes: Nodes,
    dt_squared: ti.f32,
) -> ti.math.vec2:
    """The same of a rectangle's threads along one direction.

    Args:
        multipliers: from `solve_lines`, and at the same places.
        along: the lines.
        stiffness: of the springs of each line [N/m].
        rest: length of a spring [m].
        poisson: Poisson's ratio [-].
        across: strains at nodes along the other direction, as the threads took them, if `poisson` is not 0.
        nodes: of all cloths.
        dt_squared: [s²].
    """
    ti.loop_config(serialize=True)
    largest, unconverged = 0.0, 0.0
    for line in range(along.count):
        for k in range(along.length - 1):
            block = along.first + line // LANES + k * along.strips
            i = along.first_node + line * along.line_step + k * along.node_step
            multiplier = multipliers[block][line % LANES]
            shift = 0.0
            if poisson > 0.0:
                after = block + along.strips
                shift = 0.5 * poisson * rest * (across[block][line % LANES] + across[after][line % LANES])
            excess = excess_of(i, i + along.node_step, rest, shift, stiffness[line], multiplier, nodes, dt_squared)
            largest = ti.max(largest, excess)
            if excess > LARGEST_RESIDUAL:
                unconverged += 1.0
    return ti.math.vec2(largest, unconverged)
