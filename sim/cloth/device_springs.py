"""Springs and cells on the device, with the stiffness that the parameters of the moment give them."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import CellArrays, Contraction, MeshNodes, Nodes, SpringArrays, Strains
from sim.cloth.parameters import ClothParameters
from sim.cloth.sheet import pieces_of
from sim.cloth.springs import OWN_SHARE, RECTANGLE, TRIANGLE, Cells, Springs
from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import func
from sim.core.launch import kernel, large_kernel
from sim.core.reductions import Results, Share, reduced_tree, runs_on_gpu

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


SHEAR_SWEEPS = 3
"""Sweeps over the cells of rectangles before threads are first solved in a step: with `over_relaxed` ones shear has its
stiffness within a few per cent where a cell is up to twice as stiff as the inertia of its nodes, and within 40 % up to
nine times."""


class DeviceCells:
    """Cells with as many nodes each, sorted by colour.

    Attributes:
        host: the cells on the host.
        arity: nodes of a cell.
        count: number of cells.
        law: as `Cells.law` has it, (count, 4).
        is_damped: whether any of them is.
        cloths: numbers of the cloths that they belong to.
        colours, bounds: number of colours, and bounds of all of them.
    """

    def __init__(self, cells: Cells, cloth_of: NDArray[np.int32]) -> None:
        self.host, self._cloth_of = cells, cloth_of
        self.cloths = frozenset(np.unique(cloth_of).tolist())
        self.arity, self.count = cells.arity, len(cells)
        self.law: NDArray[np.float64] = np.zeros((self.count, 4))
        self.is_damped = False
        self.colours, (self.bounds,) = colour_groups(cells.colour)
        law = ti.Vector.ndarray(4, ti.f32, self.count)
        is_mesh = cells.arity == TRIANGLE
        multiplier = ti.ndarray(ti.f32, 1 if is_mesh else self.count)
        followed = ti.Vector.ndarray(2, ti.f32, FOLLOWED_STRAINS * self.count if is_mesh else self.count)
        listed = (on_device(each.ravel()) for each in (cells.nodes, cells.along, cells.across))
        self.on_device = CellArrays(self.count, *listed, law, multiplier, followed, _mesh_nodes(cells))

    def set_material(self, cloths: Sequence[ClothParameters]) -> None:
        """Take stiffness and damping from the cloths' parameters."""
        for number, cloth in enumerate(cloths):
            own = self._cloth_of == number
            self.law[own] = self.host.law(cloth)[own]
        self.is_damped = bool((self.law[:, :2] * self.law[:, 3:]).any())
        self.on_device.law.from_numpy(self.law.astype(np.float32))
        if self.arity == TRIANGLE:
            nodes, weight = self.host.nodes.ravel(), np.repeat(self.law[:, 0], TRIANGLE)
            share = weight / np.bincount(nodes, weights=weight)[nodes]
            self.on_device.mesh.share.from_numpy(share.astype(np.float32))

    def measure_strains(self, nodes: Nodes, *, is_damped: bool) -> None:
        """Mean strains of the nodes of triangles, as they are, with what damping adds to them if it shall."""
        if self.arity == TRIANGLE:
            measure_strains(self.on_device, nodes, int(is_damped))


def _mesh_nodes(cells: Cells) -> MeshNodes:
    """The nodes of triangles, connected piece by piece."""
    triangles = cells.nodes if cells.arity == TRIANGLE else np.zeros((0, TRIANGLE), dtype=np.int32)
    count = int(triangles.max(initial=-1)) + 1
    label = pieces_of(triangles)
    used = np.unique(triangles)
    own = used[np.argsort(label[used], kind="stable")]
    piece = np.unique(label[own], return_inverse=True)[1]
    place = np.zeros(count, dtype=np.int64)
    place[own] = np.arange(len(own))
    place = place[triangles.ravel()]
    ends, size = np.append(0, np.cumsum(np.bincount(piece))), max(1, round(len(own) ** 0.5))
    chunks = [np.arange(first, end, size) for first, end in pairwise(ends)]
    first = np.concatenate([*chunks, [len(own)]])
    return MeshNodes(
        count=len(own),
        chunks=len(first) - 1,
        pieces=len(chunks),
        node=on_device(own),
        start=on_device(np.append(0, np.cumsum(np.bincount(place)))),
        corner=on_device(np.argsort(place, kind="stable")),
        share=ti.ndarray(ti.f32, max(triangles.size, 1)),
        swapped=on_device(cells.swapped.ravel().astype(np.int32)),
        strain=ti.Vector.ndarray(2, ti.f32, max(len(triangles), 1)),
        mean=ti.Vector.ndarray(2, ti.f32, max(count, 1)),
        piece=on_device(piece),
        chunk=on_device(first),
        first_chunk=on_device(np.append(0, np.cumsum([len(chunk) for chunk in chunks])).astype(np.int32)),
    )


