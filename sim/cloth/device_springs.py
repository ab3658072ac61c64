"""Springs on the device, with the stiffness that the parameters of the moment give them."""

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import Contraction, Nodes, SpringArrays
from sim.cloth.parameters import ClothParameters
from sim.cloth.springs import Springs
from sim.core.arrays import Vectors, on_device
from sim.core.bundles import func
from sim.core.launch import kernel

MOST_COLOURS_AT_ONCE = 6
"""Colours that are loops of one kernel, at most, as many as bends of rectangles have: a launch costs 20 us of the host,
and every loop its time to compile."""

TINY_LENGTH = 1.0e-12  # springs shorter than this [m] have no direction: bend springs of flat cloth are at rest there

LANES = 8
"""Springs that a thread of a CPU solves side by side: numbers of a vector unit of 256 bits. Local blocks have as many
columns."""


@ti.func
def column(block: ti.template(), at):
    """Three numbers of a column."""
    return ti.Vector([block[0, at], block[1, at], block[2, at]])


@ti.func
def set_column(block: ti.template(), at, vector):
    """Give a column three numbers."""
    for c in ti.static(range(3)):
        block[c, at] = vector[c]


class DeviceSprings:
    """Springs with as many nodes each, sorted by colour.

    Attributes:
        arity: nodes of a spring.
        count: number of springs.
        on_device: the springs for kernels.
        poisson: Poisson's ratio of the cloth that a spring of a thread belongs to [-], (count,).
        is_damped: whether any of them is.
        contracts: whether any of them feels the strain across.
        colours: bounds of the colours that are solved in one launch, of each; `at_once` each, of which the last may be
            empty.
        in_segments: whether these are threads.
        host: the springs on the host.
        cloths: numbers of the cloths that they belong to; `cloth_of` that of each, (count,).
    """

    def __init__(self, springs: Springs, cloth_of: NDArray[np.int32]) -> None:
        self.host, self.cloth_of = springs, cloth_of
        self.cloths = frozenset(np.unique(cloth_of).tolist())
        self.arity, self.count = springs.arity, len(springs)
        self.in_segments = springs.in_segments
        starts = np.flatnonzero(np.diff(springs.segment, prepend=-1)) if self.in_segments else np.arange(self.count)
        self.at_once, self.colours = colour_groups(springs.colour[starts])
        self.on_device = SpringArrays(
            count=self.count,
            nodes=on_device(springs.nodes.ravel()),
            law=ti.Vector.ndarray(3, ti.f32, self.count),
            coefficients=on_device(springs.coefficients.ravel() if self.arity == 4 else np.zeros(1)),
            shift=ti.ndarray(ti.f32, self.count),
            segment_start=on_device(np.append(starts, self.count)),
        )
        self.stiffness: NDArray[np.float64] = np.zeros(self.count)
        self.damping: NDArray[np.float64] = np.zeros(self.count)
        self.poisson: NDArray[np.float64] = np.zeros(self.count)
        self.is_damped = self.contracts = False
        if self.in_segments:
            places = 2 * springs.nodes + springs.kind[:, None]
            number = np.bincount(places.ravel(), minlength=2 * int(springs.nodes.max()) + 2)
            share = 1.0 / np.maximum(number, 1)
            strain, poisson = ti.ndarray(ti.f32, len(number)), ti.ndarray(ti.f32, self.count)
            self._contraction = Contraction(on_device(springs.kind), poisson, on_device(share), strain)

    def set_material(self, cloths: Sequence[ClothParameters]) -> None:
        """Take stiffness and damping from the cloths' parameters."""
        for number, cloth in enumerate(cloths):
            own = self.cloth_of == number
            self.stiffness[own] = self.host.stiffness(cloth)[own]
            self.damping[own] = self.host.damping(cloth)[own]
        self.is_damped = bool((self.stiffness * self.damping).any())
        if self.in_segments:
            self.poisson = np.array([cloth.poisson_ratio for cloth in cloths])[self.cloth_of]
            self._contraction.poisson.from_numpy(self.poisson.astype(np.float32))
            self.contracts = bool(self.poisson.any())
            self.on_device.shift.fill(0.0)
        law = np.stack([self.host.rest, self.stiffness, self.damping], axis=1)
        self.on_device.law.from_numpy(law.astype(np.float32))

    def contract(self, nodes: Nodes, displacement: ti.Ndarray) -> None:
        """Let springs of threads feel the strain across, as nodes are displaced: with tensions C (e_u + nu e_v).

        A spring of a thread along x takes the mean of those along y that start or end at its two nodes: then each pair
        of them has the energy C nu e_x e_y of the sheet in the corner of a cell between them.
        """
        if self.contracts:
            measure_contraction(self.on_device, self._contraction, nodes, displacement)


