"""Kernels that start and end a substep of the nodes."""

import taichi as ti

from sim.cloth.bundles import NodeMotion, Nodes
from sim.core.arrays import Integers, Vectors
from sim.core.launch import kernel
from sim.core.reductions import is_finite

LARGEST_MOVE = 2.0**29
"""Most quanta in a step: a quarter of the lattice, so that integers do not overflow."""


@kernel
def move_pinned(
    nodes: Integers,
    arm: Vectors,
    carry: Vectors,
    shift: ti.math.vec3,
    turn_x: ti.math.vec3,
    turn_y: ti.math.vec3,
    turn_z: ti.math.vec3,
    displacement: Vectors,
):
    """Displace pinned nodes by a shift, and by the change of a rotation, given by rows, times their arms."""
    for k in range(nodes.shape[0]):
        turned = ti.math.vec3(turn_x.dot(arm[k]), turn_y.dot(arm[k]), turn_z.dot(arm[k]))
        displacement[nodes[k]] = carry[nodes[k]] + shift + turned


@kernel
def finish_step(
    nodes: Nodes,
    motion: NodeMotion,
    position: Vectors,
    limit: ti.i32,
    dt: ti.f32,
    reasons: Integers,
):
    """Velocities from displacements; the whole quanta of these onto the lattice, the rest is carried on.

    A velocity changes by what the displacement differs from dt times itself: the same as the displacement over dt, but
    for the rounding of 1/dt, which would make all velocities grow or shrink alike. Nodes stop at the ends of the
    lattice. Where a displacement is not finite, the velocity shows it.

    Nothing is done unless the three `reasons` why the substep may not be over are 0.
    """
    end = ti.select(reasons[0] + reasons[1] + reasons[2] == 0, position.shape[0], 0)
    for i in range(end):
        u_i = nodes.displacement[i]
        v_i = motion.velocity[i] + (u_i - (motion.carry[i] + dt * motion.velocity[i])) / dt
        for axis in ti.static(range(3)):
            if is_finite(u_i[axis]):
                quanta = ti.round(u_i[axis] / nodes.quantum)
                rest = u_i[axis] - quanta * nodes.quantum
                whole = ti.cast(ti.max(-LARGEST_MOVE, ti.min(quanta, LARGEST_MOVE)), ti.i32)
                place = nodes.lattice[i][axis] + whole
                if ti.abs(place) >= limit:
                    place = ti.max(-limit, ti.min(place, limit))
                    rest = 0.0
                    v_i[axis] = 0.0
                nodes.lattice[i][axis] = place
                position[i][axis] = ti.cast(place, ti.f32) * nodes.quantum
                motion.carry[i][axis] = rest
        motion.velocity[i] = v_i
        nodes.displacement[i] = motion.carry[i]
