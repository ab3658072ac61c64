"""Springs on the device, with the stiffness that the parameters of the moment give them."""

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import Nodes, SpringArrays
from sim.cloth.parameters import ClothParameters
from sim.cloth.springs import Springs
from sim.core.arrays import Integers
from sim.core.bundles import func

COLOURS_AT_ONCE = 4
"""Colours that are loops of one kernel: a launch costs 20 us of the host, and every loop its time to compile."""

Bounds = ti.types.vector(COLOURS_AT_ONCE + 1, ti.i32)

TINY_LENGTH = 1.0e-12
"""Springs shorter than this [m] have no direction: bend springs of flat cloth are at rest there."""


class DeviceSprings:
    """Springs with as many nodes each, sorted by colour.

    Attributes:
        arity: nodes of a spring.
        count: number of springs.
        nodes: (count * arity,) int32.
        coefficients: c_a of springs with four nodes, (count * 4,); those of the others are known.
        law: (rest length [m], stiffness [N/m], damping over stiffness [s]), (count,) vec3.
        is_damped: whether any of them is.
        first_colours: first colour of each group of `COLOURS_AT_ONCE`; the last group may have empty ones.
        piece_of_colour: first piece of each colour, and number of pieces, (colours + 1,); a piece is one spring where
            springs are solved one by one.
        in_segments: whether these are threads.
        segment_start: first spring of each piece, and number of springs, (pieces + 1,).
        host: the springs on the host.
        cloths: numbers of the cloths that they belong to.
    """

    def __init__(self, springs: Springs, cloth_of: NDArray[np.int32]) -> None:
        self.host, self._cloth_of = springs, cloth_of
        self.cloths = frozenset(np.unique(cloth_of).tolist())
        self.arity, self.count = springs.arity, len(springs)
        self.nodes = ti.ndarray(ti.i32, self.count * self.arity)
        self.nodes.from_numpy(np.ascontiguousarray(springs.nodes).ravel())
        own = springs.coefficients.ravel() if self.arity == 4 else np.zeros(1)
        self.coefficients = ti.ndarray(ti.f32, len(own))
        self.coefficients.from_numpy(own.astype(np.float32))
        self.law = ti.Vector.ndarray(3, ti.f32, self.count)
        self.in_segments = springs.in_segments
        starts = np.flatnonzero(np.diff(springs.segment, prepend=-1)) if self.in_segments else np.arange(self.count)
        self.segment_start = ti.ndarray(ti.i32, len(starts) + 1)
        self.segment_start.from_numpy(np.append(starts, self.count).astype(np.int32))
        firsts = np.flatnonzero(np.diff(springs.colour[starts], prepend=-1))
        self.first_colours = range(0, len(firsts), COLOURS_AT_ONCE)
        padding = [len(starts)] * (len(self.first_colours) * COLOURS_AT_ONCE + 1 - len(firsts))
        firsts = np.concatenate([firsts, padding])
        self.piece_of_colour = ti.ndarray(ti.i32, len(firsts))
        self.piece_of_colour.from_numpy(firsts.astype(np.int32))
        self.stiffness: NDArray[np.float64] = np.zeros(self.count)
        self.damping: NDArray[np.float64] = np.zeros(self.count)
        self.is_damped = False

    @property
    def on_device(self) -> SpringArrays:
        """The springs for kernels."""
        return SpringArrays(self.nodes, self.law, self.coefficients)

    def set_material(self, cloths: Sequence[ClothParameters]) -> None:
        """Take stiffness and damping from the cloths' parameters."""
        for number, cloth in enumerate(cloths):
            own = self._cloth_of == number
            self.stiffness[own] = self.host.stiffness(cloth)[own]
            self.damping[own] = self.host.damping(cloth)[own]
        self.is_damped = bool((self.stiffness * self.damping).any())
        law = np.stack([self.host.rest, self.stiffness, self.damping], axis=1)
        self.law.from_numpy(law.astype(np.float32))

    def stretches(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """C = |d| - rest of each spring [m], (count,), with nodes at positions [m], (n, 3)."""
        d = np.einsum("ma,mai->mi", self.host.coefficients, positions[self.host.nodes])
        stretches: NDArray[np.float64] = np.linalg.norm(d, axis=1) - self.host.rest
        return stretches

    def energy(self, positions: NDArray[np.float64]) -> float:
        """Elastic energy [J], in float64."""
        return float((0.5 * self.stiffness * self.stretches(positions) ** 2).sum())


@func
def coefficient(springs: SpringArrays, s: ti.i32, arity: ti.template(), a: ti.template()) -> ti.f32:
    """c_a of spring s: (1, -1), (1, -2, 1), or its own four."""
    value = 0.0
    if ti.static(arity == 4):
        value = springs.coefficients[4 * s + a]
    else:
        value = ti.static([1.0, -2.0, 1.0] if arity == 3 else [1.0, -1.0])[a]
    return value


@ti.func
def colour_bounds(piece_of_colour: Integers, first: ti.i32) -> Bounds:
    """Where each of `COLOURS_AT_ONCE` colours begins, from `first` on, and where the last one ends."""
    return Bounds(
        piece_of_colour[first],
        piece_of_colour[first + 1],
        piece_of_colour[first + 2],
        piece_of_colour[first + 3],
        piece_of_colour[first + 4],
    )


@func
def separation(springs: SpringArrays, nodes: Nodes, s: ti.i32, arity: ti.template()) -> ti.math.vec3:
    """sum_a c_a x_a on the lattice [m]; from differences, exact in integers, as sum_a c_a = 0."""
    d = ti.math.vec3(0.0)
    first = nodes.lattice[springs.nodes[arity * s]]
    for a in ti.static(range(1, arity)):
        d += coefficient(springs, s, arity, a) * ti.cast(nodes.lattice[springs.nodes[arity * s + a]] - first, ti.f32)
    return nodes.quantum * d
