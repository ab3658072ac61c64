"""Threads of a cloth, solved piece by piece instead of spring by spring."""

import numpy as np
import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.device_springs import TINY_LENGTH, DeviceSprings, Laws, colour_bounds
from sim.cloth.overlong import count_overlong
from sim.cloth.state import ClothState, Lattice
from sim.launch import fast_launch

TURNED_EXPLICITLY = 0.15
"""Tension, as dt² T (w_i + w_j) / |d| of a spring, up to which its direction may be that of the prediction. With fixed
directions, waves across threads need dt² 4 T w / |d| <= 4/3, summed over the two threads of a node."""


class ThreadSolver:
    """Block Gauss-Seidel: pieces of a thread of some springs each, colour by colour, every piece exactly.

    The multipliers of a piece follow from a tridiagonal system (Deul et al. 2018, "Direct position-based solver for
    stiff rods", here without branches), which the Thomas algorithm solves in one pass forth and one back. A thread acts
    as a chain of pieces instead of one of springs, and stretches less by the length of a piece.

    Directions are those of the prediction, so that tension pulls nodes back across the thread as an explicit force
    does: beyond dt < |d| (m / 3 T |d|)^(1/2), about the time in which a wave passes a spring, that overshoots, and a
    cloth that hangs from its corner would jitter there. `straighten` therefore lets tension turn with its springs.

    What can be done spring by spring is; the passes along the pieces read nothing but a few numbers that lie together.
    On a GPU following the nodes there would take most of the step's time, as memory answers late. Kernels here and in
    `xpbd` write x = x + y: what stands at an index from memory Taichi would add to by an atomic operation for +=.
    """

    def __init__(self, springs: DeviceSprings) -> None:
        self._springs = springs
        starts = springs.segment_start.to_numpy()
        self._piece = ti.ndarray(ti.i32, springs.count)
        self._piece.from_numpy(np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts)))
        self._is_taut = ti.ndarray(ti.i32, len(starts) - 1)
        self._direction, self._solved = (ti.Vector.ndarray(3, ti.f32, springs.count) for _ in range(2))
        self._lower, self._diagonal, self._change, self._multiplier, self._tension = (
            ti.ndarray(ti.f32, springs.count) for _ in range(5)
        )
        self._spring_of_colour = ti.ndarray(ti.i32, springs.piece_of_colour.shape[0])
        self._spring_of_colour.from_numpy(starts[springs.piece_of_colour.to_numpy()])

    def displace(self, state: ClothState, dt: float, *, is_first: bool) -> None:
        """Bring the displacements of a step of dt [s] to where the threads let them go; multipliers start at 0."""
        springs = self._springs
        for colour in springs.first_colours:
            solve_threads(
                springs.nodes, springs.law, springs.segment_start, self._piece, self._spring_of_colour,
                springs.piece_of_colour, colour, state.lattice, state.quantum, state.inverse_mass, dt, int(is_first),
                self._direction, self._lower, self._diagonal, self._change, self._multiplier, self._tension,
                self._is_taut, state.displacement,
            )  # fmt: skip

    def straighten(self, state: ClothState, dt: float) -> None:
        """Let tension turn with its springs, where it is too strong for directions of the prediction.

        The force of a spring changes across it by T/|d| times the displacement across it. With that, implicit Euler is
        (M + dt² K) (u - u*) = M (u~ - u*) for displacements u~ of the fixed directions and u* of the prediction, where
        K is the Laplacian of the thread with weights T/|d|. Only what exceeds `TURNED_EXPLICITLY` is in K.
        """
        springs = self._springs
        for colour in springs.first_colours:
            straighten_threads(
                springs.nodes, springs.segment_start, self._piece, self._spring_of_colour, springs.piece_of_colour,
                colour, self._is_taut, self._tension, state.inverse_mass, state.carry, state.velocity, dt, self._lower,
                self._diagonal, self._solved, state.displacement,
            )  # fmt: skip

    def count_overlong(self, state: ClothState, dt: float) -> int:
        """After `straighten`: how many springs are much longer than their tension makes them, see `overlong`."""
        springs = self._springs
        return int(
            count_overlong(
                springs.nodes, springs.law, springs.count, self._multiplier, state.lattice, state.quantum,
                state.inverse_mass, dt * dt, state.displacement,
            )
        )  # fmt: skip


