"""Rectangles of nodes on a CPU: eight neighbouring lines side by side, so that its vector units compute them at once.

Lists of springs keep a core busy with addresses: 45 ns a spring, for some 40 operations. In a rectangle neighbours are
known, and what eight lines along one direction do is the same. So a cloth is copied into blocks of eight nodes, once a
substep: in upright blocks the lanes are neighbouring columns and lines run along y; in turned ones the lanes are rows
and lines run along x. Lines of a block are solved by one task, from their first node to their last.

Two things decide whether the compiler makes vector instructions of this (LLVM 15 in Taichi 1.7.4), each a factor of 4:
a loop over lanes reads and writes local blocks alone, which whole blocks are read into and written from; and nothing is
added to with `+=` in memory, which Taichi makes an atomic operation.
"""

import functools

import taichi as ti

from sim.cloth.bundles import Lines, Nodes
from sim.core.bundles import func
from sim.core.launch import kernel, large_kernel
from sim.core.scheduling import LEAST_RUN

LANES = 8
"""Numbers of a block: what a vector unit of 256 bits holds. Twice as many are not faster, and take thrice as long to
compile."""

LEAST_BLOCKS = 4096
"""Workspaces have this many blocks, up to 176 x 176 nodes, or a power of 4 times as many: kernels are compiled for each
size, until Taichi's cache on disk knows them."""

SKEW = 5
"""Blocks more than a power of two, so that equal places of two fields do not share a line of the cache."""

Block = ti.types.vector(LANES, ti.f32)
VectorBlock = ti.types.matrix(3, LANES, ti.f32)
LatticeBlock = ti.types.matrix(3, LANES, ti.i32)
Blocks = ti.types.ndarray(dtype=Block, ndim=1)


@ti.data_oriented
class RowBlocks:
    """What kernels work in within a substep; all rectangles of a process, one after the other, use the same.

    Node (i, j) is lane i % LANES of the upright block j * strips + i // LANES, and lane j % LANES of the turned block
    `turned` + i * turned_strips + j // LANES, with as many strips as LANES lines need. Nodes beyond the border fill up
    the blocks; they have no inverse mass.

    Attributes:
        lattice, u, inverse_mass: of nodes, as in `ClothState`; u is their displacement [m].
        predicted: displacements before any spring acted, upright [m].
        n, inverse_length, change, factor, tension: of the spring that leads on from the node.
        cell_multiplier: of the shear of the cell above the node, upright.
        is_taut: whether the lines of strip s have tension to straighten, at s, and from `turned` on for turned ones.
        turned: first turned block.
    """

    def __init__(self, blocks: int) -> None:
        self.turned = blocks
        count = 2 * blocks + SKEW
        self.lattice = ti.Matrix.field(3, LANES, ti.i32, shape=count)
        self.u, self.predicted, self.n = (ti.Matrix.field(3, LANES, ti.f32, shape=count) for _ in range(3))
        self.inverse_mass, self.inverse_length, self.change, self.factor, self.tension, self.cell_multiplier = (
            ti.Vector.field(LANES, ti.f32, shape=count) for _ in range(6)
        )
        self.is_taut = ti.field(ti.i32, shape=count)


def row_blocks(columns: int, rows: int) -> RowBlocks:
    """A workspace for a rectangle of so many nodes; nothing in it outlives a substep of one cloth."""
    blocks = LEAST_BLOCKS
    while blocks < LANES * strips_of(columns) * strips_of(rows):
        blocks *= 4
    return _workspace(blocks)


@functools.cache
def _workspace(blocks: int) -> RowBlocks:
    """Kept for good: Taichi is started once a process (`sim.core.runtime`), and its fields live as long."""
    return RowBlocks(blocks)


def strips_of(lines: int) -> int:
    """Blocks that so many lines side by side need."""
    return -(-lines // LANES)


@ti.func
def lane(block: ti.template(), at):
    """Three numbers of a lane."""
    return ti.Vector([block[0, at], block[1, at], block[2, at]])


@ti.func
def set_lane(block: ti.template(), at, vector):
    """Give a lane three numbers."""
    for c in ti.static(range(3)):
        block[c, at] = vector[c]


@ti.func
def add_to_lane(block: ti.template(), at, vector):
    """Add to the three numbers of a lane."""
    for c in ti.static(range(3)):
        block[c, at] += vector[c]


@func
def turn(values: ti.template(), strip: ti.i32, along: Lines):
    """Copy vectors of the nodes of a strip of turned lines from upright blocks; nothing where lines are upright."""
    if along.first > 0:
        for b in range(along.other_strips):
            for own in range(LANES):
                block = VectorBlock(0.0)
                for row in range(LANES):
                    for c in ti.static(range(3)):
                        block[c, row] = values[(strip * LANES + row) * along.other_strips + b][c, own]
                values[along.first + (b * LANES + own) * along.strips + strip] = block


@func
def turn_back(values: ti.template(), strip: ti.i32, along: Lines):
    """Copy vectors of the nodes of a strip of turned lines to upright blocks; nothing where lines are upright."""
    if along.first > 0:
        for b in range(along.other_strips):
            for row in range(LANES):
                block = VectorBlock(0.0)
                for own in range(LANES):
                    for c in ti.static(range(3)):
                        block[c, own] = values[along.first + (b * LANES + own) * along.strips + strip][c, row]
                values[(strip * LANES + row) * along.other_strips + b] = block


@large_kernel
def load_blocks(blocks: ti.template(), nodes: Nodes, along: Lines):
    """Fill the blocks of lines along one direction with the nodes of a cloth, and none beyond its border.

    Turned ones get their displacements by `turn`.
    """
    for place in range(along.strips * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        strip = place // LEAST_RUN
        for k in range(along.other_strips * LANES):
            u, lattice, weight = VectorBlock(0.0), LatticeBlock(0), Block(0.0)
            if k < along.length:
                for at in range(ti.min(LANES, along.count - strip * LANES)):
                    i = along.first_node + (strip * LANES + at) * along.line_step + k * along.node_step
                    if along.first == 0:
                        set_lane(u, at, nodes.displacement[i])
                    set_lane(lattice, at, nodes.lattice[i])
                    weight[at] = nodes.inverse_mass[i]
            q = along.first + k * along.strips + strip
            blocks.lattice[q], blocks.inverse_mass[q] = lattice, weight
            if along.first == 0:
                blocks.u[q], blocks.predicted[q] = u, u


@kernel
def store_blocks(blocks: ti.template(), nodes: Nodes, along: Lines):
    """Write the displacements of the upright blocks to the nodes of the cloth."""
    for block in range(along.length * along.strips):
        k, strip = block // along.strips, block % along.strips
        u = blocks.u[block]
        for at in range(ti.min(LANES, along.count - strip * LANES)):
            i = along.first_node + (strip * LANES + at) * along.line_step + k * along.node_step
            nodes.displacement[i] = lane(u, at)
