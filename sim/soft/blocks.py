"""A sparse grid: blocks of nodes near particles, and the particles sorted by the cells of these blocks.

Nodes lie on a lattice of edge h; block and node numbers run along x first. A particle's base is the lowest of the 27
nodes that a quadratic spline gives it a share in, floor(x/h - 1/2), and its cell is that of its base. Blocks that hold
no node of any particle are neither stored nor computed; of the others there is a number for every 64 nodes of the
domain. Blocks are numbered, and particles of a cell sorted, in an order that no thread decides.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Integers, Vectors
from sim.core.bundles import bundle, func
from sim.core.cells import SortArrays, settle_in_cells
from sim.core.domain import DomainParameters
from sim.core.launch import kernel
from sim.core.scan import scan_in_parallel, scan_scratch_length

EDGE = 4  # nodes along the edge of a block
NODES = EDGE**3
SUPPORT = 3  # nodes along an axis that a particle has a share in
RING = 3  # nodes around the domain: what particles at its faces reach, and one
GROWTH = 1.1
MARGIN = 0.5  # how far from where blocks were found last particles still have them [edges]
SLACK = 0.01  # of that, for the rounding of places [edges]
MOST_BLOCKS = 2**28

AROUND = tuple(itertools.product((-1.0, 1.0), repeat=3))

Triple = ti.types.vector(3, ti.i32)


@bundle
class Blocks(NamedTuple):
    """The blocks, and the particles sorted by cell; of `k` blocks that there is room for."""

    origin: ti.math.vec3  # of the lattice [m]
    edge: ti.f32  # h [m]
    shape: Triple  # blocks along each axis
    mark: Integers  # of each block of the lattice: whether it holds bases, then its number, (blocks,)
    number: Integers  # of each block of the lattice, -1 where it is not stored, (blocks + 1,)
    place: Integers  # of each stored block in the lattice, (k,)
    ahead: Integers  # numbers of a block and the seven that follow it along the axes, x first, -1 for none, (8 k,)
    behind: Integers  # of a block and the seven before it
    sort: SortArrays  # of particles by the cells of stored blocks; those that have left come last
    room: ti.i32  # k


class BlockGrid:
    """The sparse grid of some particles in a domain.

    Attributes:
        blocks: for kernels; another one when it had to grow.
        count: blocks that are stored.

    Args:
        particles: how many.
    """

    def __init__(self, domain: DomainParameters, edge: float, particles: int) -> None:
        low, high = np.array(domain.min), np.array(domain.max)
        nodes = np.ceil((high - low) / edge - 1.0e-6) + 2.0 + 2.0 * RING  # one more for the margin
        shape = np.ceil(nodes / EDGE) + 1.0
        if shape.prod() > MOST_BLOCKS:
            raise ValueError(
                f"a domain of {' x '.join(f'{length:g}' for length in high - low)} m has {shape.prod():.3g} blocks of "
                f"{EDGE * edge:g} m, more than {MOST_BLOCKS}; give a smaller domain or a larger cell_size"
            )
        total = math.prod(shape.astype(int).tolist())
        self._n, self.count, self._way = particles, 0, math.inf
        self._rounding = float(np.spacing(np.float32(max(np.abs(low).max(), np.abs(high).max()))))
        self._lattice = {
            "origin": tuple((low - RING * edge).tolist()),
            "edge": edge,
            "shape": tuple(shape.astype(int).tolist()),
            "mark": ti.ndarray(ti.i32, total),
            "number": ti.ndarray(ti.i32, total + 1),
        }
        self._total = total
        self._cell, self._order = (ti.ndarray(ti.i32, max(particles, 1)) for _ in range(2))
        self._make_room(64)

    def sort(self, position: ti.Ndarray, body: ti.Ndarray) -> bool:
        """Sort the particles by cell; returns whether there is room for more blocks than before.

        Particles of body -1 are left out.
        """
        grown = not self._way <= MARGIN - SLACK and self._find(position, body)
        sort_by_cell(self.blocks, self.count, position, body, self._n)
        return grown

    def moved(self, way: float) -> None:
        """Take note that particles went so far at most [m]; infinite where they are others now."""
        self._way += (way + self._rounding) / self._lattice["edge"]

    def _find(self, position: ti.Ndarray, body: ti.Ndarray) -> bool:
        """Find the blocks that hold nodes of particles until these have gone as far as the margin."""
        grown, self._way = False, 0.0
        self.count = find_blocks(self.blocks, position, body, self._n)
        while self.count > self.blocks.room:
            self._make_room(int(GROWTH * self.count))
            grown = True
            self.count = find_blocks(self.blocks, position, body, self._n)
        find_neighbors(self.blocks, self.count)
        return grown

    def _make_room(self, room: int) -> None:
        cells = room * NODES + 1  # one for particles that have left
        self.blocks = Blocks(
            **self._lattice,
            place=ti.ndarray(ti.i32, room),
            ahead=ti.ndarray(ti.i32, 8 * room),
            behind=ti.ndarray(ti.i32, 8 * room),
            sort=SortArrays(
                cell_of=self._cell,
                cursor=ti.ndarray(ti.i32, cells),
                scratch=ti.ndarray(ti.i32, scan_scratch_length(max(cells, self._total))),
                cell_start=ti.ndarray(ti.i32, cells + 1),
                order=self._order,
            ),
            room=room,
        )


def sorted_by_cell(points: NDArray[np.float32], domain: DomainParameters, edge: float) -> NDArray[np.float32]:
    """Points (n, 3) [m] block by block and cell by cell: rows of neighbours lie together, for as long as they stay."""
    base = np.floor((points - np.array(domain.min)) / edge + RING - 0.5).astype(int)
    keys = (*base.T, *(base // EDGE).T)
    return points[np.lexsort(keys)]


@func
def base_of(x: ti.math.vec3, blocks: Blocks) -> Triple:
    """Lowest node of a particle at x [m]."""
    return ti.cast(ti.floor(place_of(x, blocks) - 0.5), ti.i32)


@func
def place_of(x: ti.math.vec3, blocks: Blocks) -> ti.math.vec3:
    """Where a point [m] is in the lattice [edges]."""
    return (x - blocks.origin) / blocks.edge


@func
def block_of(node: Triple, blocks: Blocks) -> ti.i32:
    """Place in the lattice of a node's block."""
    return ((node[2] >> 2) * blocks.shape[1] + (node[1] >> 2)) * blocks.shape[0] + (node[0] >> 2)