@func
def derivative(
    coefficients: Floats, cells: CellArrays, nodes: Nodes, displacement: Vectors, s: ti.i32, arity: ti.template()
) -> ti.math.vec3:
    """sum_a c_a x_a displaced; from differences, exact in integers, as sum_a c_a = 0."""
    d, moved = ti.math.vec3(0.0), ti.math.vec3(0.0)
    first = nodes.lattice[cells.nodes[arity * s]]
    for a in ti.static(range(arity)):
        i, c_a = cells.nodes[arity * s + a], coefficients[arity * s + a]
        if ti.static(a > 0):
            d += c_a * ti.cast(nodes.lattice[i] - first, ti.f32)
        moved += c_a * displacement[i]
    return nodes.quantum * d + moved


@func
def change_of(
    coefficients: Floats, cells: CellArrays, vectors: Vectors, s: ti.i32, arity: ti.template()
) -> ti.math.vec3:
    """sum_a c_a of vectors at the nodes of a cell."""
    total = ti.math.vec3(0.0)
    for a in ti.static(range(arity)):
        total += coefficients[arity * s + a] * vectors[cells.nodes[arity * s + a]]
    return total


@func
def weights(cells: CellArrays, nodes: Nodes, s: ti.i32) -> ti.math.vec3:
    """sum_a w_a c_a c'_a: of d_u with itself, of d_v with itself, of both [1/(kg m²)]."""
    total = ti.math.vec3(0.0)
    for a in ti.static(range(RECTANGLE)):
        w_a = nodes.inverse_mass[cells.nodes[RECTANGLE * s + a]]
        u, v = cells.along[RECTANGLE * s + a], cells.across[RECTANGLE * s + a]
        total += w_a * ti.math.vec3(u * u, v * v, u * v)
    return total


@ti.func
def shear_of(d_u: ti.math.vec3, d_v: ti.math.vec3):
    """e_s, and its derivatives by d_u and d_v."""
    more, less = d_u + d_v, d_u - d_v
    length, length_less = ti.max(more.norm(), TINY_LENGTH), ti.max(less.norm(), TINY_LENGTH)
    n, m = more / length, less / length_less
    half = ti.sqrt(0.5)
    return half * (length - length_less), half * (n - m), half * (n + m)


FOLLOWED = 0.6
"""Part of a change of a rectangle's shear that its smoothed rate takes over in a step."""

FOLLOWED_STRAINS = 3  # of a triangle: e_u, e_v and shear


@ti.func
def smoothed(rate, change, followed):
    """Smoothed rate of a cell's strain [1/s], which takes over the part `followed` of a change.

    Cells pull by the strain at the end of a step less what its smoothed rate makes of it meanwhile. Implicit Euler
    alone brakes waves as a damping of as much time as a step has; with 0.6 those of forty steps per period keep 0.9997
    of their amplitude in a step instead of 0.988, and those that steps cannot follow still fall, to 0.77 in the limit.
    """
    return rate + followed * (change - rate)


@ti.func
def time_ahead(dt, rate_before):
    """Time for which a smoothed rate counts [s]: a longer step than the last, of 1/`rate_before`, would overdo it."""
    return 1.0 / ti.max(1.0 / dt, rate_before)


RESOLVED = 1.5  # stiffness of a cell, as of `over_relaxed`, at which half of that rate counts


