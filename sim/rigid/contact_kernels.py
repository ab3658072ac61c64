"""Projected Gauss-Seidel on the impulses of contacts, island by island, in one launch."""

import taichi as ti

Numbers = ti.types.ndarray(dtype=ti.f64, ndim=1)
Rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)
Pairs = ti.types.ndarray(dtype=ti.i32, ndim=2)

MAX_FRICTION_STEPS = 12
FRICTION_ROUNDING = 1.0e-12  # of the square of the impulse over that of its limit, where Newton's steps end


@ti.func
def velocity_along(i: ti.i32, row: ti.i32, jacobian: Rows, movers: Pairs, change: Rows) -> ti.f64:
    """Change of the velocity at contact i along one of its axes, by the changes of its bodies' velocities."""
    along = ti.cast(0.0, ti.f64)
    for side in ti.static(range(2)):
        body = movers[i, side]
        if body >= 0:
            for column in range(6):
                along += jacobian[i, 18 * side + 6 * row + column] * change[body, column]
    return along


@ti.func
def push(i: ti.i32, row: ti.i32, impulse: ti.f64, response: Rows, movers: Pairs, change: Rows):
    """Add what an impulse along an axis of contact i changes of the velocities of its bodies."""
    for side in ti.static(range(2)):
        body = movers[i, side]
        if body >= 0:
            for column in range(6):
                change[body, column] += response[i, 18 * side + 6 * row + column] * impulse


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


@ti.kernel
def sweep_islands(
    order: Whole,
    first: Whole,
    movers: Pairs,
    jacobian: Rows,
    response: Rows,
    own: Rows,
    bias: Rows,
    lowest: Numbers,
    friction: Numbers,
    tolerance: Numbers,
    most_sweeps: ti.i32,
    impulses: Rows,
    change: Rows,
    work: Rows,
    sweeps: Whole,
):
    """Solve every island until a sweep changes no contact velocity by more than a tolerance.

    Sweeps are steps of a nonsmooth nonlinear conjugate gradient method (Silcowitz-Hansen, Niebe & Erleben 2010): what a
    sweep changes is the negative gradient, and from one to the next the impulses go on along the direction before, by
    the ratio of the squares of the gradients; where these grow, it starts anew. The last is a mere sweep.

    Args:
        order: contacts, island after island, (k,).
        first: where each island begins in `order`, and the end of the last, (islands + 1,).
        movers: the two bodies of each contact, -1 where nothing moves it, (c, 2).
        jacobian: of each contact, by body, axis and component, (c, 36).
        response: likewise, M⁻¹ Jᵀ.
        own: block of A of each contact: nn, n1, n2, 11, 12, 22, (c, 6).
        bias: velocities at the contacts without impulses, less the least normal ones [m/s], (c, 3).
        lowest: bounds of the normal impulses from below [N s], (c,).
        friction: coefficients mu [-], (c,).
        tolerance: of each island [m/s], (islands,).
        most_sweeps: after which an island is given up.
        impulses: to start from, and found [N s], (c, 3).
        change: of the bodies' velocities by these impulses, (n, 6): nothing at first.
        work: room for impulses before a sweep, and for directions, (c, 6).
        sweeps: out: how many each island took, one more than the most where it was given up, (islands,).
    """
    for island in range(first.shape[0] - 1):
        begin, end = first[island], first[island + 1]
        for at in range(begin, end):
            for row in range(3):
                push(order[at], row, impulses[order[at], row], response, movers, change)
            for row in range(3):
                work[order[at], 3 + row] = 0.0
        taken, square_before = most_sweeps + 1, ti.cast(0.0, ti.f64)
        for sweep in range(most_sweeps):
            largest, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for at in range(begin, end):
                for row in range(3):
                    work[order[at], row] = impulses[order[at], row]
            for at in range(begin, end):
                # There and back: supports are seen from the ground up, and loads from the top down.
                i = order[ti.select(sweep % 2 == 0, at, begin + end - 1 - at)]
                old_n = impulses[i, 0]
                w_n = bias[i, 0] + velocity_along(i, 0, jacobian, movers, change)
                new_n = ti.max(old_n - w_n / own[i, 0], lowest[i])
                rubs = impulses[i, 1] != 0.0 or impulses[i, 2] != 0.0
                if new_n != 0.0 or old_n != 0.0 or rubs:
                    push(i, 0, new_n - old_n, response, movers, change)
                    impulses[i, 0] = new_n
                    largest = ti.max(largest, own[i, 0] * ti.abs(new_n - old_n))
                    if friction[i] > 0.0:
                        old_1, old_2 = impulses[i, 1], impulses[i, 2]
                        # Slip without the tangential impulses of this contact.
                        c_1 = bias[i, 1] + velocity_along(i, 1, jacobian, movers, change)
                        c_2 = bias[i, 2] + velocity_along(i, 2, jacobian, movers, change)
                        c_1 -= own[i, 3] * old_1 + own[i, 4] * old_2
                        c_2 -= own[i, 4] * old_1 + own[i, 5] * old_2
                        new_1, new_2 = friction_impulse(own[i, 3], own[i, 4], own[i, 5], c_1, c_2, friction[i] * new_n)
                        push(i, 1, new_1 - old_1, response, movers, change)
                        push(i, 2, new_2 - old_2, response, movers, change)
                        impulses[i, 1], impulses[i, 2] = new_1, new_2
                        largest = ti.max(largest, own[i, 3] * ti.abs(new_1 - old_1))
                        largest = ti.max(largest, own[i, 5] * ti.abs(new_2 - old_2))
            if largest <= tolerance[island]:
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
                            push(i, row, ahead, response, movers, change)
        sweeps[island] = taken
