"""Threads of a rectangle, solved piece by piece instead of spring by spring."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.device_springs import COLOURS_AT_ONCE, TINY_LENGTH, DeviceSprings, Laws
from sim.cloth.state import ClothState, Lattice
from sim.launch import fast_launch


class ThreadSolver:
    """Block Gauss-Seidel: pieces of a thread of some springs each, even ones first, every piece exactly.

    The multipliers of a piece follow from a tridiagonal system (Deul et al. 2018, "Direct position-based solver for
    stiff rods", here without branches), which the Thomas algorithm solves in one pass forth and one back. A thread acts
    as a chain of pieces instead of one of springs, and stretches less by the length of a piece.

    What can be done spring by spring is; the passes along the pieces read nothing but a few numbers that lie together.
    On a GPU following the nodes there would take most of the step's time, as memory answers late.
    """

    def __init__(self, springs: DeviceSprings) -> None:
        self._springs = springs
        self._piece = ti.ndarray(ti.i32, springs.count)
        self._piece.from_numpy(springs.host.segment)
        self._direction = ti.Vector.ndarray(3, ti.f32, springs.count)
        self._lower, self._diagonal, self._multiplier = (ti.ndarray(ti.f32, springs.count) for _ in range(3))
        self._spring_of_colour = ti.ndarray(ti.i32, springs.piece_of_colour.shape[0])
        self._spring_of_colour.from_numpy(springs.segment_start.to_numpy()[springs.piece_of_colour.to_numpy()])

    def displace(self, state: ClothState, dt: float) -> None:
        """Bring the displacements of a step of dt [s] to where the threads let them go."""
        springs = self._springs  # of four colours at most: two directions, even and odd pieces
        solve_threads(
            springs.nodes, springs.law, springs.segment_start, self._piece, self._spring_of_colour,
            springs.piece_of_colour, state.lattice, state.quantum, state.inverse_mass, dt, self._direction,
            self._lower, self._diagonal, self._multiplier, state.displacement,
        )  # fmt: skip


@fast_launch
@ti.kernel
def solve_threads(
    nodes: Integers, law: Laws, segment_start: Integers, piece: Integers, spring_of_colour: Integers,
    piece_of_colour: Integers, lattice: Lattice, quantum: ti.f32, inverse_mass: Floats, dt: ti.f32, direction: Vectors,
    lower: Floats, diagonal: Floats, multiplier: Floats, displacement: Vectors,
):  # fmt: skip
    """Solve (w_s + w_s+1 + 1/(k dt²)) l_s - w_s n_s-1.n_s l_s-1 - w_s+1 n_s.n_s+1 l_s+1 = -C_s in each piece.

    Spring s leads from node s to node s + 1 of the piece, n_s is its direction and l_s its multiplier.
    """
    for colour in ti.static(range(COLOURS_AT_ONCE)):
        for s in range(spring_of_colour[colour], spring_of_colour[colour + 1]):
            i, j = nodes[2 * s], nodes[2 * s + 1]
            d = quantum * ti.cast(lattice[i] - lattice[j], ti.f32) + (displacement[i] - displacement[j])
            length = ti.max(d.norm(), TINY_LENGTH)
            direction[s] = d / length
            multiplier[s] = law[s][0] - length
            lower[s] = -inverse_mass[i]
            diagonal[s] = inverse_mass[i] + inverse_mass[j] + 1.0 / (law[s][1] * dt * dt)
        for p in range(piece_of_colour[colour], piece_of_colour[colour + 1]):
            start, stop = segment_start[p], segment_start[p + 1]
            inverse_pivot = 0.0
            solved = 0.0
            n_before = ti.math.vec3(0.0)
            for s in range(start, stop):
                n_s = direction[s]
                coupling = lower[s] * n_before.dot(n_s)
                factor = coupling * inverse_pivot
                inverse_pivot = 1.0 / (diagonal[s] - coupling * factor)
                solved = (multiplier[s] - coupling * solved) * inverse_pivot
                lower[s] = factor
                multiplier[s] = solved
                n_before = n_s
            factor = 0.0
            for k in range(stop - start):
                s = stop - 1 - k
                solved = multiplier[s] - factor * solved
                multiplier[s] = solved
                factor = lower[s]
        for s in range(spring_of_colour[colour], spring_of_colour[colour + 1]):
            push = multiplier[s] * direction[s]
            change = -push  # of the node that the spring leads to, which the next one leads from
            if s + 1 < piece.shape[0] and piece[s + 1] == piece[s]:
                change += multiplier[s + 1] * direction[s + 1]
            j = nodes[2 * s + 1]
            displacement[j] += inverse_mass[j] * change
            if s == 0 or piece[s - 1] != piece[s]:
                i = nodes[2 * s]
                displacement[i] += inverse_mass[i] * push
