"""Moves particles, keeps them behind the walls, and measures the state on the way."""

import taichi as ti

from sim.neighbors import Vectors
from sim.reductions import is_finite

Motion = ti.types.struct(
    max_speed_squared=ti.f32,
    max_acceleration_squared=ti.f32,
    max_displacement_squared=ti.f32,
    left=ti.i32,
    touched=ti.i32,
    bad=ti.i32,
)


@ti.kernel
def advance_particles(
    position: Vectors,
    velocity: Vectors,
    acceleration: Vectors,
    count: ti.i32,
    dt: ti.f32,
    wall_low: ti.math.vec3,
    wall_high: ti.math.vec3,
    keep_low: ti.math.vec3,
    keep_high: ti.math.vec3,
) -> Motion:
    """Symplectic Euler: v_i += dt a_i, x_i += dt v_i; then whoever passed a wall is put back onto it.

    Returns:
        Largest |v|² [m²/s²] and |a|² [m²/s⁴], the speed before a wall stops it, and largest |x - x before|² [m²];
        how many particles passed an open face, were put back onto a wall, and had a position or velocity that was
        not finite before the wall. Those that are not finite count neither as gone nor as put back.
    """
    max_speed_squared = 0.0
    max_acceleration_squared = 0.0
    max_displacement_squared = 0.0
    left = 0
    touched = 0
    bad = 0
    for i in range(count):
        a_i = acceleration[i]
        v_i = velocity[i] + dt * a_i
        free = position[i] + dt * v_i
        # Before the wall: it would turn NaN into a point on itself, and infinite speed into rest.
        finite = 1
        for axis in ti.static(range(3)):
            finite &= is_finite(v_i[axis]) & is_finite(free[axis])
        ti.atomic_max(max_speed_squared, v_i.norm_sqr())
        ti.atomic_max(max_acceleration_squared, a_i.norm_sqr())
        x_i = ti.min(ti.max(free, wall_low), wall_high)
        for axis in ti.static(range(3)):
            if x_i[axis] != free[axis]:
                v_i[axis] = 0.0
        if finite == 0:
            bad += 1
        else:
            if (x_i != free).any():
                touched += 1
            if (x_i < keep_low).any() or (x_i > keep_high).any():
                left += 1
        ti.atomic_max(max_displacement_squared, (x_i - position[i]).norm_sqr())
        position[i] = x_i
        velocity[i] = v_i
    return Motion(max_speed_squared, max_acceleration_squared, max_displacement_squared, left, touched, bad)
