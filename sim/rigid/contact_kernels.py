"""Projected Gauss-Seidel on the impulses of contacts, island by island, in one launch."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Eases, Numbers, Rows, Vector3, Velocities, Whole, WholeRows
from sim.rigid.joint_kernels import JointRows, relax_joints
from sim.rigid.joint_system import UNBOUNDED

NORMAL, ARM, LEAST, LOWEST, OWN = 0, 3, 9, 10, 11
IMPULSE, CHANGE, AHEAD, FRICTION, SLIP, TANGENT = 17, 20, 23, 26, 27, 28
"""Columns of what a contact is while its island is solved: arms are two, tangents of three numbers too; OWN is what it
has of A: nn, 1 / nn, n1, n2, 11, 22. SLIP is κ of `friction_impulse`, from which the next sweep starts."""
COLUMNS = 34
Work = ti.types.ndarray(dtype=ti.types.vector(COLUMNS, ti.f64), ndim=1)
Ahead = ti.types.ndarray(dtype=ti.types.vector(12, ti.f64), ndim=1)


@bundle
class System(NamedTuple):
    """Contacts, (c,), of bodies, (n,), and what is asked of them."""

    bodies: WholeRows  # the two bodies of each, (c, 2)
    point: Rows  # [m], (c, 3)
    normal: Rows  # from the second to the first, (c, 3)
    least: Numbers  # bounds of the normal velocities from below [m/s]
    friction: Numbers  # coefficients mu [-]
    position: Rows  # centres of mass [m], (n, 3)
    ease: Eases  # inverse mass [1/kg] and inertia xx, xy, xz, yy, yz, zz in world axes [1/(kg m²)], (n,)


@bundle
class Islands(NamedTuple):
    """Contacts, pairs of bodies and bodies of islands, island after island; contacts of a pair stand together."""

    order: Whole  # contacts, (c,)
    spans: Whole  # where those of each pair begin in `order`, and the end, (p + 1,)
    first: Whole  # first pair of each island, and the end, (i + 1,)
    movers: Whole  # bodies that impulses move, (m,)
    first_mover: Whole  # of each island, and the end, (i + 1,)
    most_sweeps: Whole  # after which an island is given up, (i,)


@bundle
class Overlaps(NamedTuple):
    """What moves bodies apart in a step, (c,)."""

    gap: Numbers  # [m]
    rate: ti.f64  # at which overlaps shrink, 0 for nothing of the kind [1/s]
    slop: ti.f64  # overlap that stays [m]
    dt: ti.f64  # [s]
    is_placed: Whole  # 1 where the contact is brought to where its bounce leads to by the end of the step
    rest: Numbers  # time from the bounce to the end of the step [s]
    fall: Numbers  # velocity that gravity adds in that time along the normal [m/s]


@bundle
class Outcomes(NamedTuple):
    """What is found."""

    impulses: Rows  # to start from, and found, in world axes [N s], (c, 3)
    velocity: Velocities  # of bodies without impulses, and with them [m/s], [rad/s], (n,)
    along_normal: Numbers  # relative velocities [m/s], (c,)
    extra: Velocities  # that only moves bodies apart [m/s], [rad/s], (n,)
    sweeps: WholeRows  # that each island took in both solves, one more than the most where it was given up, (i, 2)
    work: Work  # what contacts are, (c,)
    ahead: Ahead  # of bodies: velocities before a sweep, and directions of what goes on, (n,)


@ti.func
def vector_of(table: ti.template(), row: ti.i32, column: ti.i32) -> Vector3:
    """Three numbers of a table."""
    return Vector3(table[row][column], table[row][column + 1], table[row][column + 2])


@ti.func
def row_of(rows: ti.template(), row: ti.i32) -> Vector3:
    """Three numbers of a table of three columns."""
    return Vector3(rows[row, 0], rows[row, 1], rows[row, 2])


@ti.func
def tensor_times(ease: ti.template(), torque: Vector3) -> Vector3:
    """Change of the angular velocity of a body of this ease by an angular impulse."""
    return Vector3(
        ease[1] * torque[0] + ease[2] * torque[1] + ease[3] * torque[2],
        ease[2] * torque[0] + ease[4] * torque[1] + ease[5] * torque[2],
        ease[3] * torque[0] + ease[5] * torque[1] + ease[6] * torque[2],
    )


@ti.func
def velocity_at(at: ti.i32, one: ti.i32, two: ti.i32, work: Work, velocity: Velocities) -> Vector3:
    """The relative velocity of two bodies at a contact."""
    result = vector_of(velocity, one, 0) + vector_of(velocity, one, 3).cross(vector_of(work, at, ARM))
    return result - vector_of(velocity, two, 0) - vector_of(velocity, two, 3).cross(vector_of(work, at, ARM + 3))


@ti.func
def along_axes(at: ti.i32, first: ti.i32, work: Work) -> Vector3:
    """A vector in world axes of its components along the normal and the tangents, from some column on."""
    return (
        work[at][first] * vector_of(work, at, NORMAL)
        + work[at][first + 1] * vector_of(work, at, TANGENT)
        + work[at][first + 2] * vector_of(work, at, TANGENT + 3)
    )


@ti.func
def tangents_of(n: Vector3):
    """Two unit tangents that depend on the normal continuously but at one pole (Duff et al. 2017)."""
    sign = ti.select(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return Vector3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), Vector3(b, sign + n[1] * n[1] * a, -n[1])


@func
def gather_contact(
    at: ti.i32,
    normal: Vector3,
    arm_one: Vector3,
    arm_two: Vector3,
    start: Vector3,
    friction: ti.f64,
    least: ti.f64,
    one: ti.i32,
    two: ti.i32,
    ease: Eases,
    work: Work,
):
    """Put together what a contact of two bodies is, its own block of A among it, with tangents in which 12 is 0.

    Impulses to start from, in world axes, push, and stay within friction.
    """
    first, second = tangents_of(normal)
    block = ti.Matrix.zero(ti.f64, 3, 3)
    for side in ti.static(range(2)):
        body = one if ti.static(side == 0) else two
        if ease[body][0] > 0.0:
            arm = arm_one if ti.static(side == 0) else arm_two
            for row in ti.static(range(3)):
                axis = normal if ti.static(row == 0) else (first if ti.static(row == 1) else second)
                answer = ease[body][0] * axis + tensor_times(ease[body], arm.cross(axis)).cross(arm)
                for column in ti.static(range(row, 3)):
                    other = normal if ti.static(column == 0) else (first if ti.static(column == 1) else second)
                    block[row, column] += answer.dot(other)
    half, mean = 0.5 * (block[1, 1] - block[2, 2]), 0.5 * (block[1, 1] + block[2, 2])
    spread, c, s = ti.sqrt(half * half + block[1, 2] * block[1, 2]), ti.cast(1.0, ti.f64), ti.cast(0.0, ti.f64)
    if spread > 0.0:
        # Of half the angle whose cosine and sine are these over the spread, the larger one first.
        larger = ti.sqrt(0.5 + 0.5 * ti.abs(half) / spread)
        smaller = 0.5 * block[1, 2] / (spread * larger)
        c, s = larger, smaller
        if half < 0.0:
            c, s = smaller, larger
    first, second = c * first + s * second, c * second - s * first
    along = Vector3(ti.max(start.dot(normal), 0.0), start.dot(first), start.dot(second))
    rubbing, limit = ti.sqrt(along[1] * along[1] + along[2] * along[2]), friction * along[0]
    if rubbing > limit:
        along[1] *= limit / rubbing
        along[2] *= limit / rubbing
    for axis in ti.static(range(3)):
        work[at][NORMAL + axis], work[at][TANGENT + axis] = normal[axis], first[axis]
        work[at][TANGENT + 3 + axis] = second[axis]
        work[at][ARM + axis], work[at][ARM + 3 + axis] = arm_one[axis], arm_two[axis]
        work[at][IMPULSE + axis], work[at][CHANGE + axis], work[at][AHEAD + axis] = along[axis], 0.0, 0.0
    work[at][LEAST], work[at][LOWEST], work[at][FRICTION], work[at][SLIP] = least, 0.0, friction, 0.0
    work[at][OWN], work[at][OWN + 1] = block[0, 0], 1.0 / block[0, 0]
    work[at][OWN + 2] = c * block[0, 1] + s * block[0, 2]
    work[at][OWN + 3] = c * block[0, 2] - s * block[0, 1]
    work[at][OWN + 4], work[at][OWN + 5] = mean + spread, mean - spread


@ti.func
def larger_of(one: ti.f64, two: ti.f64) -> ti.f64:
    """The larger of two numbers, in one instruction: `ti.max` asks besides whether one is none."""
    return ti.select(one > two, one, two)


@ti.func
def friction_impulse(a_1: ti.f64, a_2: ti.f64, c_1: ti.f64, c_2: ti.f64, limit: ti.f64, start: ti.f64):
    """Tangential impulses x with slip w = A x + c: w = 0, or |x| = limit and w = -κ x with κ > 0; and κ.

    The second solves (A + κ) x = -c. Newton's method on 1/limit = 1/|x(κ)|, which is nearly linear in κ and concave,
    is below its root after a step from anywhere, and then approaches it (Conn, Gould & Toint 2000, "Trust-region
    methods", 7.3). It does one step a sweep: x has the direction of the κ that is started from, and the length of the
    limit; κ is that of the next sweep. A is diagonal, its first number the larger one.
    """
    x_1, x_2, kappa = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    if limit > 0.0:
        over = 1.0 / (a_1 * a_2)
        x_1, x_2 = -c_1 * (a_2 * over), -c_2 * (a_1 * over)
        square = x_1 * x_1 + x_2 * x_2
        if square > limit * limit:
            kappa = start
            if start == 0.0:
                # -x·dx/dκ = x·(A + κ)⁻¹x; and |x| is at least |c| over κ and the larger number of A.
                fall = (a_2 * x_1 * x_1 + a_1 * x_2 * x_2) * over
                kappa = (ti.sqrt(square) / limit - 1.0) * square / fall
                kappa = larger_of(kappa, ti.sqrt(c_1 * c_1 + c_2 * c_2) / limit - a_1)
            d_1, d_2 = a_1 + kappa, a_2 + kappa
            over = 1.0 / (d_1 * d_2)
            x_1, x_2 = -c_1 * (d_2 * over), -c_2 * (d_1 * over)
            square = x_1 * x_1 + x_2 * x_2
            length = ti.sqrt(square)
            fall = (d_2 * x_1 * x_1 + d_1 * x_2 * x_2) * over
            kappa = larger_of(kappa + (length / limit - 1.0) * square / fall, 0.0)
            x_1 *= limit / length
            x_2 *= limit / length
    return x_1, x_2, kappa


@func
def push_both(one: ti.i32, two: ti.i32, impulse: Vector3, at: ti.i32, ease: Eases, velocity: Velocities, work: Work):
    """Give the two bodies of a contact an impulse, and its opposite."""
    for side in ti.static(range(2)):
        body, own = (one, impulse) if ti.static(side == 0) else (two, -impulse)
        if ease[body][0] > 0.0:
            turn = tensor_times(ease[body], vector_of(work, at, ARM + 3 * side).cross(own))
            for axis in ti.static(range(3)):
                velocity[body][axis] += ease[body][0] * own[axis]
                velocity[body][3 + axis] += turn[axis]


@func
def relax_pair(
    rubs: ti.template(),
    there: bool,
    ratio: ti.f64,
    start: ti.i32,
    stop: ti.i32,
    one: ti.i32,
    two: ti.i32,
    ease: Eases,
    velocity: Velocities,
    work: Work,
):
    """Change the impulses of all contacts of two bodies one after the other, from the last on where it is not there.

    Before that each goes on along the direction before by a ratio; the velocities, (n,), have done so. Without what
    rubs there are normal impulses alone.

    Returns:
        the largest change of a velocity at a contact, and the sum of the squares of the changes of impulses.
    """
    largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    ease_one, ease_two = ease[one], ease[two]
    linear_one, angular_one = vector_of(velocity, one, 0), vector_of(velocity, one, 3)
    linear_two, angular_two = vector_of(velocity, two, 0), vector_of(velocity, two, 3)
    for place in range(start, stop):
        at = ti.select(there, place, start + stop - 1 - place)
        normal = vector_of(work, at, NORMAL)
        arm_one, arm_two = vector_of(work, at, ARM), vector_of(work, at, ARM + 3)
        own = linear_one + angular_one.cross(arm_one) - linear_two - angular_two.cross(arm_two)
        ahead_n = ratio * work[at][AHEAD]
        old_n = work[at][IMPULSE] + ahead_n
        new_n = larger_of(old_n - (own.dot(normal) - work[at][LEAST]) * work[at][OWN + 1], work[at][LOWEST])
        d_n = new_n - old_n
        work[at][AHEAD], work[at][CHANGE], work[at][IMPULSE] = ahead_n + work[at][CHANGE], d_n, new_n
        added = d_n * normal
        largest = larger_of(largest, work[at][OWN] * ti.abs(d_n))
        square += d_n * d_n
        if ti.static(rubs):
            ahead_1, ahead_2 = ratio * work[at][AHEAD + 1], ratio * work[at][AHEAD + 2]
            old_1, old_2 = work[at][IMPULSE + 1] + ahead_1, work[at][IMPULSE + 2] + ahead_2
            d_1, d_2 = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            if work[at][FRICTION] > 0.0 and (new_n != 0.0 or old_1 != 0.0 or old_2 != 0.0):
                # Slip without the tangential impulses of this contact.
                a_1, a_2 = work[at][OWN + 4], work[at][OWN + 5]
                one_way, other_way = vector_of(work, at, TANGENT), vector_of(work, at, TANGENT + 3)
                c_1 = own.dot(one_way) + work[at][OWN + 2] * d_n - a_1 * old_1
                c_2 = own.dot(other_way) + work[at][OWN + 3] * d_n - a_2 * old_2
                limit = work[at][FRICTION] * new_n
                new_1, new_2, kappa = friction_impulse(a_1, a_2, c_1, c_2, limit, work[at][SLIP])
                work[at][SLIP] = kappa
                d_1, d_2 = new_1 - old_1, new_2 - old_2
                largest = larger_of(largest, larger_of(a_1 * ti.abs(d_1), a_2 * ti.abs(d_2)))
                square += d_1 * d_1 + d_2 * d_2
                added += d_1 * one_way + d_2 * other_way
            work[at][AHEAD + 1], work[at][AHEAD + 2] = (
                ahead_1 + work[at][CHANGE + 1],
                ahead_2 + work[at][CHANGE + 2],
            )
            work[at][CHANGE + 1], work[at][CHANGE + 2] = d_1, d_2
            work[at][IMPULSE + 1], work[at][IMPULSE + 2] = old_1 + d_1, old_2 + d_2
        if added[0] != 0.0 or added[1] != 0.0 or added[2] != 0.0:
            linear_one += ease_one[0] * added
            angular_one += tensor_times(ease_one, arm_one.cross(added))
            linear_two -= ease_two[0] * added
            angular_two -= tensor_times(ease_two, arm_two.cross(added))
    if ease_one[0] > 0.0:
        for axis in ti.static(range(3)):
            velocity[one][axis], velocity[one][3 + axis] = linear_one[axis], angular_one[axis]
    if ease_two[0] > 0.0:
        for axis in ti.static(range(3)):
            velocity[two][axis], velocity[two][3 + axis] = linear_two[axis], angular_two[axis]
    return largest, square


@func
def sweep(
    rubs: ti.template(),
    there: bool,
    ratio: ti.f64,
    island: ti.i32,
    islands: Islands,
    system: System,
    velocity: Velocities,
    work: Work,
):
    """Change the impulses of all contacts of an island, pair after pair, as `relax_pair` does."""
    largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    begin, end = islands.first[island], islands.first[island + 1]
    for step in range(begin, end):
        pair = ti.select(there, step, begin + end - 1 - step)
        start, stop = islands.spans[pair], islands.spans[pair + 1]
        one, two = system.bodies[islands.order[start], 0], system.bodies[islands.order[start], 1]
        of_velocity, of_impulses = relax_pair(
            rubs, there, ratio, start, stop, one, two, system.ease, velocity, work
        )  # fmt: skip
        largest, square = ti.max(largest, of_velocity), square + of_impulses
    return largest, square


@ti.func
def ratio_of(square: ti.f64, before: ti.f64) -> ti.f64:
    """How far to go on along the direction before, by the squares of two gradients; 0, anew, where they grow."""
    return ti.select(0.0 < square < before, square / ti.max(before, ti.cast(1.0e-300, ti.f64)), 0.0)


@func
def relax_contacts(
    rubs: ti.template(),
    has_joints: ti.template(),
    island: ti.i32,
    may_change: ti.f64,
    islands: Islands,
    system: System,
    joint_order: ti.template(),
    joint_first: ti.template(),
    joints: ti.template(),
    velocity: Velocities,
    ahead: Ahead,
    work: Work,
) -> ti.i32:
    """Sweep over an island until a sweep changes no velocity at contacts, or of joints, by more than it may.

    Sweeps are steps of a nonsmooth nonlinear conjugate gradient method (Silcowitz-Hansen, Niebe & Erleben 2010): what a
    sweep changes is the negative gradient, and from one to the next impulses, and the velocities that belong to them,
    go on along the direction before, by the ratio of the squares of the gradients; where these grow, it starts anew.
    Sweeps go there and back: supports are seen from the ground up, and loads from the top down. Joints are solved
    exactly before each. Returns how many there were, one more than the most where that was not enough.
    """
    most = islands.most_sweeps[island]
    is_settled, taken, ratio, square_before = True, most + 1, ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    first_mover, last_mover = islands.first_mover[island], islands.first_mover[island + 1]
    for place in range(first_mover, last_mover):
        for column in ti.static(range(12)):
            ahead[islands.movers[place]][column] = 0.0
    for number in range(most):
        by_joints = ti.cast(0.0, ti.f64)
        if ti.static(has_joints):
            for component in range(joint_first[island], joint_first[island + 1]):
                changed = relax_joints(joint_order[component], joints, velocity)
                is_settled = is_settled and changed >= 0.0
                by_joints = ti.max(by_joints, changed)
        for place in range(first_mover, last_mover):
            body = islands.movers[place]
            for column in ti.static(range(6)):
                ahead[body][column] = velocity[body][column]
        largest, square = sweep(rubs, number % 2 == 0, ratio, island, islands, system, velocity, work)
        if ti.max(largest, by_joints) <= may_change:
            taken = number + 1
            break
        ratio, square_before = ratio_of(square, square_before), square
        if number < most - 1:
            for place in range(first_mover, last_mover):
                body = islands.movers[place]
                for column in ti.static(range(6)):
                    on = ratio * ahead[body][6 + column]
                    ahead[body][6 + column] = on + velocity[body][column] - ahead[body][column]
                    velocity[body][column] += on
    return ti.select(is_settled, taken, most + 1)


@ti.func
def wanted_apart(
    gap: ti.f64,
    along_normal: ti.f64,
    rate: ti.f64,
    slop: ti.f64,
    dt: ti.f64,
    is_placed: bool,
    rest: ti.f64,
    fall: ti.f64,
):
    """Velocity along the normal that moves a contact apart, or which it may have beside what others do [m/s].

    Overlaps shrink; bounces end where they would have come to; others may close by what velocities leave of their gaps.
    Arguments are those of `Overlaps`. Returns whether it moves something, too.
    """
    depth, room = -gap - slop, ti.max(gap, 0.0)
    wanted = rate * depth
    if is_placed:
        wanted = (rest * (along_normal - 0.5 * fall) - room) / dt - along_normal
    elif depth <= 0.0:
        wanted = ti.min(-room / dt - along_normal, 0.0)
    return wanted, is_placed or depth > 0.0


@func
def solve_island(
    has_joints: ti.template(),
    island: ti.i32,
    islands: Islands,
    system: System,
    joint_order: ti.template(),
    joint_first: ti.template(),
    joints: ti.template(),
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    tolerance_apart: ti.f64,
    overlaps: Overlaps,
    found: Outcomes,
):
    """Solve an island for velocities, then for those that move bodies apart; arguments are those of the kernels."""
    begin, end = islands.spans[islands.first[island]], islands.spans[islands.first[island + 1]]
    may_change = ti.cast(0.0, ti.f64)
    for pair in range(islands.first[island], islands.first[island + 1]):
        for at in range(islands.spans[pair], islands.spans[pair + 1]):
            contact = islands.order[at]
            one, two = system.bodies[contact, 0], system.bodies[contact, 1]
            point = row_of(system.point, contact)
            gather_contact(
                at,
                row_of(system.normal, contact),
                point - row_of(system.position, one),
                point - row_of(system.position, two),
                row_of(found.impulses, contact),
                system.friction[contact],
                system.least[contact],
                one,
                two,
                system.ease,
                found.work,
            )
            free = velocity_at(at, one, two, found.work, found.velocity)
            may_change = ti.max(may_change, ti.abs(free).max(), ti.abs(system.least[contact]))
    may_change = tolerance + relative_tolerance * may_change
    for at in range(begin, end):
        contact = islands.order[at]
        one, two = system.bodies[contact, 0], system.bodies[contact, 1]
        push_both(one, two, along_axes(at, IMPULSE, found.work), at, system.ease, found.velocity, found.work)
    taken = relax_contacts(
        True, has_joints, island, may_change, islands, system, joint_order, joint_first, joints,
        found.velocity, found.ahead, found.work,
    )  # fmt: skip
    if ti.static(has_joints):
        is_settled = True
        for component in range(joint_first[island], joint_first[island + 1]):
            is_settled = is_settled and relax_joints(joint_order[component], joints, found.velocity) >= 0.0
        taken = ti.select(is_settled, taken, islands.most_sweeps[island] + 1)
    found.sweeps[island, 0], found.sweeps[island, 1] = taken, 0
    may_change, moves_apart = ti.cast(0.0, ti.f64), False
    for at in range(begin, end):
        contact = islands.order[at]
        one, two = system.bodies[contact, 0], system.bodies[contact, 1]
        impulse = along_axes(at, IMPULSE, found.work)
        along_normal = velocity_at(at, one, two, found.work, found.velocity).dot(vector_of(found.work, at, NORMAL))
        for axis in ti.static(range(3)):
            found.impulses[contact, axis] = impulse[axis]
        found.along_normal[contact] = along_normal
        is_placed = overlaps.is_placed[contact] == 1
        wanted, asks = wanted_apart(
            overlaps.gap[contact], along_normal, overlaps.rate, overlaps.slop, overlaps.dt,
            is_placed, overlaps.rest[contact], overlaps.fall[contact],
        )  # fmt: skip
        moves_apart = moves_apart or asks
        may_change = ti.max(may_change, tolerance_apart * ti.abs(wanted))
        found.work[at][LEAST] = wanted
        found.work[at][LOWEST] = ti.select(is_placed, -ti.cast(UNBOUNDED, ti.f64), 0.0)
        found.work[at][IMPULSE], found.work[at][CHANGE], found.work[at][AHEAD] = 0.0, 0.0, 0.0
    if moves_apart and overlaps.rate > 0.0:
        found.sweeps[island, 1] = relax_contacts(
            False, False, island, may_change, islands, system, joint_order, joint_first, joints,
            found.extra, found.ahead, found.work,
        )  # fmt: skip


@kernel_of_host_arrays
def solve_islands(
    islands: Islands,
    system: System,
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    tolerance_apart: ti.f64,
    overlaps: Overlaps,
    found: Outcomes,
):
    """Solve every island of contacts.

    Args:
        islands: which contacts, in which order.
        system: the contacts.
        relative_tolerance: part of the largest velocity at contacts of the island without impulses that may change.
        tolerance: what may change besides [m/s].
        tolerance_apart: part of the largest velocity that is wanted to move bodies apart that may change.
        overlaps: what moves bodies apart.
        found: out.
    """
    for island in range(islands.most_sweeps.shape[0]):
        solve_island(
            False, island, islands, system, islands.order, islands.order, system,
            relative_tolerance, tolerance, tolerance_apart, overlaps, found,
        )  # fmt: skip


@kernel_of_host_arrays
def solve_jointed_islands(
    islands: Islands,
    system: System,
    joint_order: Whole,
    joint_first: Whole,
    joints: JointRows,
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    tolerance_apart: ti.f64,
    overlaps: Overlaps,
    found: Outcomes,
):
    """Solve every island of contacts and joints; further arguments as those of `solve_islands`.

    Args:
        joint_order: components of joints, island after island.
        joint_first: where those of each island begin, and the end of the last, (islands + 1,).
        joints: their rows, without impulses at first.
    """
    for island in range(islands.most_sweeps.shape[0]):
        solve_island(
            True, island, islands, system, joint_order, joint_first, joints,
            relative_tolerance, tolerance, tolerance_apart, overlaps, found,
        )  # fmt: skip


@ti.func
def join(one: ti.i32, two: ti.i32, group: Whole):
    """Have two bodies be of one group: what belongs to a larger number belongs to the smaller one as well."""
    larger, smaller = ti.max(one, two), ti.min(one, two)
    while larger != smaller:
        before = ti.atomic_min(group[larger], smaller)
        if before == larger:
            larger = smaller  # it was the first of its group
        else:
            larger, smaller = ti.max(before, smaller), ti.min(before, smaller)


@kernel_of_host_arrays
def join_bodies(bodies: WholeRows, links: WholeRows, moves: Whole, group: Whole):
    """Groups of bodies that contacts, (c, 2), and links, (l, 2), hang together by way of bodies that move.

    Args:
        group: each body's own number, and then the least number of its group, whatever the order of the threads.
    """
    for contact in range(bodies.shape[0]):
        if moves[bodies[contact, 0]] == 1 and moves[bodies[contact, 1]] == 1:
            join(bodies[contact, 0], bodies[contact, 1], group)
    for link in range(links.shape[0]):
        join(links[link, 0], links[link, 1], group)
    for body in range(group.shape[0]):
        first = group[body]
        while group[first] != first:
            first = group[first]
        group[body] = first