@ti.func
def resolved(stiffness):
    """Part of the smoothed rate that counts: all where the usual steps resolve the waves of single cells, which sweeps
    solve, and nothing where they leave much unsolved, as that would be kept, too.
    """
    squared = stiffness * stiffness / (RESOLVED * RESOLVED)
    squared *= squared
    return 1.0 / (1.0 + squared * squared)


@ti.func
def over_relaxed(stiffness):
    """Factor of the change of a cell's multiplier, whose neighbours will undo a part of it (Young 1954).

    Sweeps begin with multipliers of 0, so that smooth shear converges last: it needs more the stiffer cells are, by
    k dt² over the inertia of their nodes.
    """
    return 1.0 + 0.85 * stiffness / (2.0 + stiffness)


@ti.func
def weight_along(by_u: ti.math.vec3, by_v: ti.math.vec3, w: ti.math.vec3):
    """How easily nodes with the `weights` w change a strain with these derivatives [1/(kg m²)]."""
    return w[0] * by_u.dot(by_u) + w[1] * by_v.dot(by_v) + 2.0 * w[2] * by_u.dot(by_v)


@func
def push_nodes(s: ti.i32, cells: CellArrays, nodes: Nodes, p_u: ti.math.vec3, p_v: ti.math.vec3, changed: Vectors):
    """Give the nodes of a cell what pushes along d_u and d_v change of displacements or velocities."""
    for a in ti.static(range(RECTANGLE)):
        i = cells.nodes[RECTANGLE * s + a]
        push = cells.along[RECTANGLE * s + a] * p_u + cells.across[RECTANGLE * s + a] * p_v
        changed[i] = changed[i] + nodes.inverse_mass[i] * push


@func
def solve_shear(
    first: ti.i32,
    end: ti.i32,
    cells: CellArrays,
    nodes: Nodes,
    steps: ti.math.vec3,
    is_first: ti.i32,
    lanes: ti.template(),
):
    """The shear of so many cells of a colour side by side, or of those that are left, by Macklin, Müller & Chentanez
    2016, eq. 18, multiplied through by k dt². See `threads.solve_forth` for lanes.
    """
    dt, rate_before, coarsening = steps[0], steps[1], steps[2]
    ahead = time_ahead(dt, rate_before)
    d_u, d_v, w = ti.Matrix.zero(ti.f32, 3, lanes), ti.Matrix.zero(ti.f32, 3, lanes), ti.Matrix.zero(ti.f32, 3, lanes)
    strength, before = ti.Vector.zero(ti.f32, lanes), ti.Vector.zero(ti.f32, lanes)
    start_u, start_v = ti.Matrix.zero(ti.f32, 3, lanes), ti.Matrix.zero(ti.f32, 3, lanes)
    start, rate = ti.Vector.zero(ti.f32, lanes), ti.Vector.zero(ti.f32, lanes)
    for at in range(lanes):
        s = first + at
        if s < end:
            set_column(d_u, at, derivative(cells.along, cells, nodes, nodes.displacement, s, RECTANGLE))
            set_column(d_v, at, derivative(cells.across, cells, nodes, nodes.displacement, s, RECTANGLE))
            set_column(w, at, weights(cells, nodes, s))
            start[at], rate[at] = cells.followed[s][0], cells.followed[s][1]
            if is_first:
                set_column(start_u, at, derivative(cells.along, cells, nodes, nodes.carry, s, RECTANGLE))
                set_column(start_v, at, derivative(cells.across, cells, nodes, nodes.carry, s, RECTANGLE))
            strength[at], before[at] = cells.law[s][1] * dt * dt, ti.select(is_first, 0.0, cells.multiplier[s])
    for at in range(lanes):
        shear, by_u, by_v = shear_of(column(d_u, at), column(d_v, at))
        weight = weight_along(by_u, by_v, column(w, at))
        stiffness = strength[at] * weight
        start_shear, _, _ = shear_of(column(start_u, at), column(start_v, at))
        rate[at] = ti.select(is_first, smoothed(rate[at], rate_before * (start_shear - start[at]), FOLLOWED), rate[at])
        start[at] = ti.select(is_first, start_shear, start[at])
        missing = strength[at] * (shear - resolved(coarsening * stiffness) * ahead * rate[at]) + before[at]
        change = -over_relaxed(stiffness) * missing / (stiffness + 1.0)
        before[at] += change
        set_column(d_u, at, change * by_u)
        set_column(d_v, at, change * by_v)
    for at in range(lanes):
        if first + at < end:
            cells.multiplier[first + at] = before[at]
            cells.followed[first + at] = ti.math.vec2(start[at], rate[at])
            push_nodes(first + at, cells, nodes, column(d_u, at), column(d_v, at), nodes.displacement)


