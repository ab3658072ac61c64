"""Threads of rectangles, solved piece by piece instead of spring by spring."""

from collections.abc import Callable

import numpy as np
import taichi as ti

from sim.cloth.bundles import Nodes, SpringArrays, ThreadWork
from sim.cloth.device_springs import LANES, TINY_LENGTH, Bounds, DeviceSprings, between, column, set_column
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Integers
from sim.core.bundles import func, with_room
from sim.core.launch import kernel, large_kernel
from sim.core.reductions import runs_on_gpu
from sim.core.scheduling import LEAST_RUN
from sim.core.warps import WARP, largest_in_warp, on_cuda, whole_warps

TURNED_EXPLICITLY = 0.15
"""Tension, as dt² T (w_i + w_j) / |d| of a spring, up to which its direction may be fixed. With fixed directions, waves
across threads need dt² 4 T w / |d| <= 4, summed over the two threads of a node."""

LEAST_BLOCK = 32  # threads of a block of a GPU, at least: those that it runs as one

STRAIGHTENED = 0.35
"""Part of what is more that turns with the springs: waves are stable from 1/4 on, and neither damped nor driven."""

LEAST_WEIGHT = 1.0e-20  # inverse masses [1/kg] of two nodes that both are held are taken for this, in divisions
LEAST_ALIKE = 0.995  # cosine of the angle that a spring may turn by in a step for its direction to be that of the start

LARGEST_RESIDUAL = 0.5
"""Residual in rest lengths from which a spring counts as not converged: at a third of it cloth looks well still, as a
rubber sheet does that a heavy ball falls into; a bag of water that hangs from four nodes is drawn out to spikes."""


class ThreadSolver:
    """Block Gauss-Seidel: pieces of a thread of some springs each, colour by colour, every piece exactly.

    The multipliers of a piece follow from a tridiagonal system (Deul et al. 2018, "Direct position-based solver for
    stiff rods", here without branches), by parallel cyclic reduction in a block of a GPU's threads (Zhang, Cohen &
    Owens 2010, "Fast tridiagonal solvers on the GPU"), a row each; on a CPU `LANES` pieces side by side, from end to
    end and back (Thomas algorithm).

    Directions are those of the start, as in SHAKE (Ryckaert, Ciccotti & Berendsen 1977), but for springs that turn far
    in a step. Across the thread tension is an explicit force then, too strong where waves run along a spring within a
    step: `straighten` lets a part of what is more turn with its springs.

    Kernels here and in `integrators` write x = x + y: what stands at an index from memory Taichi would add to by an
    atomic operation for +=.
    """

    def __init__(self, springs: DeviceSprings) -> None:
        self.springs = springs
        starts = springs.on_device.segment_start.to_numpy()
        is_taut = ti.ndarray(ti.i32, len(starts) - 1)
        self._work: ThreadWork = with_room(ThreadWork, springs.count, is_taut=is_taut)
        self._found = ti.ndarray(ti.i32, 2)
        self._rows = LEAST_BLOCK
        while self._rows < np.diff(starts).max(initial=0) + 1:
            self._rows *= 2

    def displace(self, state: ClothState, dt: float, *, is_first: bool) -> None:
        """Bring the displacements of a step of dt [s] to where the threads let them go; multipliers start at 0."""
        springs, nodes = self.springs, state.nodes
        springs.contract(nodes, state.displacement)
        for bounds in springs.colours:
            solve_threads(springs.on_device, bounds, nodes, dt, int(is_first), self._work, self._rows, springs.at_once)

    def straighten(self, state: ClothState, dt: float) -> None:
        """Let tension turn with its springs, where it is too strong for fixed directions.

        The force of a spring changes across it by T/|d| times the displacement across it. Newmark's scheme takes it at
        x + beta (u - u*) for displacements u and those of the prediction u*: (M + beta dt² K) (u - u*) = M (u~ - u*)
        with u~ of the fixed directions, where K is the Laplacian of the thread with weights T/|d|.
        """
        springs = self.springs
        for bounds in springs.colours:
            straighten_threads(springs.on_device, bounds, state.nodes, dt, self._work, self._rows, springs.at_once)

    def excess(self, state: ClothState, dt: float) -> Callable[[], tuple[float, float]]:
        """Asks for the largest excess of a spring [rest lengths], and how many have not converged."""
        springs, multiplier = self.springs.on_device, self._work.multiplier
        return measure_excess.later(springs, multiplier, state.nodes, dt * dt, self._found)


