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


@kernel_of_host_arrays
def push_bodies(
    forces: ForceTable, samples: Samples, drag: Numbers, moving: Moving, dt: ti.f64, change: Rows, lost: Numbers
):
    """What dt [s] adds to each body's velocity and spin, (n, 6), after the part of them that drag takes, (n,).

    See `air.OuterForces`; `drag` is 1/2 rho C of a body [kg/m³], (n,).
    """
    count = moving.position.shape[0]
    each = samples.areas.shape[0] // count
    for b in range(count):
        if moving.inverse_mass[b] > 0.0:
            centre, turn = vector_in(moving.position, b), matrix_of(quaternion_in(moving.orientation, b))
            v, omega = vector_in(moving.velocity, b), vector_in(moving.angular_velocity, b)
            ease = turn @ moving.inverse_tensor[b] @ turn.transpose()
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
                        lever = arm.cross(normal)
                        push -= slope * blows * normal
                        twist -= slope * blows * lever
                        rate += 2.0 * slope * moving.inverse_mass[b]
                        turning_rate += 2.0 * slope * lever.dot(ease @ lever)
            share = dt / (1.0 + dt * ti.max(rate, turning_rate))
            given = acceleration_at(forces, b, at, True) + acceleration_at(forces, b, at, False)
            linear = dt * ti.cast(given, ti.f64) + share * moving.inverse_mass[b] * push
            angular = share * (ease @ twist)
            for axis in ti.static(range(3)):
                change[b, axis] = linear[axis]
                change[b, 3 + axis] = angular[axis]
            lost[b] = ti.cast(kept_off(ti.cast(drag_at(forces, b, at) * dt, ti.f32)), ti.f64)