@fast_launch
@ti.kernel
def solve_threads(
    nodes: Integers, law: Laws, segment_start: Integers, piece: Integers, spring_of_colour: Integers,
    piece_of_colour: Integers, first: ti.i32, lattice: Lattice, quantum: ti.f32, inverse_mass: Floats, dt: ti.f32,
    is_first: ti.i32, direction: Vectors, lower: Floats, diagonal: Floats, change: Floats, multiplier: Floats,
    tension: Floats, is_taut: Integers, displacement: Vectors,
):  # fmt: skip
    """Some colours, from `first` on; each piece exactly:

        (w_s + w_s+1 + a) D_s - w_s n_s-1.n_s D_s-1 - w_s+1 n_s.n_s+1 D_s+1 = -C_s - a l_s,   a = 1/(k dt²)

    Spring s leads from node s to node s + 1 of the piece, n_s is its direction, l_s its multiplier and D_s the change
    of that. `tension` becomes what is too much of -l_s / |d|, `is_taut` whether a piece has any.
    """
    # Bounds before the first loop: each that is read between two loops would be a launch of its own on a GPU.
    s0, s1, s2, s3, s4 = colour_bounds(spring_of_colour, first)
    p0, p1, p2, p3, p4 = colour_bounds(piece_of_colour, first)
    for first_spring, end_spring, first_piece, end_piece in ti.static(
        ((s0, s1, p0, p1), (s1, s2, p1, p2), (s2, s3, p2, p3), (s3, s4, p3, p4))
    ):
        for s in range(first_spring, end_spring):
            i, j = nodes[2 * s], nodes[2 * s + 1]
            d = quantum * ti.cast(lattice[i] - lattice[j], ti.f32) + (displacement[i] - displacement[j])
            length = ti.max(d.norm(), TINY_LENGTH)
            compliance = 1.0 / (law[s][1] * dt * dt)
            if is_first:
                multiplier[s] = 0.0
            tension[s] = 1.0 / length
            direction[s] = tension[s] * d
            change[s] = law[s][0] - length - compliance * multiplier[s]
            lower[s] = -inverse_mass[i]
            diagonal[s] = inverse_mass[i] + inverse_mass[j] + compliance
        for p in range(first_piece, end_piece):
            start, stop = segment_start[p], segment_start[p + 1]
            inverse_pivot = 0.0
            solved = 0.0
            n_before = ti.math.vec3(0.0)
            for s in range(start, stop):
                n_s = direction[s]
                coupling = lower[s] * n_before.dot(n_s)
                factor = coupling * inverse_pivot
                inverse_pivot = 1.0 / (diagonal[s] - coupling * factor)
                solved = (change[s] - coupling * solved) * inverse_pivot
                lower[s] = factor
                change[s] = solved
                n_before = n_s
            factor = 0.0
            for m in range(stop - start):
                s = stop - 1 - m
                solved = change[s] - factor * solved
                change[s] = solved
                factor = lower[s]
            is_taut[p] = 0
        for s in range(first_spring, end_spring):
            i, j = nodes[2 * s], nodes[2 * s + 1]
            push = change[s] * direction[s]
            moved = -push  # of the node that the spring leads to, which the next one leads from
            if s + 1 < piece.shape[0] and piece[s + 1] == piece[s]:
                moved += change[s + 1] * direction[s + 1]
            displacement[j] = displacement[j] + inverse_mass[j] * moved
            if s == 0 or piece[s - 1] != piece[s]:
                displacement[i] = displacement[i] + inverse_mass[i] * push
            multiplier[s] = multiplier[s] + change[s]
            stress = -multiplier[s] * tension[s]
            weight = inverse_mass[i] + inverse_mass[j]
            excess = 0.0
            if stress * weight > TURNED_EXPLICITLY:
                excess = stress - TURNED_EXPLICITLY / weight
                is_taut[piece[s]] = 1
            tension[s] = excess


