"""Threads of a cloth, solved piece by piece instead of spring by spring."""

import numpy as np
import taichi as ti

from sim.cloth.bundles import NodeMotion, Nodes, Pieces, SpringArrays, ThreadWork
from sim.cloth.device_springs import TINY_LENGTH, DeviceSprings, colour_bounds
from sim.cloth.spring_convergence import measure_excess
from sim.cloth.state import ClothState
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, runs_on_gpu

TURNED_EXPLICITLY = 0.15
"""Tension, as dt² T (w_i + w_j) / |d| of a spring, up to which its direction may be fixed. With fixed directions, waves
across threads need dt² 4 T w / |d| <= 4, summed over the two threads of a node."""

LEAST_BLOCK = 32
"""Threads of a block of a GPU, at least: those that it runs as one."""

STRAIGHTENED = 0.35
"""Part of what is more that turns with the springs: waves are stable from 1/4 on, and neither damped nor driven."""

LEAST_ALIKE = 0.995
"""Cosine of the angle that a spring may turn by in a step for its direction to be that of the start."""


class ThreadSolver:
    """Block Gauss-Seidel: pieces of a thread of some springs each, colour by colour, every piece exactly.

    The multipliers of a piece follow from a tridiagonal system (Deul et al. 2018, "Direct position-based solver for
    stiff rods", here without branches), which the Thomas algorithm solves in one pass forth and one back. A thread acts
    as a chain of pieces instead of one of springs, and stretches less by the length of a piece.

    Directions are those of the start, as in SHAKE (Ryckaert, Ciccotti & Berendsen 1977): then a swinging sheet keeps
    its energy, of which directions of the prediction take a part in every step. Springs that turn far in a step, as
    where cloth buckles, push along the prediction, as nothing else leads to their length.

    With fixed directions tension pulls nodes back across the thread as an explicit force does: beyond
    dt < |d| (m / 2 T |d|)^(1/2), the time in which a wave passes a spring, that overshoots, and a cloth that hangs from
    its corner would jitter there. `straighten` therefore lets a part of what is more turn with its springs, as in
    Newmark's implicit scheme.

    On a GPU a block of its threads solves a piece by parallel cyclic reduction (Hockney 1965; Zhang, Cohen & Owens
    2010, "Fast tridiagonal solvers on the GPU"), a row each. Elsewhere what can be done spring by spring is, and the
    passes along the pieces read nothing but a few numbers that lie together. Kernels here and in `xpbd` write
    x = x + y: what stands at an index from memory Taichi would add to by an atomic operation for +=.
    """

    def __init__(self, springs: DeviceSprings) -> None:
        self.springs = springs
        starts = springs.segment_start.to_numpy()
        direction, solved = (ti.Vector.ndarray(3, ti.f32, springs.count) for _ in range(2))
        self._work = ThreadWork(direction, *(ti.ndarray(ti.f32, springs.count) for _ in range(5)), solved)
        self._pieces = Pieces(
            springs.segment_start,
            springs.piece_of_colour,
            ti.ndarray(ti.i32, springs.count),
            ti.ndarray(ti.i32, springs.piece_of_colour.shape[0]),
            ti.ndarray(ti.i32, len(starts) - 1),
        )
        self._pieces.piece.from_numpy(np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts)))
        self._pieces.spring_of_colour.from_numpy(starts[springs.piece_of_colour.to_numpy()])
        self._excess = LaneReduction(maxima=1, sums=1)
        self._rows = LEAST_BLOCK
        while self._rows < np.diff(starts).max(initial=0) + 1:
            self._rows *= 2

    def displace(self, state: ClothState, dt: float, *, is_first: bool) -> None:
        """Bring the displacements of a step of dt [s] to where the threads let them go; multipliers start at 0."""
        springs = self.springs
        springs.contract(state.nodes, state.displacement)
        for colour in springs.first_colours:
            arguments = (springs.on_device, self._pieces, colour, state.nodes, dt, int(is_first), self._work)
            if runs_on_gpu():
                solve_threads_in_blocks(*arguments, self._rows)
            else:
                solve_threads(*arguments)

    def straighten(self, state: ClothState, dt: float) -> None:
        """Let tension turn with its springs, where it is too strong for fixed directions.

        The force of a spring changes across it by T/|d| times the displacement across it. Newmark's scheme takes it at
        x + beta (u - u*) for displacements u and those of the prediction u*: (M + beta dt² K) (u - u*) = M (u~ - u*)
        with u~ of the fixed directions, where K is the Laplacian of the thread with weights T/|d|.
        """
        springs = self.springs
        for colour in springs.first_colours:
            arguments = (springs.on_device, self._pieces, colour, state.nodes, state.motion, dt, self._work)
            if runs_on_gpu():
                straighten_threads_in_blocks(*arguments, self._rows)
            else:
                straighten_threads(*arguments)

    def excess(self, state: ClothState, dt: float) -> tuple[float, int]:
        """Largest excess of a spring [rest lengths], and how many have not converged (`spring_convergence`)."""
        springs = self.springs
        share = self._excess.over(springs.count)
        found = measure_excess(springs.on_device, springs.count, self._work.multiplier, state.nodes, dt * dt, share)
        return float(found[0]), int(found[1])


