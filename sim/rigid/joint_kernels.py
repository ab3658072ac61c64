"""Impulses of joints: all rows of the bodies that joints link are solved at once, by a sparse factorization."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.launch import kernel_of_host_arrays
from sim.rigid.array_types import Numbers, Rows, Velocities, Whole, WholeRows

BODIES, MOVES, PARENT, COLUMN, FACTOR, STATE, PATTERN, FLAG, FILLED, NEXT, WHOLE_COLUMNS = (
    0, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12,
)  # fmt: skip
"""Columns of `JointRows.whole`: the two bodies; whether impulses move them; the parent in the elimination tree; where
the row's entries of the matrix begin, and those of its column of L; its state; room for the factorization; the state
that it is to have next."""

JACOBIAN, RESPONSE, BIAS, SOFTNESS, LOWER, UPPER, IMPULSE, OWN, PIVOT, SOLVED, NUMBER_COLUMNS = (
    0, 12, 24, 25, 26, 27, 28, 29, 30, 31, 32,
)  # fmt: skip
"""Columns of `JointRows.numbers`: J and M⁻¹ Jᵀ of both bodies; the velocity that is wanted, negative;
velocity that an impulse of 1 N s adds by giving way; bounds of the impulse; the impulse; the diagonal of A; room."""

FREE, AT_LOWER, AT_UPPER, OFF = 0, 1, 2, 3
"""States of a row: its velocity is the wanted one; its impulse is at a bound; it is not there."""

BEGIN, END, IS_FACTORED, COMPONENT_COLUMNS = 0, 1, 2, 3

REGULARIZATION = 1.0e-10  # of the diagonal: rows that say the same share the impulse (Lacoursiere 2007)
BLOCK_ROUNDS = 12  # of exchanging all rows that are wrong; after them the first one alone
MOST_ROUNDS = 200
ROUNDING = 1.0e-10  # velocity [m/s], [rad/s] that counts as none where bounds are looked at


@bundle
class JointRows(NamedTuple):
    """Rows of joints, (r,), in the order of their elimination, and A = J M⁻¹ Jᵀ of them, column by column."""

    whole: WholeRows  # (r + 1, WHOLE_COLUMNS)
    numbers: Rows  # (r, NUMBER_COLUMNS)
    entry_rows: Whole  # rows of the entries of A on and above the diagonal, (e,)
    entries: Numbers  # (e,)
    factor_rows: Whole  # of L without its diagonal, (f,)
    factor: Numbers  # (f,)
    components: WholeRows  # first row and end of the rows that joints link, and whether A is factored, (c, 3)


@func
def joint_velocity(k: ti.i32, joints: JointRows, velocity: Velocities) -> ti.f64:
    """Velocity of a row less the wanted one, with its own giving way."""
    along = joints.numbers[k, BIAS] + joints.numbers[k, SOFTNESS] * joints.numbers[k, IMPULSE]
    for side in ti.static(range(2)):
        body = joints.whole[k, BODIES + side]
        for column in range(6):
            along += joints.numbers[k, JACOBIAN + 6 * side + column] * velocity[body][column]
    return along


@func
def push_joint(k: ti.i32, impulse: ti.f64, joints: JointRows, velocity: Velocities):
    """Add what an impulse of a row changes of the velocities of its bodies."""
    for side in ti.static(range(2)):
        body = joints.whole[k, BODIES + side]
        if joints.whole[k, MOVES + side] == 1:
            for column in range(6):
                velocity[body][column] += joints.numbers[k, RESPONSE + 6 * side + column] * impulse


@func
def factorize(begin: ti.i32, end: ti.i32, joints: JointRows):
    """L D Lᵀ of the free rows from one to another, row by row along the elimination tree.

    Davis 2005, "Algorithm 849: A concise sparse Cholesky factorization package". Rows that are not free are decoupled.
    """
    for k in range(begin, end):
        joints.whole[k, FLAG], joints.whole[k, FILLED] = k, 0
        joints.numbers[k, SOLVED] = 0.0
        pivot, top = ti.cast(1.0, ti.f64), end
        if joints.whole[k, STATE] == FREE:
            for entry in range(joints.whole[k, COLUMN], joints.whole[k + 1, COLUMN]):
                i = joints.entry_rows[entry]
                if i == k:
                    own = joints.entries[entry]
                    pivot = own * (1.0 + ti.cast(REGULARIZATION, ti.f64)) + joints.numbers[k, SOFTNESS]
                elif joints.whole[i, STATE] == FREE:
                    joints.numbers[i, SOLVED] += joints.entries[entry]
                    length, node = 0, i
                    while joints.whole[node, FLAG] != k:
                        joints.whole[begin + length, PATTERN] = node
                        joints.whole[node, FLAG] = k
                        node = joints.whole[node, PARENT]
                        length += 1
                    while length > 0:
                        length -= 1
                        top -= 1
                        joints.whole[top, PATTERN] = joints.whole[begin + length, PATTERN]
            for at in range(top, end):
                i = joints.whole[at, PATTERN]
                y = joints.numbers[i, SOLVED]
                joints.numbers[i, SOLVED] = 0.0
                first = joints.whole[i, FACTOR]
                last = first + joints.whole[i, FILLED]
                for p in range(first, last):
                    joints.numbers[joints.factor_rows[p], SOLVED] -= joints.factor[p] * y
                share = y / joints.numbers[i, PIVOT]
                pivot -= share * y
                joints.factor_rows[last], joints.factor[last] = k, share
                joints.whole[i, FILLED] += 1
        joints.numbers[k, PIVOT] = pivot


@func
def substitute(begin: ti.i32, end: ti.i32, joints: JointRows):
    """Solve L D Lᵀ x = b in place."""
    for k in range(begin, end):
        first = joints.whole[k, FACTOR]
        for p in range(first, first + joints.whole[k, FILLED]):
            joints.numbers[joints.factor_rows[p], SOLVED] -= joints.factor[p] * joints.numbers[k, SOLVED]
    for back in range(begin, end):
        k = begin + end - 1 - back
        first = joints.whole[k, FACTOR]
        solved = joints.numbers[k, SOLVED] / joints.numbers[k, PIVOT]
        for p in range(first, first + joints.whole[k, FILLED]):
            solved -= joints.factor[p] * joints.numbers[joints.factor_rows[p], SOLVED]
        joints.numbers[k, SOLVED] = solved


@func
def next_state(k: ti.i32, joints: JointRows, velocity: Velocities) -> ti.i32:
    """The state that a row is to have by its impulse, or by its velocity where that is at a bound."""
    state, rounding = joints.whole[k, STATE], ti.cast(ROUNDING, ti.f64)
    if state == FREE:
        impulse, own = joints.numbers[k, IMPULSE], joints.numbers[k, OWN]
        if (joints.numbers[k, LOWER] - impulse) * own > rounding:
            state = AT_LOWER
        elif (impulse - joints.numbers[k, UPPER]) * own > rounding:
            state = AT_UPPER
    elif state != OFF:
        along = joint_velocity(k, joints, velocity)
        if (state == AT_LOWER and along < -rounding) or (state == AT_UPPER and along > rounding):
            state = FREE
    return state


@func
def relax_joints(component: ti.i32, joints: JointRows, velocity: Velocities) -> ti.f64:
    """Impulses of all rows that joints link, for the other impulses as they are; how much a velocity changed.

    A mixed linear complementarity problem: block principal pivoting (Kostreva 1978), which exchanges all rows that are
    wrong; should it cycle, the first one alone, which ends (Murty 1974). Negative where it did not end.
    """
    begin, end = joints.components[component, BEGIN], joints.components[component, END]
    largest, is_settled = ti.cast(0.0, ti.f64), False
    for rounds in range(MOST_ROUNDS):
        if joints.components[component, IS_FACTORED] == 0:
            factorize(begin, end, joints)
            joints.components[component, IS_FACTORED] = 1
        for k in range(begin, end):
            joints.numbers[k, SOLVED] = 0.0
            if joints.whole[k, STATE] == FREE:
                joints.numbers[k, SOLVED] = -joint_velocity(k, joints, velocity)
        substitute(begin, end, joints)
        for k in range(begin, end):
            if joints.whole[k, STATE] == FREE:
                step = joints.numbers[k, SOLVED]
                joints.numbers[k, IMPULSE] += step
                push_joint(k, step, joints, velocity)
                largest = ti.max(largest, ti.abs(step) * joints.numbers[k, OWN])
        wrong = 0
        for k in range(begin, end):
            joints.whole[k, NEXT] = joints.whole[k, STATE]
            if rounds < BLOCK_ROUNDS or wrong == 0:
                joints.whole[k, NEXT] = next_state(k, joints, velocity)
                wrong += ti.cast(joints.whole[k, NEXT] != joints.whole[k, STATE], ti.i32)
        if wrong == 0:
            is_settled = True
            break
        joints.components[component, IS_FACTORED] = 0
        for k in range(begin, end):
            state = joints.whole[k, NEXT]
            if state != joints.whole[k, STATE]:
                joints.whole[k, STATE] = state
                if state != FREE:
                    bound = joints.numbers[k, ti.select(state == AT_LOWER, LOWER, UPPER)]
                    push_joint(k, bound - joints.numbers[k, IMPULSE], joints, velocity)
                    joints.numbers[k, IMPULSE] = bound
    return ti.select(is_settled, largest, ti.cast(-1.0, ti.f64))


@kernel_of_host_arrays
def solve_joints(joints: JointRows, velocity: Velocities, is_settled: Whole):
    """Impulses of all joints that no contact has a part in; where the work on a component ended, is 1, (c,).

    Some rows take microseconds: waking threads would take longer.
    """
    ti.loop_config(serialize=True)
    for component in range(joints.components.shape[0]):
        by_joints = relax_joints(component, joints, velocity)
        is_settled[component] = ti.cast(by_joints >= 0.0, ti.i32)
