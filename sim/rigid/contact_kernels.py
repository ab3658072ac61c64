"""Projected Gauss-Seidel on the impulses of contacts, island by island, in one launch."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.joint_kernels import JointRows, Velocities, relax_joints

Numbers = ti.types.ndarray(dtype=ti.f64, ndim=1)
Rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)
Pairs = ti.types.ndarray(dtype=ti.i32, ndim=2)
Vector3 = ti.types.vector(3, ti.f64)

MAX_FRICTION_STEPS = 12
FRICTION_ROUNDING = 1.0e-12  # of the square of the impulse over that of its limit, where Newton's steps end


NORMAL, TANGENT, ARM, OWN = 0, 3, 9, 15
LEAST, LOWEST, FRICTION, BODY, IMPULSE, BEFORE, AHEAD = 21, 22, 23, 24, 26, 29, 32
"""Columns of what a contact is while its island is solved: arms and bodies are two, tangents of three numbers too."""
COLUMNS = 35
Work = ti.types.ndarray(dtype=ti.types.vector(COLUMNS, ti.f64), ndim=1)
Eases = ti.types.ndarray(dtype=ti.types.vector(7, ti.f64), ndim=1)


@bundle
class System(NamedTuple):
    """Contacts, (c,), of bodies, (n,), and what is asked of them."""

    bodies: Pairs  # the two bodies of each, (c, 2)
    point: Rows  # [m], (c, 3)
    normal: Rows  # from the second to the first, (c, 3)
    least: Numbers  # bounds of the normal velocities from below [m/s]
    lowest: Numbers  # bounds of the normal impulses from below [N s]
    friction: Numbers  # coefficients mu [-]
    position: Rows  # centres of mass [m], (n, 3)
    ease: Eases  # inverse mass [1/kg] and inertia xx, xy, xz, yy, yz, zz in world axes [1/(kg m²)], (n,)


@ti.func
def vector_of(table: ti.template(), row: ti.i32, column: ti.i32) -> Vector3:
    """Three numbers of a table."""
    return Vector3(table[row][column], table[row][column + 1], table[row][column + 2])


@ti.func
def turned_by(ease: Eases, body: ti.i32, torque: Vector3) -> Vector3:
    """Change of a body's angular velocity by an angular impulse."""
    xx, xy, xz = ease[body][1], ease[body][2], ease[body][3]
    yy, yz, zz = ease[body][4], ease[body][5], ease[body][6]
    return Vector3(
        xx * torque[0] + xy * torque[1] + xz * torque[2],
        xy * torque[0] + yy * torque[1] + yz * torque[2],
        xz * torque[0] + yz * torque[1] + zz * torque[2],
    )


@ti.func
def velocity_at(at: ti.i32, work: Work, velocity: Velocities) -> Vector3:
    """The relative velocity of the bodies at a contact."""
    relative = Vector3(0.0)
    for side in ti.static(range(2)):
        body = ti.cast(work[at][BODY + side], ti.i32)
        arm = vector_of(work, at, ARM + 3 * side)
        own = vector_of(velocity, body, 0) + vector_of(velocity, body, 3).cross(arm)
        relative += own if ti.static(side == 0) else -own
    return relative


@ti.func
def push(at: ti.i32, impulse: Vector3, work: Work, ease: Eases, velocity: Velocities):
    """Give the bodies of a contact an impulse."""
    for side in ti.static(range(2)):
        body = ti.cast(work[at][BODY + side], ti.i32)
        if ease[body][0] > 0.0:
            own = impulse if ti.static(side == 0) else -impulse
            turn = turned_by(ease, body, vector_of(work, at, ARM + 3 * side).cross(own))
            for axis in ti.static(range(3)):
                velocity[body][axis] += ease[body][0] * own[axis]
                velocity[body][3 + axis] += turn[axis]


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
def gather(at: ti.i32, i: ti.i32, system: System, impulses: Rows, work: Work):
    """Put together what a contact is, its own block of A among it: nn, n1, n2, 11, 12, 22.

    Impulses to start from push, and stay within friction.
    """
    normal = Vector3(system.normal[i, 0], system.normal[i, 1], system.normal[i, 2])
    one, two = tangents_of(normal)
    start = Vector3(impulses[i, 0], impulses[i, 1], impulses[i, 2])
    along = Vector3(ti.max(start.dot(normal), 0.0), start.dot(one), start.dot(two))
    rubbing, limit = ti.sqrt(along[1] * along[1] + along[2] * along[2]), system.friction[i] * along[0]
    if rubbing > limit:
        along[1] *= limit / rubbing
        along[2] *= limit / rubbing
    for axis in ti.static(range(3)):
        work[at][NORMAL + axis], work[at][TANGENT + axis], work[at][TANGENT + 3 + axis] = (
            normal[axis],
            one[axis],
            two[axis],
        )
        work[at][IMPULSE + axis], work[at][AHEAD + axis] = along[axis], 0.0
    work[at][LEAST], work[at][LOWEST], work[at][FRICTION] = system.least[i], system.lowest[i], system.friction[i]
    block = ti.Vector.zero(ti.f64, 6)
    for side in ti.static(range(2)):
        body = system.bodies[i, side]
        work[at][BODY + side] = body
        for axis in ti.static(range(3)):
            work[at][ARM + 3 * side + axis] = system.point[i, axis] - system.position[body, axis]
        if system.ease[body][0] > 0.0:
            arm = vector_of(work, at, ARM + 3 * side)
            for row in ti.static(range(3)):
                axis = vector_of(work, at, NORMAL + 3 * row)
                answer = system.ease[body][0] * axis + turned_by(system.ease, body, arm.cross(axis)).cross(arm)
                for column in ti.static(range(row, 3)):
                    block[ti.static(entry_of(row, column))] += answer.dot(vector_of(work, at, NORMAL + 3 * column))
    for entry in ti.static(range(6)):
        work[at][OWN + entry] = block[entry]


