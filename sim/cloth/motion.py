"""Kernels that start and end a substep of the nodes."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.state import Lattice
from sim.launch import fast_launch
from sim.reductions import is_finite

LARGEST_MOVE = 2.0**29
"""Most quanta in a step: a quarter of the lattice, so that integers do not overflow."""


@fast_launch
@ti.kernel
def predict_displacement(
    velocity: Vectors, carry: Vectors, inverse_mass: Floats, air_force: Vectors, air_share: Floats,
    triangle_start: Integers, triangle_list: Integers, is_windy: ti.i32, first: ti.i32, end: ti.i32,
    gravity: ti.math.vec3, dt: ti.f32, displacement: Vectors,
):  # fmt: skip
    """Accelerate by gravity and by the node's share of the force on each of its triangles; where that leads in dt.

    Nodes from `first` to before `end`.
    """
    for i in range(first, end):
        w_i = inverse_mass[i]
        if w_i > 0.0:
            v_i = velocity[i] + dt * gravity
            if is_windy:
                force = ti.math.vec3(0.0)
                for k in range(triangle_start[i], triangle_start[i + 1]):
                    force += air_force[triangle_list[k]]
                v_i += dt * w_i * air_share[i] * force
            velocity[i] = v_i
            displacement[i] = carry[i] + dt * v_i
        else:
            displacement[i] = carry[i]


@fast_launch
@ti.kernel
def move_pinned(
    nodes: Integers, arm: Vectors, carry: Vectors, shift: ti.math.vec3, turn_x: ti.math.vec3, turn_y: ti.math.vec3,
    turn_z: ti.math.vec3, displacement: Vectors,
):  # fmt: skip
    """Displace pinned nodes by a shift, and by the change of a rotation, given by rows, times their arms."""
    for k in range(nodes.shape[0]):
        turned = ti.math.vec3(turn_x.dot(arm[k]), turn_y.dot(arm[k]), turn_z.dot(arm[k]))
        displacement[nodes[k]] = carry[nodes[k]] + shift + turned


@fast_launch
@ti.kernel
def finish_step(
    displacement: Vectors, quantum: ti.f32, limit: ti.i32, dt: ti.f32, lattice: Lattice, position: Vectors,
    carry: Vectors, velocity: Vectors, is_short: ti.template(),
):  # fmt: skip
    """Velocities from displacements; the whole quanta of these onto the lattice, the rest is carried on.

    A velocity changes by what the displacement differs from dt times itself: the same as the displacement over dt, but
    for the rounding of 1/dt, which would make all velocities grow or shrink alike. Nodes stop at the ends of the
    lattice. Where a displacement is not finite, the velocity shows it.
    """
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for i in range(position.shape[0]):
        u_i = displacement[i]
        v_i = velocity[i] + (u_i - (carry[i] + dt * velocity[i])) / dt
        for axis in ti.static(range(3)):
            if is_finite(u_i[axis]):
                quanta = ti.round(u_i[axis] / quantum)
                rest = u_i[axis] - quanta * quantum
                whole = ti.cast(ti.max(-LARGEST_MOVE, ti.min(quanta, LARGEST_MOVE)), ti.i32)
                end = lattice[i][axis] + whole
                if ti.abs(end) >= limit:
                    end = ti.max(-limit, ti.min(end, limit))
                    rest = 0.0
                    v_i[axis] = 0.0
                lattice[i][axis] = end
                position[i][axis] = ti.cast(end, ti.f32) * quantum
                carry[i][axis] = rest
        velocity[i] = v_i
        displacement[i] = carry[i]