@large_kernel
def solve_shears(
    cells: CellArrays, bounds: Bounds, nodes: Nodes, steps: ti.math.vec3, is_first: ti.i32, colours: ti.template()
):
    """The cells of all colours, one after the other; if `is_first`, `SHEAR_SWEEPS` times, from multipliers of 0.

    `steps` are the length of the step [s], 1 over that of the last one [1/s], and the square of the usual one's in it.
    """
    lanes = ti.static(1 if runs_on_gpu() else LANES)
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = bounds
    for sweep in ti.static(range(SHEAR_SWEEPS)):
        for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
            for s in range(begin, end):
                if (s - begin) % lanes == 0 and (ti.static(sweep == 0) or is_first == 1):
                    start = is_first if ti.static(sweep == 0) else 0
                    solve_shear(s, end, cells, nodes, steps, start, lanes)


@kernel
def damp_shears(cells: CellArrays, bounds: Bounds, nodes: Nodes, dt: ti.f32, colours: ti.template()):
    """Implicit Euler of the forces -tau k de/dt of the shear of so many colours, one after the other."""
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = bounds
    for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
        for s in range(begin, end):
            d_u = derivative(cells.along, cells, nodes, nodes.carry, s, RECTANGLE)
            d_v = derivative(cells.across, cells, nodes, nodes.carry, s, RECTANGLE)
            rate_u = change_of(cells.along, cells, nodes.velocity, s, RECTANGLE)
            rate_v = change_of(cells.across, cells, nodes.velocity, s, RECTANGLE)
            _, by_u, by_v = shear_of(d_u, d_v)
            strength = cells.law[s][1] * cells.law[s][3] * dt
            change = -strength * (by_u.dot(rate_u) + by_v.dot(rate_v))
            change /= strength * weight_along(by_u, by_v, weights(cells, nodes, s)) + 1.0
            push_nodes(s, cells, nodes, change * by_u, change * by_v, nodes.velocity)