def entry_of(row: int, column: int) -> int:
    """Place of an entry among those of the upper half of a symmetric matrix of three rows."""
    return 3 * row - row * (row - 1) // 2 + column - row


@ti.func
def friction_impulse(a_11: ti.f64, a_12: ti.f64, a_22: ti.f64, c_1: ti.f64, c_2: ti.f64, limit: ti.f64):
    """Tangential impulses x with slip w = A x + c: w = 0, or |x| = limit and w = -κ x with κ > 0.

    The second solves (A + κ) x = -c; Newton's method on 1/limit = 1/|x(κ)|, which is nearly linear in κ, approaches
    its root from below (Conn, Gould & Toint 2000, "Trust-region methods", 7.3).
    """
    x_1, x_2 = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    if limit > 0.0:
        kappa, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        most = limit * limit * (1.0 + ti.cast(FRICTION_ROUNDING, ti.f64))
        is_found = False
        for _ in range(MAX_FRICTION_STEPS):
            d_11, d_22 = a_11 + kappa, a_22 + kappa
            determinant = d_11 * d_22 - a_12 * a_12
            x_1, x_2 = (a_12 * c_2 - d_22 * c_1) / determinant, (a_12 * c_1 - d_11 * c_2) / determinant
            square = x_1 * x_1 + x_2 * x_2
            if square <= most:
                is_found = True
                break
            # -x·dx/dκ = x·(A + κ)⁻¹x
            fall = (d_22 * x_1 * x_1 - 2.0 * a_12 * x_1 * x_2 + d_11 * x_2 * x_2) / determinant
            kappa += (ti.sqrt(square) / limit - 1.0) * square / fall
        if not is_found:
            scale = limit / ti.sqrt(square)
            x_1, x_2 = scale * x_1, scale * x_2
    return x_1, x_2