@ti.func
def direction_of(at_start, predicted):
    """Along which a spring pushes: that of the start, or the predicted one if it turns far."""
    length = ti.max(at_start.norm(), TINY_LENGTH)
    return ti.select(at_start.dot(predicted) > LEAST_ALIKE * length, at_start / length, predicted)


@ti.func
def tension_to_turn(stress, weight):
    """What shall turn with a spring of a tension over its length; nothing if its nodes, of this `weight`, are held."""
    return STRAIGHTENED * ti.max(stress - TURNED_EXPLICITLY / ti.max(weight, LEAST_WEIGHT), 0.0)


@func
def corrected(i: ti.i32, nodes: Nodes, dt: ti.f32) -> ti.math.vec3:
    """By how much springs have changed the displacement of a node so far; by nothing if it is pinned."""
    change = ti.math.vec3(0.0)
    if nodes.inverse_mass[i] > 0.0:
        change = nodes.displacement[i] - (nodes.carry[i] + dt * nodes.velocity[i])
    return change


@ti.func
def reduced_row(j, rows: ti.template(), lower, diagonal, upper, right, shared: ti.template()):
    """x_j of lower x_j-1 + diagonal x_j + upper x_j+1 = right, a row for each thread of a block of a GPU.

    In every step a row adds multiples of the two rows s above and below it, which leave those of 2 s.
    """
    of_lower, of_diagonal, of_upper, of_x, of_y, of_z = shared
    s = 1
    while s < rows:
        ti.simt.block.sync()
        of_lower[j], of_diagonal[j], of_upper[j] = lower, diagonal, upper
        of_x[j], of_y[j], of_z[j] = right.x, right.y, right.z
        ti.simt.block.sync()
        above, below = 0.0, 0.0
        if j >= s:
            above = -lower / of_diagonal[j - s]
            diagonal += above * of_upper[j - s]
            right += above * ti.math.vec3(of_x[j - s], of_y[j - s], of_z[j - s])
            above *= of_lower[j - s]
        if j + s < rows:
            below = -upper / of_diagonal[j + s]
            diagonal += below * of_lower[j + s]
            right += below * ti.math.vec3(of_x[j + s], of_y[j + s], of_z[j + s])
            below *= of_upper[j + s]
        lower, upper = above, below
        s *= 2
    ti.simt.block.sync()
    return right / diagonal