@func
def mean_strain(k: ti.i32, mesh: MeshNodes, strain: Strains) -> ti.math.vec2:
    """e_u and e_v of a node: the mean of its triangles, by area."""
    total = ti.math.vec2(0.0)
    for at in range(mesh.start[k], mesh.start[k + 1]):
        corner = mesh.corner[at]
        own = strain[corner // TRIANGLE]
        total += mesh.share[corner] * ti.select(mesh.swapped[corner], own.yx, own)
    return total


@func
def tension_of(s: ti.i32, cells: CellArrays, strain: Strains, mean: Strains) -> ti.math.vec2:
    """Tensions of a triangle along warp and weft [J], from its own strain and the mean ones of its nodes."""
    (mesh,) = ti.static((cells.mesh,))
    felt = OWN_SHARE * strain[s]
    for a in ti.static(range(TRIANGLE)):
        of_node = mean[cells.nodes[TRIANGLE * s + a]]
        felt += (1.0 - OWN_SHARE) / TRIANGLE * ti.select(mesh.swapped[TRIANGLE * s + a], of_node.yx, of_node)
    return cells.law[s][0] * (felt + cells.law[s][2] * felt.yx)


@func
def strain_by(displacement: Vectors, is_damped: ti.i32, cells: CellArrays, nodes: Nodes):
    """Strains of triangles where displacements lead, with tau times their rates if `is_damped`; then of nodes. For the
    outermost level of a kernel.
    """
    (mesh,) = ti.static((cells.mesh,))
    for s in range(cells.count):
        d_u = derivative(cells.along, cells, nodes, displacement, s, TRIANGLE)
        d_v = derivative(cells.across, cells, nodes, displacement, s, TRIANGLE)
        length, length_across = ti.max(d_u.norm(), TINY_LENGTH), ti.max(d_v.norm(), TINY_LENGTH)
        mesh.strain[s] = ti.math.vec2(length - 1.0, length_across - 1.0)
        if is_damped:
            rate_u = d_u.dot(change_of(cells.along, cells, nodes.velocity, s, TRIANGLE)) / length
            rate_v = d_v.dot(change_of(cells.across, cells, nodes.velocity, s, TRIANGLE)) / length_across
            mesh.strain[s] = mesh.strain[s] + cells.law[s][3] * ti.math.vec2(rate_u, rate_v)
    for k in range(mesh.count):
        mesh.mean[mesh.node[k]] = mean_strain(k, mesh, mesh.strain)


@kernel
def measure_strains(cells: CellArrays, nodes: Nodes, is_damped: ti.i32):
    """Strains of triangles and nodes as they are."""
    strain_by(nodes.carry, is_damped, cells, nodes)


@kernel
def compute_cell_forces(cells: CellArrays, nodes: Nodes, first: ti.i32, arity: ti.template(), force: Vectors):
    """-dW/dd_u and -dW/dd_v of each cell with damping [N m], one after the other from `first` on, after
    `measure_strains`.
    """
    for s in range(cells.count):
        d_u = derivative(cells.along, cells, nodes, nodes.carry, s, arity)
        d_v = derivative(cells.across, cells, nodes, nodes.carry, s, arity)
        rate_u = change_of(cells.along, cells, nodes.velocity, s, arity)
        rate_v = change_of(cells.across, cells, nodes.velocity, s, arity)
        law = cells.law[s]
        shear, by_u, by_v = shear_of(d_u, d_v)
        moment = -law[1] * (shear + law[3] * (by_u.dot(rate_u) + by_v.dot(rate_v)))
        f_u, f_v = moment * by_u, moment * by_v
        if ti.static(arity == TRIANGLE):
            tension = tension_of(s, cells, cells.mesh.strain, cells.mesh.mean)
            f_u -= tension[0] / ti.max(d_u.norm(), TINY_LENGTH) * d_u
            f_v -= tension[1] / ti.max(d_v.norm(), TINY_LENGTH) * d_v
        force[first + 2 * s] = f_u
        force[first + 2 * s + 1] = f_v


@kernel
def sum_over_cells(cells: CellArrays, nodes: Nodes, arity: ti.template(), share: Share) -> Results:
    """Largest mean strain of nodes of triangles along warp and weft; elastic energy; after `measure_strains`."""
    mesh, tree = ti.static((cells.mesh, share.tree))
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(tree.lanes):
        largest = 0.0
        energy = 0.0
        for k in range(share.items):
            s = lane * share.lane_step + k * share.item_step
            if s < cells.count:
                d_u = derivative(cells.along, cells, nodes, nodes.carry, s, arity)
                d_v = derivative(cells.across, cells, nodes, nodes.carry, s, arity)
                law = cells.law[s]
                shear, _, _ = shear_of(d_u, d_v)
                energy += 0.5 * law[1] * shear * shear
                if ti.static(arity == TRIANGLE):
                    e = mesh.strain[s]
                    energy += 0.5 * OWN_SHARE * law[0] * (e.dot(e) + 2.0 * law[2] * e.x * e.y)
                    for a in ti.static(range(TRIANGLE)):
                        e = mesh.mean[cells.nodes[TRIANGLE * s + a]]
                        largest = ti.max(largest, e.x, e.y)
                        share_of_node = 0.5 * (1.0 - OWN_SHARE) / TRIANGLE
                        energy += share_of_node * law[0] * (e.dot(e) + 2.0 * law[2] * e.x * e.y)
        tree.partial[lane] = largest
        tree.partial[tree.lanes + lane] = energy
    return reduced_tree(tree)