@func
def sweep_island(
    has_joints: ti.template(),
    island: ti.i32,
    order: Whole,
    first: Whole,
    system: System,
    joint_order: ti.template(),
    joint_first: ti.template(),
    joints: ti.template(),
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    most_sweeps: Whole,
    impulses: Rows,
    velocity: Velocities,
    along_normal: Numbers,
    work: Work,
    sweeps: Whole,
):
    """Solve an island until a sweep changes no velocity at contacts, or of joints, by more than a tolerance.

    Sweeps are steps of a nonsmooth nonlinear conjugate gradient method (Silcowitz-Hansen, Niebe & Erleben 2010): what a
    sweep changes is the negative gradient, and from one to the next the impulses go on along the direction before, by
    the ratio of the squares of the gradients; where these grow, it starts anew. The last is a mere sweep. Joints are
    solved exactly before each, and in the end. Arguments are those of the kernels.
    """
    begin, end, most = first[island], first[island + 1], most_sweeps[island]
    may_change = ti.cast(0.0, ti.f64)
    for at in range(begin, end):
        gather(at, order[at], system, impulses, work)
        free = velocity_at(at, work, velocity)
        may_change = ti.max(may_change, ti.abs(free).max(), ti.abs(work[at][LEAST]))
    may_change = tolerance + relative_tolerance * may_change
    for at in range(begin, end):
        push(at, along_axes(at, IMPULSE, work), work, system.ease, velocity)
    is_settled = True
    taken, square_before = most + 1, ti.cast(0.0, ti.f64)
    for sweep in range(most):
        largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        if ti.static(has_joints):
            for number in range(joint_first[island], joint_first[island + 1]):
                by_joints = relax_joints(joint_order[number], joints, velocity)
                is_settled = is_settled and by_joints >= 0.0
                largest = ti.max(largest, by_joints)
        for step in range(begin, end):
            # There and back: supports are seen from the ground up, and loads from the top down.
            at = ti.select(sweep % 2 == 0, step, begin + end - 1 - step)
            old_n, old_1, old_2 = work[at][IMPULSE], work[at][IMPULSE + 1], work[at][IMPULSE + 2]
            work[at][BEFORE], work[at][BEFORE + 1], work[at][BEFORE + 2] = old_n, old_1, old_2
            own = velocity_at(at, work, velocity)
            w_n = own.dot(vector_of(work, at, NORMAL)) - work[at][LEAST]
            new_n = ti.max(old_n - w_n / work[at][OWN], work[at][LOWEST])
            if new_n != 0.0 or old_n != 0.0 or old_1 != 0.0 or old_2 != 0.0:
                d_n, d_1, d_2 = new_n - old_n, ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
                largest = ti.max(largest, work[at][OWN] * ti.abs(d_n))
                if work[at][FRICTION] > 0.0:
                    # Slip without the tangential impulses of this contact.
                    a_11, a_12, a_22 = work[at][OWN + 3], work[at][OWN + 4], work[at][OWN + 5]
                    c_1 = own.dot(vector_of(work, at, TANGENT))
                    c_2 = own.dot(vector_of(work, at, TANGENT + 3))
                    c_1 += work[at][OWN + 1] * d_n - a_11 * old_1 - a_12 * old_2
                    c_2 += work[at][OWN + 2] * d_n - a_12 * old_1 - a_22 * old_2
                    new_1, new_2 = friction_impulse(a_11, a_12, a_22, c_1, c_2, work[at][FRICTION] * new_n)
                    d_1, d_2 = new_1 - old_1, new_2 - old_2
                    work[at][IMPULSE + 1], work[at][IMPULSE + 2] = new_1, new_2
                    largest = ti.max(largest, a_11 * ti.abs(d_1), a_22 * ti.abs(d_2))
                work[at][IMPULSE] = new_n
                added = d_n * vector_of(work, at, NORMAL)
                added += d_1 * vector_of(work, at, TANGENT) + d_2 * vector_of(work, at, TANGENT + 3)
                push(at, added, work, system.ease, velocity)
                square += d_n * d_n + d_1 * d_1 + d_2 * d_2
        if largest <= may_change:
            taken = sweep + 1
            break
        ratio = ti.cast(0.0, ti.f64)
        if 0.0 < square < square_before:
            ratio = square / square_before
        square_before = square
        if sweep < most - 1:
            for at in range(begin, end):
                is_ahead = False
                for row in ti.static(range(3)):
                    ahead = ratio * work[at][AHEAD + row]
                    work[at][AHEAD + row] = ahead + work[at][IMPULSE + row] - work[at][BEFORE + row]
                    work[at][IMPULSE + row] += ahead
                    work[at][BEFORE + row] = ahead
                    is_ahead |= ahead != 0.0
                if is_ahead:
                    push(at, along_axes(at, BEFORE, work), work, system.ease, velocity)
    if ti.static(has_joints):
        for number in range(joint_first[island], joint_first[island + 1]):
            is_settled = is_settled and relax_joints(joint_order[number], joints, velocity) >= 0.0
    for at in range(begin, end):
        found = along_axes(at, IMPULSE, work)
        for axis in ti.static(range(3)):
            impulses[order[at], axis] = found[axis]
        along_normal[order[at]] = velocity_at(at, work, velocity).dot(vector_of(work, at, NORMAL))
    sweeps[island] = ti.select(is_settled, taken, most + 1)


@kernel_of_host_arrays
def sweep_islands(
    order: Whole,
    first: Whole,
    system: System,
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    most_sweeps: Whole,
    impulses: Rows,
    velocity: Velocities,
    along_normal: Numbers,
    work: Work,
    sweeps: Whole,
):
    """Solve every island of contacts.

    Args:
        order: contacts, island after island, (k,).
        first: where each island begins in `order`, and the end of the last, (islands + 1,).
        system: the contacts.
        relative_tolerance: part of the largest velocity at contacts of the island without impulses that may change.
        tolerance: what may change besides [m/s].
        most_sweeps: after which an island is given up, (islands,).
        impulses: to start from, and found, in world axes [N s], (c, 3).
        velocity: of the bodies without impulses, and with them [m/s], [rad/s], (n,).
        along_normal: out: relative velocity along the normals [m/s], (c,).
        work: room for what contacts are, (k,).
        sweeps: out: how many each island took, one more than the most where it was given up, (islands,).
    """
    for island in range(first.shape[0] - 1):
        sweep_island(
            False, island, order, first, system, order, first, system,
            relative_tolerance, tolerance, most_sweeps, impulses, velocity, along_normal, work, sweeps,
        )  # fmt: skip


@kernel_of_host_arrays
def sweep_jointed_islands(
    order: Whole,
    first: Whole,
    system: System,
    joint_order: Whole,
    joint_first: Whole,
    joints: JointRows,
    relative_tolerance: ti.f64,
    tolerance: ti.f64,
    most_sweeps: Whole,
    impulses: Rows,
    velocity: Velocities,
    along_normal: Numbers,
    work: Work,
    sweeps: Whole,
):
    """Solve every island of contacts and joints; further arguments as those of `sweep_islands`.

    Args:
        joint_order: components of joints, island after island.
        joint_first: where those of each island begin, and the end of the last, (islands + 1,).
        joints: their rows, without impulses at first.
    """
    for island in range(first.shape[0] - 1):
        sweep_island(
            True, island, order, first, system, joint_order, joint_first, joints,
            relative_tolerance, tolerance, most_sweeps, impulses, velocity, along_normal, work, sweeps,
        )  # fmt: skip
