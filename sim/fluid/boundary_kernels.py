"""Kernels that place the boundary samples of moving bodies."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.launch import fast_launch

STATE_WIDTH = 18
"""Numbers of a body's state: centre of mass, rotation row by row, velocity, angular velocity."""

NO_BODY = 2**31 - 1
"""Stands for the number of a body where there is none."""

WRENCH_WIDTH = 6
"""Numbers of a force with its torque."""


@fast_launch
@ti.kernel
def place_samples(
    offset: Vectors, body: Integers, count: ti.i32, first: ti.i32, states: Floats, position: Vectors, velocity: Vectors
):  # fmt: skip
    """x_b = x_com + R r_b, v_b = v + omega x R r_b."""
    for b in range(count):
        s = body[b] * STATE_WIDTH
        r = offset[b]
        arm = ti.math.vec3(0.0)
        for row in ti.static(range(3)):
            arm[row] = states[s + 3 + 3 * row] * r[0] + states[s + 4 + 3 * row] * r[1] + states[s + 5 + 3 * row] * r[2]
        centre = ti.math.vec3(states[s], states[s + 1], states[s + 2])
        speed = ti.math.vec3(states[s + 12], states[s + 13], states[s + 14])
        spin = ti.math.vec3(states[s + 15], states[s + 16], states[s + 17])
        position[first + b] = centre + arm
        velocity[first + b] = speed + spin.cross(arm)


@fast_launch
@ti.kernel
def take_samples(position: Vectors, first: ti.i32, count: ti.i32, taken: Vectors):
    """Copy the moving samples out of all, which start at `first`."""
    for b in range(count):
        taken[b] = position[first + b]


@fast_launch
@ti.kernel
def order_samples(
    position: Vectors, order: Integers, count: ti.i32, first: ti.i32, x: Floats, y: Floats, z: Floats, index: Integers
):  # fmt: skip
    """Coordinates of the moving samples as they are sorted, and the index of each among all samples."""
    for k in range(count):
        x_b = position[order[k]]
        x[k] = x_b[0]
        y[k] = x_b[1]
        z[k] = x_b[2]
        index[k] = first + order[k]