@ti.func
def direction_of(at_start, predicted):
    """Along which a spring pushes: that of the start, or the predicted one if it turns far."""
    length = ti.max(at_start.norm(), TINY_LENGTH)
    return ti.select(at_start.dot(predicted) > LEAST_ALIKE * length, at_start / length, predicted)


@ti.func
def tension_to_turn(stress, weight):
    """What shall turn with a spring of a tension over its length; nothing if its nodes, of this `weight`, are held."""
    excess = 0.0
    if stress * weight > TURNED_EXPLICITLY:
        excess = STRAIGHTENED * (stress - TURNED_EXPLICITLY / weight)
    return excess


@kernel
def solve_threads(
    springs: SpringArrays, pieces: Pieces, first: ti.i32, nodes: Nodes, dt: ti.f32, is_first: ti.i32, work: ThreadWork
):
    """Some colours, from `first` on; each piece exactly:

        (w_s + w_s+1 + a) D_s - w_s n_s-1.n_s D_s-1 - w_s+1 n_s.n_s+1 D_s+1 = -C_s - a l_s,   a = 1/(k dt²)

    Spring s leads from node s to node s + 1 of the piece, n_s is its direction, l_s its multiplier and D_s the change
    of that. `tension` becomes what turns of -l_s / |d|, `is_taut` whether a piece has too much of it.
    """
    # Bounds before the first loop: each that is read between two loops would be a launch of its own on a GPU.
    s0, s1, s2, s3, s4 = colour_bounds(pieces.spring_of_colour, first)
    p0, p1, p2, p3, p4 = colour_bounds(pieces.piece_of_colour, first)
    for first_spring, end_spring, first_piece, end_piece in ti.static(
        ((s0, s1, p0, p1), (s1, s2, p1, p2), (s2, s3, p2, p3), (s3, s4, p3, p4))
    ):
        for s in range(first_spring, end_spring):
            i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
            d = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[j], ti.f32) + (
                nodes.displacement[i] - nodes.displacement[j]
            )
            length = ti.max(d.norm(), TINY_LENGTH)
            compliance = 1.0 / (springs.law[s][1] * dt * dt)
            if is_first:
                work.multiplier[s] = 0.0
            work.tension[s] = 1.0 / length
            at_start = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[j], ti.f32)
            work.direction[s] = direction_of(at_start, d / length)
            work.change[s] = springs.law[s][0] - springs.shift[s] - length - compliance * work.multiplier[s]
            work.lower[s] = -nodes.inverse_mass[i]
            work.diagonal[s] = nodes.inverse_mass[i] + nodes.inverse_mass[j] + compliance
        for p in range(first_piece, end_piece):
            start, stop = pieces.segment_start[p], pieces.segment_start[p + 1]
            inverse_pivot = 0.0
            solved = 0.0
            n_before = ti.math.vec3(0.0)
            for s in range(start, stop):
                n_s = work.direction[s]
                coupling = work.lower[s] * n_before.dot(n_s)
                factor = coupling * inverse_pivot
                inverse_pivot = 1.0 / (work.diagonal[s] - coupling * factor)
                solved = (work.change[s] - coupling * solved) * inverse_pivot
                work.lower[s] = factor
                work.change[s] = solved
                n_before = n_s
            factor = 0.0
            for m in range(stop - start):
                s = stop - 1 - m
                solved = work.change[s] - factor * solved
                work.change[s] = solved
                factor = work.lower[s]
            pieces.is_taut[p] = 0
        for s in range(first_spring, end_spring):
            i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
            push = work.change[s] * work.direction[s]
            moved = -push  # of the node that the spring leads to, which the next one leads from
            if s + 1 < pieces.piece.shape[0] and pieces.piece[s + 1] == pieces.piece[s]:
                moved += work.change[s + 1] * work.direction[s + 1]
            nodes.displacement[j] = nodes.displacement[j] + nodes.inverse_mass[j] * moved
            if s == 0 or pieces.piece[s - 1] != pieces.piece[s]:
                nodes.displacement[i] = nodes.displacement[i] + nodes.inverse_mass[i] * push
            work.multiplier[s] = work.multiplier[s] + work.change[s]
            weight = nodes.inverse_mass[i] + nodes.inverse_mass[j]
            work.tension[s] = tension_to_turn(-work.multiplier[s] * work.tension[s], weight)
            if work.tension[s] > 0.0:
                pieces.is_taut[pieces.piece[s]] = 1