Bounds = ti.types.vector(MOST_COLOURS_AT_ONCE + 1, ti.i32)
"""Where the pieces of each colour of a launch begin, and where the last one ends; that as often as it takes.

For variables of their own: elements of a vector would be read between two loops, by a launch of its own on a GPU."""


def colour_groups(colours: NDArray[np.int32]) -> tuple[int, list[tuple[int, ...]]]:
    """How many colours are solved in a launch, and the bounds of those of each; as many in each as it comes.

    Args:
        colours: of springs, cells or pieces, sorted.
    """
    firsts = np.flatnonzero(np.diff(colours, prepend=-1)).tolist()
    launches = max(1, -(-len(firsts) // MOST_COLOURS_AT_ONCE))
    at_once = max(1, -(-len(firsts) // launches))
    bounds = [*firsts, *[len(colours)] * (MOST_COLOURS_AT_ONCE + 1)]
    return at_once, [
        tuple(bounds[min(first + k, first + at_once)] for k in range(MOST_COLOURS_AT_ONCE + 1))
        for first in range(0, len(firsts), at_once)
    ]


@kernel
def measure_contraction(springs: SpringArrays, contraction: Contraction, nodes: Nodes, displacement: Vectors):
    """Shifts of springs from the strains of nodes; of these, two springs at most add to one, in either order."""
    for k in range(contraction.strain.shape[0]):
        contraction.strain[k] = 0.0
    for s in range(springs.count):
        i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
        strain = between(i, j, nodes, displacement).norm() / springs.law[s][0] - 1.0
        for end in ti.static((i, j)):
            place = 2 * end + contraction.axis[s]
            ti.atomic_add(contraction.strain[place], contraction.share[place] * strain)
    for s in range(springs.count):
        other = 1 - contraction.axis[s]
        i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
        across = 0.5 * (contraction.strain[2 * i + other] + contraction.strain[2 * j + other])
        springs.shift[s] = contraction.poisson[s] * springs.law[s][0] * across


@func
def coefficient(springs: SpringArrays, s: ti.i32, arity: ti.template(), a: ti.template()) -> ti.f32:
    """c_a of spring s: (1, -1), (1, -2, 1), or its own four."""
    value = 0.0
    if ti.static(arity == 4):
        value = springs.coefficients[4 * s + a]
    else:
        value = ti.static([1.0, -2.0, 1.0] if arity == 3 else [1.0, -1.0])[a]
    return value


@func
def between(i: ti.i32, j: ti.i32, nodes: Nodes, displacement: Vectors) -> ti.math.vec3:
    """x_i - x_j displaced [m]."""
    return nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[j], ti.f32) + (displacement[i] - displacement[j])


@func
def span(springs: SpringArrays, nodes: Nodes, displacement: Vectors, s: ti.i32, arity: ti.template()) -> ti.math.vec3:
    """sum_a c_a x_a displaced [m]."""
    d = separation(springs, nodes, s, arity)
    for a in ti.static(range(arity)):
        d += coefficient(springs, s, arity, a) * displacement[springs.nodes[arity * s + a]]
    return d


@func
def separation(springs: SpringArrays, nodes: Nodes, s: ti.i32, arity: ti.template()) -> ti.math.vec3:
    """sum_a c_a x_a on the lattice [m]; from differences, exact in integers, as sum_a c_a = 0."""
    d = ti.math.vec3(0.0)
    first = nodes.lattice[springs.nodes[arity * s]]
    for a in ti.static(range(1, arity)):
        d += coefficient(springs, s, arity, a) * ti.cast(nodes.lattice[springs.nodes[arity * s + a]] - first, ti.f32)
    return nodes.quantum * d