@ti.func
def within_block(node: Triple) -> ti.i32:
    """Number of a node in its block."""
    return ((node[2] & 3) * EDGE + (node[1] & 3)) * EDGE + (node[0] & 3)


@func
def node_at(node: Triple, blocks: Blocks) -> ti.i32:
    """Number of a stored node."""
    return blocks.number[block_of(node, blocks)] * NODES + within_block(node)


@func
def node_ahead(block: ti.i32, node: Triple, blocks: Blocks) -> ti.i32:
    """Number of a node of coordinates from 0 to 6 in a stored block, or in one of those that follow it."""
    next_block = (int(node[2] > 3) * 2 + int(node[1] > 3)) * 2 + int(node[0] > 3)
    return blocks.ahead[8 * block + next_block] * NODES + within_block(node)


@func
def cell_behind(block: ti.i32, node: Triple, blocks: Blocks) -> ti.i32:
    """Number of a cell of coordinates from -2 to 3 in a stored block, or in one of those before it; negative where
    it is not stored."""
    last_block = (int(node[2] < 0) * 2 + int(node[1] < 0)) * 2 + int(node[0] < 0)
    return blocks.behind[8 * block + last_block] * NODES + within_block(node)


@func
def node_of(number: ti.i32, blocks: Blocks) -> Triple:
    """The node of a number."""
    place = blocks.place[number // NODES]
    inside = number % NODES
    x = place % blocks.shape[0]
    y = place // blocks.shape[0] % blocks.shape[1]
    z = place // (blocks.shape[0] * blocks.shape[1])
    return Triple(EDGE * x + inside % EDGE, EDGE * y + inside // EDGE % EDGE, EDGE * z + inside // (EDGE * EDGE))


@func
def place_of_node(number: ti.i32, blocks: Blocks) -> ti.math.vec3:
    """Where a stored node is [m]."""
    return blocks.origin + blocks.edge * ti.cast(node_of(number, blocks), ti.f32)


@kernel
def find_blocks(blocks: Blocks, position: Vectors, body: Integers, count: ti.i32) -> ti.i32:
    """Number the blocks that hold nodes of particles; returns how many there are, which may be more than have room."""
    total = blocks.mark.shape[0]
    for m in range(total):
        blocks.mark[m] = 0
    for p in range(count):
        if body[p] >= 0:
            for dx, dy, dz in ti.static(AROUND):
                reached = position[p] + blocks.edge * MARGIN * ti.math.vec3(dx, dy, dz)
                blocks.mark[block_of(base_of(reached, blocks), blocks)] = 1
    for m in range(total):
        x, y, z = m % blocks.shape[0], m // blocks.shape[0] % blocks.shape[1], m // (blocks.shape[0] * blocks.shape[1])
        reached = 0
        for d in ti.static(range(8)):
            dx, dy, dz = ti.static(d % 2, d // 2 % 2, d // 4)
            if x >= dx and y >= dy and z >= dz:
                reached |= blocks.mark[m - (dz * blocks.shape[1] + dy) * blocks.shape[0] - dx]
        blocks.number[m] = reached
    for m in range(total):
        blocks.mark[m] = blocks.number[m]
    found = scan_in_parallel(blocks.mark, total, blocks.sort.scratch, blocks.number)
    for m in range(total):
        if blocks.mark[m] == 0:
            blocks.number[m] = -1
        elif blocks.number[m] < blocks.room:
            blocks.place[blocks.number[m]] = m
    return found


@kernel
def find_neighbors(blocks: Blocks, stored: ti.i32):
    """The blocks beside each stored one."""
    for k in range(8 * stored):
        place = blocks.place[k // 8]
        step = ((k // 4 % 2) * blocks.shape[1] + k // 2 % 2) * blocks.shape[0] + k % 2
        blocks.ahead[k] = blocks.number[place + step]
        behind = -1
        if place >= step:
            behind = blocks.number[place - step]
        blocks.behind[k] = behind


@kernel
def sort_by_cell(blocks: Blocks, stored: ti.i32, position: Vectors, body: Integers, count: ti.i32):
    """Sort particles by counting, those of a cell by number; those that have left come last."""
    cells = stored * NODES
    for c in range(cells + 1):
        blocks.sort.cursor[c] = 0
    for p in range(count):
        cell = cells
        if body[p] >= 0:
            cell = node_at(base_of(position[p], blocks), blocks)
        blocks.sort.cell_of[p] = cell
        ti.atomic_add(blocks.sort.cursor[cell], 1)
    settle_in_cells(count, cells, blocks.sort.cell_of, False, blocks.sort)
