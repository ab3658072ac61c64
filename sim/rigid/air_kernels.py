"""What forces from outside do to rigid bodies in a step."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle
from sim.core.launch import kernel_of_host_arrays
from sim.forces.field import ForceTable, acceleration_at, air_at, drag_at, kept_off
from sim.rigid.array_types import Numbers, Rows, Vector3
from sim.rigid.state_kernels import Moving, matrix_of, quaternion_in, vector_in


@bundle
class Samples(NamedTuple):
    """Points of surfaces on which air presses, as many of each body, in its frame."""

    points: Rows  # [m], (m, 3)
    normals: Rows  # outwards, (m, 3)
    areas: Numbers  # [m²], (m,)


@bundle
class Whole(NamedTuple):
    """What each body moves with: what it is glued to, or itself, (n,)."""

    position: Rows  # of its centre of mass [m], (n, 3)
    inverse_mass: Numbers  # [1/kg]
    inverse_inertia: Rows  # tensors in the world's axes, row by row [1/(kg m²)], (n, 9)


@kernel_of_host_arrays
def push_bodies(
    forces: ForceTable,
    samples: Samples,
    drag: Numbers,
    moving: Moving,
    whole: Whole,
    dt: ti.f64,
    given: Rows,
    pressed: Rows,
    slowing: Rows,
    lost: Numbers,
):
    """What forces from outside do to each body.

    See `air.OuterForces`; `drag` is 1/2 rho C of a body [kg/m³], (n,).

    Args:
        given: accelerations [m/s²], (n, 3).
        pressed: force [N] of air and torque about its own centre of mass [N m], (n, 6).
        slowing: at what rates air slows how the whole moves and turns, by this part of it [1/s], (n, 2).
        lost: part of the velocities that drag takes in dt [s], (n,).
    """
    count = moving.position.shape[0]
    each = samples.areas.shape[0] // count
    for b in range(count):
        if whole.inverse_mass[b] > 0.0:
            centre, turn = vector_in(moving.position, b), matrix_of(quaternion_in(moving.orientation, b))
            v, omega = vector_in(moving.velocity, b), vector_in(moving.angular_velocity, b)
            to_whole = centre - vector_in(whole.position, b)
            at = ti.cast(centre, ti.f32)
            push, twist = Vector3(0.0), Vector3(0.0)
            rate, turning_rate = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            if drag[b] > 0.0:
                for s in range(b * each, b * each + each):
                    arm, normal = turn @ vector_in(samples.points, s), turn @ vector_in(samples.normals, s)
                    air = ti.cast(air_at(forces, b, ti.cast(centre + arm, ti.f32)).xyz, ti.f64)
                    blows = -(air - v - omega.cross(arm)).dot(normal)
                    if blows > 0.0:
                        slope = drag[b] * samples.areas[s] * blows
                        lever, eased = (to_whole + arm).cross(normal), Vector3(0.0)
                        for row in ti.static(range(3)):
                            for column in ti.static(range(3)):
                                eased[row] += whole.inverse_inertia[b, 3 * row + column] * lever[column]
                        push -= slope * blows * normal
                        twist -= slope * blows * arm.cross(normal)
                        rate += 2.0 * slope * whole.inverse_mass[b]
                        turning_rate += 2.0 * slope * lever.dot(eased)
            acceleration = acceleration_at(forces, b, at, True) + acceleration_at(forces, b, at, False)
            for axis in ti.static(range(3)):
                given[b, axis] = ti.cast(acceleration[axis], ti.f64)
                pressed[b, axis] = push[axis]
                pressed[b, 3 + axis] = twist[axis]
            slowing[b, 0], slowing[b, 1] = rate, turning_rate
            lost[b] = ti.cast(kept_off(ti.cast(drag_at(forces, b, at) * dt, ti.f32)), ti.f64)