@func
def solve_forth(
    first: ti.i32, end: ti.i32, springs: SpringArrays, nodes: Nodes, dt: ti.f32, is_first: ti.i32, work: ThreadWork
):
    """Eliminate the rows of `LANES` pieces, or of those that are left of a colour, from their first springs on.

    Loops over lanes that use local blocks alone become vector instructions. `tension` keeps lengths.
    """
    start, count, longest = ti.Vector.zero(ti.i32, LANES), ti.Vector.zero(ti.i32, LANES), 0
    u, x, n = ti.Matrix.zero(ti.f32, 3, LANES), ti.Matrix.zero(ti.i32, 3, LANES), ti.Matrix.zero(ti.f32, 3, LANES)
    before, after = ti.Matrix.zero(ti.f32, 3, LANES), ti.Matrix.zero(ti.f32, 3, LANES)
    w_i, w_j, missing = ti.Vector.zero(ti.f32, LANES), ti.Vector.zero(ti.f32, LANES), ti.Vector.zero(ti.f32, LANES)
    compliance, pivot = ti.Vector.zero(ti.f32, LANES) + 1.0, ti.Vector.zero(ti.f32, LANES)  # as without a spring
    change, factor, length = ti.Vector.zero(ti.f32, LANES), ti.Vector.zero(ti.f32, LANES), ti.Vector.zero(ti.f32, LANES)
    for at in range(ti.min(LANES, end - first)):
        start[at] = springs.segment_start[first + at]
        count[at] = springs.segment_start[first + at + 1] - start[at]
        longest = ti.max(longest, count[at])
        i = springs.nodes[2 * start[at]]
        set_column(u, at, nodes.displacement[i])
        set_column(x, at, nodes.lattice[i])
        w_i[at] = nodes.inverse_mass[i]
    for k in range(longest):
        for at in range(LANES):
            if k < count[at]:
                s = start[at] + k
                j, law = springs.nodes[2 * s + 1], springs.law[s]
                set_column(before, at, nodes.quantum * ti.cast(column(x, at) - nodes.lattice[j], ti.f32))
                set_column(after, at, column(before, at) + (column(u, at) - nodes.displacement[j]))
                set_column(u, at, nodes.displacement[j])
                set_column(x, at, nodes.lattice[j])
                w_j[at], compliance[at] = nodes.inverse_mass[j], 1.0 / (law[1] * dt * dt)
                missing[at] = law[0] - springs.shift[s] - ti.select(is_first, 0.0, compliance[at] * work.multiplier[s])
        for at in range(LANES):
            length[at] = ti.max(column(after, at).norm(), TINY_LENGTH)
            direction = direction_of(column(before, at), column(after, at) / length[at])
            coupling = -w_i[at] * direction.dot(column(n, at))  # n is of the spring before
            factor[at] = coupling * pivot[at]
            pivot[at] = 1.0 / (w_i[at] + w_j[at] + compliance[at] - coupling * factor[at])
            change[at] = (missing[at] - length[at] - coupling * change[at]) * pivot[at]
            w_i[at] = w_j[at]
            set_column(n, at, direction)
        for at in range(LANES):
            if k < count[at]:
                s = start[at] + k
                work.direction[s], work.tension[s] = column(n, at), length[at]
                work.change[s], work.factor[s] = change[at], factor[at]


@func
def solve_back(p: ti.i32, springs: SpringArrays, nodes: Nodes, is_first: ti.i32, work: ThreadWork):
    """The changes of a piece's multipliers from its last spring on, and where nodes move."""
    first, end = springs.segment_start[p], springs.segment_start[p + 1]
    change, factor, after, is_taut = 0.0, 0.0, ti.math.vec3(0.0), 0  # `after`: the push of the spring after the node
    j = springs.nodes[2 * end - 1]
    for k in range(end - first):
        s = end - 1 - k
        i = springs.nodes[2 * s]
        w_i, w_j = nodes.inverse_mass[i], nodes.inverse_mass[j]
        change = work.change[s] - factor * change
        factor = work.factor[s]
        push = change * work.direction[s]
        nodes.displacement[j] = nodes.displacement[j] + w_j * (after - push)
        multiplier = ti.select(is_first, 0.0, work.multiplier[s]) + change
        tension = tension_to_turn(-multiplier / work.tension[s], w_i + w_j)
        work.multiplier[s], work.tension[s] = multiplier, tension
        if tension > 0.0:
            is_taut = 1
        j, after = i, push
    nodes.displacement[j] = nodes.displacement[j] + nodes.inverse_mass[j] * after
    work.is_taut[p] = is_taut


@func
def straighten_piece(p: ti.i32, springs: SpringArrays, nodes: Nodes, dt: ti.f32, work: ThreadWork):
    """Solve a piece forth and back; `direction` and `factor` of a spring hold what is solved at its first node."""
    first, end = springs.segment_start[p], springs.segment_start[p + 1]
    e, share, tension = ti.math.vec3(0.0), 0.0, 0.0
    for s in range(first, end + 1):
        i = springs.nodes[ti.min(2 * s, 2 * end - 1)]
        change, w_i = corrected(i, nodes, dt), nodes.inverse_mass[i]
        pull = w_i * tension
        tension = ti.select(s < end, work.tension[ti.min(s, end - 1)], 0.0)
        pivot = 1.0 / (1.0 + w_i * tension + pull * (1.0 - share))
        e, share = pivot * (change + pull * e), pivot * w_i * tension
        if s < end:
            work.direction[s], work.factor[s] = e, share
        else:
            nodes.displacement[i] = nodes.displacement[i] + (e - change)
    for k in range(end - first):
        s = end - 1 - k
        i = springs.nodes[2 * s]
        e = work.direction[s] + work.factor[s] * e
        nodes.displacement[i] = nodes.displacement[i] + (e - corrected(i, nodes, dt))