@func
def corrected(i: ti.i32, nodes: Nodes, motion: NodeMotion, dt: ti.f32) -> ti.math.vec3:
    """By how much springs have changed the displacement of a node so far; by nothing if it is pinned."""
    change = ti.math.vec3(0.0)
    if nodes.inverse_mass[i] > 0.0:
        change = nodes.displacement[i] - (motion.carry[i] + dt * motion.velocity[i])
    return change


@kernel
def straighten_threads(
    springs: SpringArrays, pieces: Pieces, first: ti.i32, nodes: Nodes, motion: NodeMotion, dt: ti.f32, work: ThreadWork
):
    """Solve (1 + w_i (t_i-1 + t_i)) e_i - w_i t_i-1 e_i-1 - w_i t_i e_i+1 = e~_i in each taut piece of some colours.

    e~ is by how much springs have changed the displacements, e by how much they shall have; t_i is the tension of the
    spring from node i on. What is stored for a spring is of the node that it leads to.
    """
    # Bounds before the first loop: each that is read between two loops would be a launch of its own on a GPU.
    s0, s1, s2, s3, s4 = colour_bounds(pieces.spring_of_colour, first)
    p0, p1, p2, p3, p4 = colour_bounds(pieces.piece_of_colour, first)
    for first_spring, end_spring, first_piece, end_piece in ti.static(
        ((s0, s1, p0, p1), (s1, s2, p1, p2), (s2, s3, p2, p3), (s3, s4, p3, p4))
    ):
        for s in range(first_spring, end_spring):
            if pieces.is_taut[pieces.piece[s]]:
                j = springs.nodes[2 * s + 1]
                work.diagonal[s] = nodes.inverse_mass[j]
                work.solved[s] = corrected(j, nodes, motion, dt)
        for p in range(first_piece, end_piece):
            if pieces.is_taut[p]:
                start, stop = pieces.segment_start[p], pieces.segment_start[p + 1]
                head = springs.nodes[2 * start]
                change = corrected(head, nodes, motion, dt)
                t_after = work.tension[start]
                pull = nodes.inverse_mass[head] * t_after
                e_head = change / (1.0 + pull)
                share_of_head = pull / (1.0 + pull)
                e_i = e_head
                share = share_of_head  # of the next node in this one
                for s in range(start, stop):
                    pull = work.diagonal[s] * t_after
                    t_after = 0.0
                    if s + 1 < stop:
                        t_after = work.tension[s + 1]
                    onward = work.diagonal[s] * t_after
                    pivot = 1.0 / (1.0 + onward + pull * (1.0 - share))
                    e_i = pivot * (work.solved[s] + pull * e_i)
                    share = pivot * onward
                    work.lower[s] = share
                    work.solved[s] = e_i
                for m in range(1, stop - start):
                    s = stop - 1 - m
                    e_i = work.solved[s] + work.lower[s] * e_i
                    work.solved[s] = e_i
                nodes.displacement[head] = nodes.displacement[head] + (e_head + share_of_head * e_i - change)
        for s in range(first_spring, end_spring):
            if pieces.is_taut[pieces.piece[s]]:
                j = springs.nodes[2 * s + 1]
                change_j = work.solved[s] - corrected(j, nodes, motion, dt)
                nodes.displacement[j] = nodes.displacement[j] + change_j


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


