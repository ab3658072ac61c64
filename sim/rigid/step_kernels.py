"""Whether bodies that are near each other may get too far in a step, and whether any that touch may bounce."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Numbers, Rows, Vector3, Whole, WholeRows
from sim.rigid.collision_kernels import (
    CONTACT_BAND,
    FAR,
    TRUSTED_MOTION,
    Bodies,
    Kept,
    Near,
    Placed,
    margin_of,
    turned,
    vector_at,
)
from sim.rigid.contact_kernels import row_of
from sim.rigid.polytope_kernels import FIRST_VERTEX, VERTICES, Polytopes

PASSED = 0.1  # of how much farther than looked for counts: how far the plane of a contact may be passed


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


@bundle
class Motion(NamedTuple):
    """How all bodies move in a step, the domain last, (b,)."""

    centre: Rows  # what they turn about [m], (b, 3)
    velocity: Rows  # of the centre, times the step [m], (b, 3)
    spin: Rows  # angular velocity times the step [rad], (b, 3)
    turning: Numbers  # how far the farthest points turn about the centre, or move as bodies deform [m]


@func
def moved_on(point: Vector3, body: ti.i32, motion: Motion) -> Vector3:
    """Where a point of a body is at the end of the step."""
    arm, turn = point - row_of(motion.centre, body), row_of(motion.spin, body)
    angle = ti.max(turn.norm(), ti.cast(1.0e-30, ti.f64))
    axis = turn / angle
    across, half = axis.cross(arm), ti.sin(0.5 * angle)
    return point + row_of(motion.velocity, body) + ti.sin(angle) * across + 2.0 * half * half * axis.cross(across)


@func
def lowest(
    own: ti.i32, other: ti.i32, contact: ti.i32, bodies: Bodies, kept: Kept, polytopes: Polytopes, motion: Motion
):
    """How far a polytope is before the plane of a contact that is fixed to another body, now and at the end [m]."""
    shape = bodies.shape[own]
    anchor = turned(bodies.pose, other, vector_at(kept.planes, contact, 0)) + vector_at(bodies.pose, other, 0)
    outward = turned(bodies.pose, other, vector_at(kept.planes, contact, 3))
    anchor_then = moved_on(anchor, other, motion)
    outward_then = moved_on(anchor + outward, other, motion) - anchor_then
    first, height = polytopes.whole[shape, FIRST_VERTEX], ti.cast(FAR, ti.f64)
    for row in range(first, first + polytopes.whole[shape, VERTICES]):
        corner = turned(bodies.pose, own, vector_at(polytopes.vertices, row, 0)) + vector_at(bodies.pose, own, 0)
        height = ti.min(height, outward.dot(corner - anchor))
        height = ti.min(height, outward_then.dot(moved_on(corner, own, motion) - anchor_then))
    return height - polytopes.radii[shape]


@func
def stays_apart(
    pair: ti.i32, deepest: ti.f64, near: Near, bodies: Bodies, kept: Kept, polytopes: Polytopes, motion: Motion
) -> bool:
    """Whether one of the planes in which two polytopes have contacts keeps them apart but for so much [m]."""
    stays = False
    if near.pairs[pair, 3] == 0:
        for contact in range(kept.starts[pair], kept.starts[pair + 1]):
            if not stays:
                own, other = near.pairs[pair, 0], near.pairs[pair, 1]
                if kept.features[contact, 0] == 1:
                    own, other = other, own
                stays = lowest(own, other, contact, bodies, kept, polytopes, motion) >= -deepest
    return stays


@kernel_of_host_arrays
def count_missed(
    count: ti.i32,
    near: Near,
    bodies: Bodies,
    kept: Kept,
    polytopes: Polytopes,
    motion: Motion,
    least: ti.f64,
    missed: Whole,
):
    """Count in `missed` those of so many pairs that get farther than was looked for, and whose boxes meet then.

    Polytopes that a plane of one of their contacts keeps apart are left out, whatever speed they got: a box that
    another one turns, or takes along. So are walls, as contacts with them are never far.

    Args:
        near: the pairs, with the contacts that are `kept` of them.
        least: how much farther counts, in shortest edges of the smaller body [-].
    """
    for pair in range(count):
        one, two = near.pairs[pair, 0], near.pairs[pair, 1]
        if near.pairs[pair, 2] < 0:
            away = row_of(motion.velocity, one) - row_of(motion.velocity, two)
            turns = motion.turning[one] + motion.turning[two]
            deepest = least * ti.min(bodies.size[one], bodies.size[two])
            if away.norm() + turns > margin_of(one, two, bodies) + deepest:
                apart = -ti.cast(FAR, ti.f64)
                for axis in ti.static(range(3)):
                    apart = ti.max(apart, bodies.box[one, axis] + away[axis] - bodies.box[two, 3 + axis])
                    apart = ti.max(apart, bodies.box[two, axis] - away[axis] - bodies.box[one, 3 + axis])
                if apart <= turns and not stays_apart(pair, PASSED * deepest, near, bodies, kept, polytopes, motion):
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
