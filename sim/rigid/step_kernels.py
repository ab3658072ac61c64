"""Whether bodies that are near each other may get too far in a step, and whether any that touch may bounce."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Numbers, Rows, Vector3, Whole, WholeRows
from sim.rigid.collision_kernels import CONTACT_BAND, FAR, TRUSTED_MOTION, Bodies, Placed, margin_of
from sim.rigid.contact_kernels import row_of


@bundle
class Speeds(NamedTuple):
    """How fast all bodies are, the domain last, (b,)."""

    velocity: Rows  # of centres of mass [m/s], (b, 3)
    turning: Numbers  # of their farthest points about these [m/s]
    own: Numbers  # of their surfaces at most [m/s]
    advance: Numbers  # how far surfaces may get in a step [m]
    is_free: Whole
    radius: Numbers  # [m]
    ball: Numbers  # that of what may bounce off a wall within a step, `FAR` of others [m]


@ti.func
def time_to(advance: ti.f64, speed: ti.f64, acceleration: ti.f64) -> ti.f64:
    """As `steps.time_of`."""
    root = speed + ti.sqrt(speed * speed + 4.0 * acceleration * advance)
    return 2.0 * advance / ti.max(root, ti.cast(1.0e-300, ti.f64))


@func
def may_meet(one: ti.i32, two: ti.i32, bodies: Bodies) -> bool:
    """Whether boxes overlap with what the bodies' surfaces may reach: see `CollisionDetector.overlapping`."""
    reach = (CONTACT_BAND + TRUSTED_MOTION) * (bodies.size[one] + bodies.size[two])
    reach += bodies.motion[one] + bodies.motion[two]
    may = True
    for axis in ti.static(range(3)):
        may &= bodies.box[one, axis] - bodies.box[two, 3 + axis] <= reach
        may &= bodies.box[two, axis] - bodies.box[one, 3 + axis] <= reach
    return may


@kernel_of_host_arrays
def count_fast(
    count: ti.i32,
    pairs: WholeRows,
    bodies: Bodies,
    walls: Rows,
    middle: Numbers,
    speeds: Speeds,
    dt: ti.f64,
    acceleration: ti.f64,
    fast: Whole,
):
    """Count in `fast` those of so many pairs, of which one is free at least, that may get too far in dt [s].

    Pairs are those of `collision_kernels.Near`, walls those of `find_contacts`, with the way from each to the middle
    between it and the one that faces it [m].
    """
    for pair in range(count):
        one, two, wall = pairs[pair, 0], pairs[pair, 1], pairs[pair, 2]
        if speeds.is_free[one] == 1 or speeds.is_free[two] == 1:
            advance, relative = speeds.advance[one], speeds.turning[one]
            if wall >= 0:
                for axis in ti.static(range(3)):
                    if ti.cast(walls[wall, 0], ti.i32) == axis:
                        height = walls[wall, 1] * (bodies.pose[one, axis] - walls[wall, 2])
                        relative += ti.abs(speeds.velocity[one, axis])
                        advance = ti.max(advance, 0.5 * (height - speeds.radius[one]), middle[wall] - speeds.ball[one])
            else:
                slower, faster = ti.min(speeds.own[one], speeds.own[two]), ti.max(speeds.own[one], speeds.own[two])
                advance = ti.min(advance, speeds.advance[two])
                advance *= 1.0 + slower / ti.max(faster, ti.cast(1.0e-30, ti.f64))
                relative += speeds.turning[two]
                apart = Vector3(0.0)
                for axis in ti.static(range(3)):
                    apart[axis] = speeds.velocity[one, axis] - speeds.velocity[two, axis]
                relative += apart.norm()
            if time_to(advance, relative, acceleration) < dt and (wall >= 0 or may_meet(one, two, bodies)):
                fast[0] += 1


@kernel_of_host_arrays
def count_missed(
    count: ti.i32, pairs: WholeRows, bodies: Bodies, velocity: Rows, turning: Numbers, least: ti.f64, missed: Whole
):
    """Count in `missed` those of so many pairs that get farther than was looked for, and whose boxes meet then.

    Args:
        pairs: those of `collision_kernels.Near`; walls are left out, as contacts with them are never far.
        velocity: of all bodies, times the step [m], (b, 3).
        turning: how far the farthest points turn about centres of mass, and move as bodies deform [m], (b,).
        least: how much farther counts, in shortest edges of the smaller body [-].
    """
    for pair in range(count):
        one, two = pairs[pair, 0], pairs[pair, 1]
        if pairs[pair, 2] < 0:
            away = row_of(velocity, one) - row_of(velocity, two)
            turns = turning[one] + turning[two]
            if away.norm() + turns > margin_of(one, two, bodies) + least * ti.min(bodies.size[one], bodies.size[two]):
                apart = -ti.cast(FAR, ti.f64)
                for axis in ti.static(range(3)):
                    apart = ti.max(apart, bodies.box[one, axis] + away[axis] - bodies.box[two, 3 + axis])
                    apart = ti.max(apart, bodies.box[two, axis] - away[axis] - bodies.box[one, 3 + axis])
                if apart <= turns:
                    missed[0] += 1


@kernel_of_host_arrays
def count_bouncing(
    count: ti.i32,
    placed: Placed,
    bodies: Bodies,
    velocity: Rows,
    angular_velocity: Rows,
    restitution: Numbers,
    fall: Rows,
    slowest: ti.f64,
    dt: ti.f64,
    bouncing: Whole,
):
    """Count in `bouncing` those of so many contacts that `restitution.Bounces` may find to bounce in dt [s].

    Args:
        velocity: of the moving bodies, with all of the step's gravity [m/s], (n, 3).
        angular_velocity: [rad/s], (n, 3).
        restitution: of all bodies, and 0 for the domain, (b,).
        fall: what gravity added to velocities [m/s], (1, 3).
        slowest: approach below which nothing bounces [m/s].
    """
    for contact in range(count):
        one, two = placed.bodies[contact, 0], placed.bodies[contact, 1]
        if restitution[one] > 0.0 or restitution[two] > 0.0:
            normal = row_of(placed.normal, contact)
            approach, before = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for side in ti.static(range(2)):
                body = one if ti.static(side == 0) else two
                if body < velocity.shape[0]:
                    arm = row_of(placed.point, contact) - row_of(bodies.pose, body)
                    own = ti.static(1.0 - 2.0 * side) * normal
                    along = own.dot(row_of(velocity, body) + row_of(angular_velocity, body).cross(arm))
                    approach += along
                    before += along - own.dot(row_of(fall, 0))
            least = ti.min(approach, before)
            if least < -slowest and placed.gap[contact] <= -1.001 * least * dt:
                bouncing[0] += 1