@kernel
def solve_threads_in_blocks(
    springs: SpringArrays,
    pieces: Pieces,
    first: ti.i32,
    nodes: Nodes,
    dt: ti.f32,
    is_first: ti.i32,
    work: ThreadWork,
    rows: ti.template(),
):
    """What `solve_threads` does, with `rows` threads of a GPU for each piece."""
    p0, p1, p2, p3, p4 = colour_bounds(pieces.piece_of_colour, first)
    for first_piece, end_piece in ti.static(((p0, p1), (p1, p2), (p2, p3), (p3, p4))):
        ti.loop_config(block_dim=rows)
        for row in range(first_piece * rows, end_piece * rows):
            p, k = row // rows, row % rows
            s, count = pieces.segment_start[p] + k, pieces.segment_start[p + 1] - pieces.segment_start[p]
            one, two = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            three, of_x = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            of_y, of_z = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            i, j, w_i, w_j, n, length, compliance, before = 0, 0, 0.0, 0.0, ti.math.vec3(0.0), 1.0, 0.0, 0.0
            if k < count:
                i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
                w_i, w_j = nodes.inverse_mass[i], nodes.inverse_mass[j]
                at_start = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[j], ti.f32)
                d = at_start + (nodes.displacement[i] - nodes.displacement[j])
                length = ti.max(d.norm(), TINY_LENGTH)
                n = direction_of(at_start, d / length)
                compliance = 1.0 / (springs.law[s][1] * dt * dt)
                if not is_first:
                    before = work.multiplier[s]
            of_x[k], of_y[k], of_z[k] = n.x, n.y, n.z
            if k == 0:
                pieces.is_taut[p] = 0
            ti.simt.block.sync()
            lower, diagonal, upper, missing = 0.0, 1.0, 0.0, 0.0
            if k < count:
                diagonal = w_i + w_j + compliance
                missing = springs.law[s][0] - springs.shift[s] - length - compliance * before
                if k > 0:
                    lower = -w_i * n.dot(ti.math.vec3(of_x[k - 1], of_y[k - 1], of_z[k - 1]))
                if k + 1 < count:
                    upper = -w_j * n.dot(ti.math.vec3(of_x[k + 1], of_y[k + 1], of_z[k + 1]))
            change = reduced_row(
                k, rows, lower, diagonal, upper, ti.math.vec3(missing, 0.0, 0.0), (one, two, three, of_x, of_y, of_z)
            ).x
            push = change * n
            of_x[k], of_y[k], of_z[k] = push.x, push.y, push.z
            ti.simt.block.sync()
            if k < count:
                moved = -push  # of the node that the spring leads to, which the next one leads from
                if k + 1 < count:
                    moved += ti.math.vec3(of_x[k + 1], of_y[k + 1], of_z[k + 1])
                nodes.displacement[j] = nodes.displacement[j] + w_j * moved
                if k == 0:
                    nodes.displacement[i] = nodes.displacement[i] + w_i * push
                work.multiplier[s] = before + change
                work.tension[s] = tension_to_turn(-(before + change) / length, w_i + w_j)
                if work.tension[s] > 0.0:
                    pieces.is_taut[p] = 1
            ti.simt.block.sync()


@kernel
def straighten_threads_in_blocks(
    springs: SpringArrays,
    pieces: Pieces,
    first: ti.i32,
    nodes: Nodes,
    motion: NodeMotion,
    dt: ti.f32,
    work: ThreadWork,
    rows: ti.template(),
):
    """What `straighten_threads` does, with `rows` threads of a GPU for each piece: one for each of its nodes."""
    p0, p1, p2, p3, p4 = colour_bounds(pieces.piece_of_colour, first)
    for first_piece, end_piece in ti.static(((p0, p1), (p1, p2), (p2, p3), (p3, p4))):
        ti.loop_config(block_dim=rows)
        for row in range(first_piece * rows, end_piece * rows):
            p, k = row // rows, row % rows
            s, count = pieces.segment_start[p] + k, pieces.segment_start[p + 1] - pieces.segment_start[p]
            one, two = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            three, of_x = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            of_y, of_z = ti.simt.block.SharedArray((rows,), ti.f32), ti.simt.block.SharedArray((rows,), ti.f32)
            if pieces.is_taut[p]:
                i, before, after, change = -1, 0.0, 0.0, ti.math.vec3(0.0)
                if k < count:
                    i = springs.nodes[2 * s]
                    after = nodes.inverse_mass[i] * work.tension[s]
                elif k == count:
                    i = springs.nodes[2 * s - 1]
                if i >= 0:
                    change = corrected(i, nodes, motion, dt)
                    if k > 0:
                        before = nodes.inverse_mass[i] * work.tension[s - 1]
                turned = reduced_row(
                    k, rows, -before, 1.0 + before + after, -after, change, (one, two, three, of_x, of_y, of_z)
                )
                if i >= 0:
                    nodes.displacement[i] = nodes.displacement[i] + (turned - change)
