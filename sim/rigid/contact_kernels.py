"""Projected Gauss-Seidel on the impulses of contacts, island by island, in one launch."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.joint_kernels import JointRows, relax_joints

Numbers = ti.types.ndarray(dtype=ti.f64, ndim=1)
Rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)
Pairs = ti.types.ndarray(dtype=ti.i32, ndim=2)

MAX_FRICTION_STEPS = 12
FRICTION_ROUNDING = 1.0e-12  # of the square of the impulse over that of its limit, where Newton's steps end


@bundle
class System(NamedTuple):
    """Contacts, (c,), and what is asked of them."""

    movers: Pairs  # the two bodies of each, -1 where nothing moves it, (c, 2)
    jacobian: Rows  # by body, axis and component, (c, 36)
    response: Rows  # likewise, M⁻¹ Jᵀ
    own: Rows  # block of A: nn, n1, n2, 11, 12, 22, (c, 6)
    bias: Rows  # velocities without impulses, less the least normal ones [m/s], (c, 3)
    lowest: Numbers  # bounds of the normal impulses from below [N s]
    friction: Numbers  # coefficients mu [-]


@func
def velocity_along(i: ti.i32, row: ti.i32, system: System, change: Rows) -> ti.f64:
    """Change of the velocity at contact i along one of its axes, by the changes of its bodies' velocities."""
    along = ti.cast(0.0, ti.f64)
    for side in ti.static(range(2)):
        body = system.movers[i, side]
        if body >= 0:
            for column in range(6):
                along += system.jacobian[i, 18 * side + 6 * row + column] * change[body, column]
    return along


@func
def push(i: ti.i32, row: ti.i32, impulse: ti.f64, system: System, change: Rows):
    """Add what an impulse along an axis of contact i changes of the velocities of its bodies."""
    for side in ti.static(range(2)):
        body = system.movers[i, side]
        if body >= 0:
            for column in range(6):
                change[body, column] += system.response[i, 18 * side + 6 * row + column] * impulse


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
def relax_contact(i: ti.i32, system: System, impulses: Rows, change: Rows) -> ti.f64:
    """Impulses of a contact for all others as they are; by how much a velocity of it changed."""
    largest = ti.cast(0.0, ti.f64)
    old_n = impulses[i, 0]
    w_n = system.bias[i, 0] + velocity_along(i, 0, system, change)
    new_n = ti.max(old_n - w_n / system.own[i, 0], system.lowest[i])
    rubs = impulses[i, 1] != 0.0 or impulses[i, 2] != 0.0
    if new_n != 0.0 or old_n != 0.0 or rubs:
        push(i, 0, new_n - old_n, system, change)
        impulses[i, 0] = new_n
        largest = system.own[i, 0] * ti.abs(new_n - old_n)
        if system.friction[i] > 0.0:
            old_1, old_2 = impulses[i, 1], impulses[i, 2]
            # Slip without the tangential impulses of this contact.
            c_1 = system.bias[i, 1] + velocity_along(i, 1, system, change)
            c_2 = system.bias[i, 2] + velocity_along(i, 2, system, change)
            a_11, a_12, a_22 = system.own[i, 3], system.own[i, 4], system.own[i, 5]
            c_1 -= a_11 * old_1 + a_12 * old_2
            c_2 -= a_12 * old_1 + a_22 * old_2
            new_1, new_2 = friction_impulse(a_11, a_12, a_22, c_1, c_2, system.friction[i] * new_n)
            push(i, 1, new_1 - old_1, system, change)
            push(i, 2, new_2 - old_2, system, change)
            impulses[i, 1], impulses[i, 2] = new_1, new_2
            largest = ti.max(largest, a_11 * ti.abs(new_1 - old_1))
            largest = ti.max(largest, a_22 * ti.abs(new_2 - old_2))
    return largest


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
    tolerance: Numbers,
    most_sweeps: ti.i32,
    impulses: Rows,
    change: Rows,
    work: Rows,
    sweeps: Whole,
):
    """Solve an island until a sweep changes no velocity at contacts or joints by more than a tolerance.

    Sweeps are steps of a nonsmooth nonlinear conjugate gradient method (Silcowitz-Hansen, Niebe & Erleben 2010): what a
    sweep changes is the negative gradient, and from one to the next the impulses go on along the direction before, by
    the ratio of the squares of the gradients; where these grow, it starts anew. The last is a mere sweep. Joints are
    solved exactly before the contacts, and in the end. Arguments as those of the kernels.
    """
    begin, end = first[island], first[island + 1]
    for at in range(begin, end):
        for row in range(3):
            push(order[at], row, impulses[order[at], row], system, change)
        for row in range(3):
            work[order[at], 3 + row] = 0.0
    taken, square_before = most_sweeps + 1, ti.cast(0.0, ti.f64)
    is_settled = True
    for sweep in range(most_sweeps):
        largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        if ti.static(has_joints):
            for at in range(joint_first[island], joint_first[island + 1]):
                by_joints = relax_joints(joint_order[at], joints, change)
                is_settled = is_settled and by_joints >= 0.0
                largest = ti.max(largest, by_joints)
        for at in range(begin, end):
            for row in range(3):
                work[order[at], row] = impulses[order[at], row]
        for at in range(begin, end):
            # There and back: supports are seen from the ground up, and loads from the top down.
            i = order[ti.select(sweep % 2 == 0, at, begin + end - 1 - at)]
            largest = ti.max(largest, relax_contact(i, system, impulses, change))
        if largest <= tolerance[island] or begin == end:
            taken = sweep + 1
            break
        for at in range(begin, end):
            for row in range(3):
                square += (impulses[order[at], row] - work[order[at], row]) ** 2
        ratio = ti.cast(0.0, ti.f64)
        if 0.0 < square < square_before:
            ratio = square / square_before
        square_before = square
        if sweep < most_sweeps - 1:
            for at in range(begin, end):
                i = order[at]
                for row in range(3):
                    ahead = ratio * work[i, 3 + row]
                    work[i, 3 + row] = ahead + impulses[i, row] - work[i, row]
                    if ahead != 0.0:
                        impulses[i, row] += ahead
                        push(i, row, ahead, system, change)
    if ti.static(has_joints):
        for at in range(joint_first[island], joint_first[island + 1]):
            if begin < end:
                relax_joints(joint_order[at], joints, change)
    sweeps[island] = ti.select(is_settled, taken, most_sweeps + 1)


