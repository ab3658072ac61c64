"""Whether bodies that are near each other may get too far in a step."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Numbers, Rows, Vector3, Whole, WholeRows


@bundle
class Speeds(NamedTuple):
    """How fast all bodies are, the domain last, (b,)."""

    velocity: Rows  # of centres of mass [m/s], (b, 3)
    turning: Numbers  # of their farthest points about these [m/s]
    own: Numbers  # of their surfaces at most [m/s]
    advance: Numbers  # how far surfaces may get in a step [m]
    is_free: Whole
    radius: Numbers  # [m]


@ti.func
def time_to(advance: ti.f64, speed: ti.f64, acceleration: ti.f64) -> ti.f64:
    """As `steps.time_of`."""
    root = speed + ti.sqrt(speed * speed + 4.0 * acceleration * advance)
    return 2.0 * advance / ti.max(root, ti.cast(1.0e-300, ti.f64))


@kernel_of_host_arrays
def count_fast(
    count: ti.i32,
    pairs: WholeRows,
    pose: Rows,
    walls: Rows,
    speeds: Speeds,
    dt: ti.f64,
    acceleration: ti.f64,
    fast: Whole,
):
    """Count in `fast` those of so many pairs, of which one is free at least, that may get too far in dt [s].

    Pairs are those of `collision_kernels.Near`, walls those of `find_contacts`.
    """
    for pair in range(count):
        one, two, wall = pairs[pair, 0], pairs[pair, 1], pairs[pair, 2]
        if speeds.is_free[one] == 1 or speeds.is_free[two] == 1:
            advance, relative = speeds.advance[one], speeds.turning[one]
            if wall >= 0:
                for axis in ti.static(range(3)):
                    if ti.cast(walls[wall, 0], ti.i32) == axis:
                        height = walls[wall, 1] * (pose[one, axis] - walls[wall, 2])
                        relative += ti.abs(speeds.velocity[one, axis])
                        advance = ti.max(advance, 0.5 * (height - speeds.radius[one]))
            else:
                slower, faster = ti.min(speeds.own[one], speeds.own[two]), ti.max(speeds.own[one], speeds.own[two])
                advance = ti.min(advance, speeds.advance[two])
                advance *= 1.0 + slower / ti.max(faster, ti.cast(1.0e-30, ti.f64))
                relative += speeds.turning[two]
                apart = Vector3(0.0)
                for axis in ti.static(range(3)):
                    apart[axis] = speeds.velocity[one, axis] - speeds.velocity[two, axis]
                relative += apart.norm()
            if time_to(advance, relative, acceleration) < dt:
                fast[0] += 1