@ti.func
def corrected(
    i: ti.i32, inverse_mass: Floats, carry: Vectors, velocity: Vectors, dt: ti.f32, displacement: Vectors
) -> ti.math.vec3:
    """By how much springs have changed the displacement of a node so far; by nothing if it is pinned."""
    change = ti.math.vec3(0.0)
    if inverse_mass[i] > 0.0:
        change = displacement[i] - (carry[i] + dt * velocity[i])
    return change


@fast_launch
@ti.kernel
def straighten_threads(
    nodes: Integers, segment_start: Integers, piece: Integers, spring_of_colour: Integers, piece_of_colour: Integers,
    first: ti.i32, is_taut: Integers, tension: Floats, inverse_mass: Floats, carry: Vectors, velocity: Vectors,
    dt: ti.f32, factor: Floats, weight: Floats, solved: Vectors, displacement: Vectors,
):  # fmt: skip
    """Solve (1 + w_i (t_i-1 + t_i)) e_i - w_i t_i-1 e_i-1 - w_i t_i e_i+1 = e~_i in each taut piece of some colours.

    e~ is by how much springs have changed the displacements, e by how much they shall have; t_i is the tension of the
    spring from node i on. What is stored for a spring is of the node that it leads to.
    """
    # Bounds before the first loop: each that is read between two loops would be a launch of its own on a GPU.
    s0, s1, s2, s3, s4 = colour_bounds(spring_of_colour, first)
    p0, p1, p2, p3, p4 = colour_bounds(piece_of_colour, first)
    for first_spring, end_spring, first_piece, end_piece in ti.static(
        ((s0, s1, p0, p1), (s1, s2, p1, p2), (s2, s3, p2, p3), (s3, s4, p3, p4))
    ):
        for s in range(first_spring, end_spring):
            if is_taut[piece[s]]:
                j = nodes[2 * s + 1]
                weight[s] = inverse_mass[j]
                solved[s] = corrected(j, inverse_mass, carry, velocity, dt, displacement)
        for p in range(first_piece, end_piece):
            if is_taut[p]:
                start, stop = segment_start[p], segment_start[p + 1]
                head = nodes[2 * start]
                change = corrected(head, inverse_mass, carry, velocity, dt, displacement)
                t_after = tension[start]
                pull = inverse_mass[head] * t_after
                e_head = change / (1.0 + pull)
                share_of_head = pull / (1.0 + pull)
                e_i = e_head
                share = share_of_head  # of the next node in this one
                for s in range(start, stop):
                    pull = weight[s] * t_after
                    t_after = 0.0
                    if s + 1 < stop:
                        t_after = tension[s + 1]
                    onward = weight[s] * t_after
                    pivot = 1.0 / (1.0 + onward + pull * (1.0 - share))
                    e_i = pivot * (solved[s] + pull * e_i)
                    share = pivot * onward
                    factor[s] = share
                    solved[s] = e_i
                for m in range(1, stop - start):
                    s = stop - 1 - m
                    e_i = solved[s] + factor[s] * e_i
                    solved[s] = e_i
                displacement[head] = displacement[head] + (e_head + share_of_head * e_i - change)
        for s in range(first_spring, end_spring):
            if is_taut[piece[s]]:
                j = nodes[2 * s + 1]
                change_j = solved[s] - corrected(j, inverse_mass, carry, velocity, dt, displacement)
                displacement[j] = displacement[j] + change_j