@kernel_of_host_arrays
def sweep_islands(
    order: Whole,
    first: Whole,
    system: System,
    tolerance: Numbers,
    most_sweeps: ti.i32,
    impulses: Rows,
    change: Rows,
    work: Rows,
    sweeps: Whole,
):
    """Solve every island of contacts.

    Args:
        order: contacts, island after island, (k,).
        first: where each island begins in `order`, and the end of the last, (islands + 1,).
        system: the contacts.
        tolerance: of each island [m/s], (islands,).
        most_sweeps: after which an island is given up.
        impulses: to start from, and found [N s], (c, 3).
        change: of the bodies' velocities by these impulses, (n, 6): nothing at first.
        work: room for impulses before a sweep, and for directions, (c, 6).
        sweeps: out: how many each island took, one more than the most where it was given up, (islands,).
    """
    for island in range(first.shape[0] - 1):
        sweep_island(
            False,
            island,
            order,
            first,
            system,
            order,
            first,
            system,
            tolerance,
            most_sweeps,
            impulses,
            change,
            work,
            sweeps,
        )


@kernel_of_host_arrays
def sweep_jointed_islands(
    order: Whole,
    first: Whole,
    system: System,
    joint_order: Whole,
    joint_first: Whole,
    joints: JointRows,
    tolerance: Numbers,
    most_sweeps: ti.i32,
    impulses: Rows,
    change: Rows,
    work: Rows,
    sweeps: Whole,
):
    """Solve every island of contacts and joints; further arguments as those of `sweep_islands`.

    Args:
        joint_order: components of joints, island after island.
        joint_first: where those of each island begin, and the end of the last, (islands + 1,).
        joints: their rows, with impulses 0, or at a bound that is 0, at first.
    """
    for island in range(first.shape[0] - 1):
        sweep_island(
            True,
            island,
            order,
            first,
            system,
            joint_order,
            joint_first,
            joints,
            tolerance,
            most_sweeps,
            impulses,
            change,
            work,
            sweeps,
        )
