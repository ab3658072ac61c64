"""Springs that are longer than their tension makes them: what the sweeps of XPBD have not got to.

Where a spring is solved, its multiplier is -k dt² times its stretch. What is solved after it moves its nodes on, and
what that leaves is no stretch of the material: it falls with every sweep, and with the square of the step. Rubber that
is drawn to twice its length has none of it.
"""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.device_springs import Laws
from sim.cloth.row_blocks import LANES
from sim.cloth.state import Lattice
from sim.launch import fast_launch
from sim.reductions import runs_on_gpu

OVERLONG = 0.5
"""Part of its length by which a spring is too long to be passed over: at a third of it cloth looks well still, as a
rubber sheet does that a heavy ball falls into; a bag of water that hangs from four nodes is drawn out to spikes."""


@ti.func
def is_overlong(
    i: ti.i32, j: ti.i32, rest: ti.f32, stiffness: ti.f32, multiplier: ti.f32, lattice: Lattice, quantum: ti.f32,
    inverse_mass: Floats, dt_squared: ti.f32, displacement: Vectors,
) -> ti.i32:  # fmt: skip
    """Whether |d| - rest + l/(k dt²) > `OVERLONG` rest, for a spring of which one node at least is free."""
    d = quantum * ti.cast(lattice[i] - lattice[j], ti.f32) + (displacement[i] - displacement[j])
    excess = d.norm() - rest + multiplier / (stiffness * dt_squared)
    return ti.cast(excess > OVERLONG * rest and inverse_mass[i] + inverse_mass[j] > 0.0, ti.i32)


@fast_launch
@ti.kernel
def count_overlong(
    nodes: Integers, law: Laws, count: ti.i32, multiplier: Floats, lattice: Lattice, quantum: ti.f32,
    inverse_mass: Floats, dt_squared: ti.f32, displacement: Vectors,
) -> ti.i32:  # fmt: skip
    """How many of the threads' springs are overlong, by lists."""
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    overlong = 0
    for s in range(count):
        overlong += is_overlong(
            nodes[2 * s], nodes[2 * s + 1], law[s][0], law[s][1], multiplier[s], lattice, quantum, inverse_mass,
            dt_squared, displacement,
        )  # fmt: skip
    return overlong


@fast_launch
@ti.kernel
def count_overlong_in_lines(
    blocks: ti.template(), is_turned: ti.i32, length: ti.i32, strips: ti.i32, lines: ti.i32, first_node: ti.i32,
    node_step: ti.i32, line_step: ti.i32, stiffness: Floats, rest: ti.f32, lattice: Lattice, quantum: ti.f32,
    inverse_mass: Floats, dt_squared: ti.f32, displacement: Vectors,
) -> ti.i32:  # fmt: skip
    """How many springs of a rectangle's threads along one direction are overlong; the workspace has the multipliers.

    Args:
        blocks: workspace, right after the rectangle's step; places as in `solve_lines`.
        is_turned: whether lines run along x.
        length: nodes of a line.
        strips: blocks beside each other.
        lines: how many there are.
        first_node: of the rectangle.
        node_step, line_step: from a node to the next one of its line, and to the same of the next line.
        stiffness: of the springs of each line [N/m].
        rest: length of a spring [m].
        lattice, quantum, inverse_mass, displacement: as in `ClothState`.
        dt_squared: [s²].
    """
    ti.loop_config(serialize=True)
    overlong = 0
    for line in range(lines):
        for k in range(length - 1):
            block = line // LANES + k * strips
            if is_turned:
                block += blocks.turned
            i = first_node + line * line_step + k * node_step
            overlong += is_overlong(
                i, i + node_step, rest, stiffness[line], blocks.multiplier[block][line % LANES], lattice, quantum,
                inverse_mass, dt_squared, displacement,
            )  # fmt: skip
    return overlong