@large_kernel
def solve_threads(
    springs: SpringArrays,
    bounds: Bounds,
    nodes: Nodes,
    dt: ti.f32,
    is_first: ti.i32,
    work: ThreadWork,
    rows: ti.template(),
    colours: ti.template(),
):
    """So many colours, within their bounds, each piece exactly, by `rows` threads of a GPU:

        (w_s + w_s+1 + a) D_s - w_s n_s-1.n_s D_s-1 - w_s+1 n_s.n_s+1 D_s+1 = -C_s - a l_s,   a = 1/(k dt²)

    Spring s leads from node s to node s + 1 of the piece, n_s is its direction, l_s its multiplier and D_s the change
    of that. `tension` becomes what turns of -l_s / |d|, `is_taut` whether a piece has too much of it.
    """
    threads = ti.static(rows if runs_on_gpu() else 1)
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = threads * bounds
    for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
        if ti.static(runs_on_gpu()):
            ti.loop_config(block_dim=rows)
            for row in range(begin, end):
                p, k = row // rows, row % rows
                s, count = springs.segment_start[p] + k, springs.segment_start[p + 1] - springs.segment_start[p]
                one, two = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                three, of_x = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                of_y, of_z = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                at_x, at_y = ti.simt.block.SharedArray((rows,), ti.i32), ti.simt.block.SharedArray((rows,), ti.i32)
                at_z = ti.simt.block.SharedArray((rows,), ti.i32)
                # Nodes of columns are far from each other in memory: each is read once, by the thread of its place.
                i, w_i, u, x = -1, 0.0, ti.math.vec3(0.0), ti.math.ivec3(0)
                if k < count:
                    i = springs.nodes[2 * s]
                elif k == count:
                    i = springs.nodes[2 * s - 1]
                if i >= 0:
                    w_i, u, x = nodes.inverse_mass[i], nodes.displacement[i], nodes.lattice[i]
                one[k], of_x[k], of_y[k], of_z[k] = w_i, u.x, u.y, u.z
                at_x[k], at_y[k], at_z[k] = x.x, x.y, x.z
                ti.simt.block.sync()
                w_j, n, length, compliance, before = 0.0, ti.math.vec3(0.0), 1.0, 0.0, 0.0
                if k < count:
                    w_j = one[k + 1]
                    at_start = nodes.quantum * ti.cast(x - ti.math.ivec3(at_x[k + 1], at_y[k + 1], at_z[k + 1]), ti.f32)
                    d = at_start + (u - ti.math.vec3(of_x[k + 1], of_y[k + 1], of_z[k + 1]))
                    length = ti.max(d.norm(), TINY_LENGTH)
                    n = direction_of(at_start, d / length)
                    compliance = 1.0 / (springs.law[s][1] * dt * dt)
                    if not is_first:
                        before = work.multiplier[s]
                ti.simt.block.sync()
                of_x[k], of_y[k], of_z[k] = n.x, n.y, n.z
                if k == 0:
                    work.is_taut[p] = 0
                ti.simt.block.sync()
                lower, diagonal, upper, right = 0.0, 1.0, 0.0, ti.math.vec3(0.0)
                if k < count:
                    diagonal = w_i + w_j + compliance
                    right.x = springs.law[s][0] - springs.shift[s] - length - compliance * before
                    if k > 0:
                        lower = -w_i * n.dot(ti.math.vec3(of_x[k - 1], of_y[k - 1], of_z[k - 1]))
                    if k + 1 < count:
                        upper = -w_j * n.dot(ti.math.vec3(of_x[k + 1], of_y[k + 1], of_z[k + 1]))
                change = reduced_row(k, rows, lower, diagonal, upper, right, (one, two, three, of_x, of_y, of_z)).x
                push = change * n
                of_x[k], of_y[k], of_z[k] = push.x, push.y, push.z
                ti.simt.block.sync()
                if i >= 0:
                    moved = ti.math.vec3(0.0)
                    if k < count:
                        moved = push
                    if k > 0:
                        moved -= ti.math.vec3(of_x[k - 1], of_y[k - 1], of_z[k - 1])
                    nodes.displacement[i] = u + w_i * moved
                if k < count:
                    work.multiplier[s] = before + change
                    work.tension[s] = tension_to_turn(-(before + change) / length, w_i + w_j)
                    if work.tension[s] > 0.0:
                        work.is_taut[p] = 1
                ti.simt.block.sync()
        else:
            for place in range((end - begin + LANES - 1) // LANES * LEAST_RUN):
                if place % LEAST_RUN == 0:
                    p = begin + place // LEAST_RUN * LANES
                    solve_forth(p, end, springs, nodes, dt, is_first, work)
                    for side_by_side in range(p, ti.min(p + LANES, end)):
                        solve_back(side_by_side, springs, nodes, is_first, work)


@large_kernel
def straighten_threads(
    springs: SpringArrays,
    bounds: Bounds,
    nodes: Nodes,
    dt: ti.f32,
    work: ThreadWork,
    rows: ti.template(),
    colours: ti.template(),
):
    """Solve (1 + w_i (t_i-1 + t_i)) e_i - w_i t_i-1 e_i-1 - w_i t_i e_i+1 = e~_i in each taut piece of some colours,
    by `rows` threads of a GPU, one for each of its nodes.

    e~ is by how much springs have changed the displacements, e by how much they shall have; t_i is the tension of the
    spring from node i on.
    """
    threads = ti.static(rows if runs_on_gpu() else 1)
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = threads * bounds
    for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
        if ti.static(runs_on_gpu()):
            ti.loop_config(block_dim=rows)
            for row in range(begin, end):
                p, k = row // rows, row % rows
                s, count = springs.segment_start[p] + k, springs.segment_start[p + 1] - springs.segment_start[p]
                one, two = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                three, of_x = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                of_y, of_z = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
                if work.is_taut[p]:
                    i, before, after, change = -1, 0.0, 0.0, ti.math.vec3(0.0)
                    if k < count:
                        i = springs.nodes[2 * s]
                        after = nodes.inverse_mass[i] * work.tension[s]
                    elif k == count:
                        i = springs.nodes[2 * s - 1]
                    if i >= 0:
                        change = corrected(i, nodes, dt)
                        if k > 0:
                            before = nodes.inverse_mass[i] * work.tension[s - 1]
                    turned = reduced_row(
                        k, rows, -before, 1.0 + before + after, -after, change, (one, two, three, of_x, of_y, of_z)
                    )
                    if i >= 0:
                        nodes.displacement[i] = nodes.displacement[i] + (turned - change)
        else:
            for p in range(begin, end):
                if work.is_taut[p]:
                    straighten_piece(p, springs, nodes, dt, work)


@kernel
def measure_excess(
    springs: SpringArrays, multiplier: Floats, nodes: Nodes, dt_squared: ti.f32, found: Integers
) -> ti.math.vec2:
    """Largest excess of springs of threads, (|d| - rest + shift + l/(k dt²)) / rest, nothing between two nodes that
    are held; and how many have not converged. Two numbers are `found`.

    Where a spring is solved, its multiplier is -k dt² times its stretch: what later solves leave besides is no stretch
    of the material.
    """
    end, whole_end = springs.count, whole_warps(springs.count)
    found[0], found[1] = 0, 0
    for s in range(whole_end):
        excess = 0.0
        if s < end:
            i, j, law = springs.nodes[2 * s], springs.nodes[2 * s + 1], springs.law[s]
            length = between(i, j, nodes, nodes.displacement).norm()
            if nodes.inverse_mass[i] + nodes.inverse_mass[j] > 0.0:
                excess = (length - law[0] + springs.shift[s] + multiplier[s] / (law[1] * dt_squared)) / law[0]
        # Bits of numbers from 0 on are in their order.
        largest = largest_in_warp(ti.bit_cast(ti.select(excess > 0.0, excess, 0.0), ti.i32))
        if largest > found[0] and (ti.static(not on_cuda()) or s % WARP == 0):  # others would wait to change nothing
            ti.atomic_max(found[0], largest)
        if excess > LARGEST_RESIDUAL:
            ti.atomic_add(found[1], 1)
    return ti.math.vec2(ti.bit_cast(found[0], ti.f32), ti.cast(found[1], ti.f32))
