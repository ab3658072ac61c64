"""What forces from outside do to rigid bodies in a step."""

import taichi as ti

from sim.core.launch import kernel_of_host_arrays
from sim.forces.field import ForceTable, acceleration_at, air_at, drag_at, kept_off
from sim.rigid.array_types import Numbers, Rows, Vector3


@kernel_of_host_arrays
def push_bodies(
    forces: ForceTable,
    points: Rows,
    normals: Rows,
    areas: Numbers,
    drag: Numbers,
    position: Rows,
    orientation: Rows,
    velocity: Rows,
    angular_velocity: Rows,
    inverse_mass: Numbers,
    inverse_inertia: Rows,
    dt: ti.f64,
    impulses: Rows,
    lost: Numbers,
):
    """Impulses and angular impulses of dt [s] on each body, (n, 6), and the part of its motion that drag takes, (n,).

    See `air.OuterForces`.

    `points` and `normals`, (n * samples, 3), are as many of each body, in its frame, with their `areas` [m²]; `drag` is
    1/2 rho C of a body [kg/m³], (n,); `inverse_inertia` is in world axes, (n, 9).
    """
    count = position.shape[0]
    samples = points.shape[0] // count
    for b in range(count):
        if inverse_mass[b] > 0.0:
            centre, v, omega = _row(position, b, 0), _row(velocity, b, 0), _row(angular_velocity, b, 0)
            at = ti.cast(centre, ti.f32)
            mass = 1.0 / inverse_mass[b]
            given = acceleration_at(forces, b, at, True) + acceleration_at(forces, b, at, False)
            push, twist = mass * dt * ti.cast(given, ti.f64), Vector3(0.0)
            w, turn = orientation[b, 0], _row(orientation, b, 1)
            pushing, turning = Vector3(0.0), Vector3(0.0)
            rate, turning_rate = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            if drag[b] > 0.0:
                for s in range(samples):
                    arm = _turned(w, turn, _row(points, b * samples + s, 0))
                    normal = _turned(w, turn, _row(normals, b * samples + s, 0))
                    air = ti.cast(air_at(forces, b, ti.cast(centre + arm, ti.f32)).xyz, ti.f64)
                    blows = -(air - v - omega.cross(arm)).dot(normal)
                    if blows > 0.0:
                        pressure = drag[b] * areas[b * samples + s]
                        force = -pressure * blows * blows * normal
                        pushing += force
                        turning += arm.cross(force)
                        slope = 2.0 * pressure * blows
                        lever = arm.cross(normal)
                        eased = Vector3(0.0)
                        for axis in ti.static(range(3)):
                            eased[axis] = _row(inverse_inertia, b, 3 * axis).dot(lever)
                        rate += slope * inverse_mass[b]
                        turning_rate += slope * lever.dot(eased)
            share = dt / (1.0 + dt * ti.max(rate, turning_rate))
            push += share * pushing
            twist += share * turning
            for axis in ti.static(range(3)):
                impulses[b, axis] = push[axis]
                impulses[b, 3 + axis] = twist[axis]
            lost[b] = ti.cast(kept_off(ti.cast(drag_at(forces, b, at) * dt, ti.f32)), ti.f64)


@ti.func
def _row(rows: Rows, row: ti.i32, first: ti.i32) -> Vector3:
    return Vector3(rows[row, first], rows[row, first + 1], rows[row, first + 2])


@ti.func
def _turned(w: ti.f64, axis: Vector3, vector: Vector3) -> Vector3:
    """A vector turned by a unit quaternion."""
    twice = 2.0 * axis.cross(vector)
    return vector + w * twice + axis.cross(twice)
