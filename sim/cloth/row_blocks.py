"""Rectangles of nodes on a CPU: eight neighbouring lines side by side, so that its vector units compute them at once.

Lists of springs keep a core busy with addresses: 45 ns a spring, for some 40 operations. In a rectangle neighbours are
known, and what eight lines along one direction do is the same. So a cloth is copied into blocks of eight numbers, once
a substep: in upright blocks the lanes are neighbouring columns and lines run along y; in turned ones the lanes are rows
and lines run along x. Lines of a block are solved by one task, from their first node to their last.

Two things decide whether the compiler makes vector instructions of this (LLVM 15 in Taichi 1.7.4), each a factor of 4:
a loop over lanes reads and writes local vectors alone, which whole blocks are read into and written from; and nothing
is added to with `+=` in memory, which Taichi makes an atomic operation.
"""

import functools

import taichi as ti

from sim.cloth.bundles import Nodes, Rectangle
from sim.cloth.sheet import Grid
from sim.core.launch import kernel

LANES = 8
"""Numbers of a block: what a vector unit of 256 bits holds. Twice as many are not faster, and take thrice as long to
compile."""

LEAST_BLOCKS = 4096
"""Workspaces have this many blocks, up to 176 x 176 nodes, or a power of 4 times as many: kernels are compiled for each
size, for some 20 s of a core until Taichi's cache on disk knows them."""

SKEW = 5
"""Blocks more than a power of two, so that equal places of two fields do not share a line of the cache."""

Block = ti.types.vector(LANES, ti.f32)
IntegerBlock = ti.types.vector(LANES, ti.i32)
Blocks = ti.types.ndarray(dtype=Block, ndim=1)


@ti.data_oriented
class RowBlocks:
    """What kernels work in within a substep; all rectangles of a process, one after the other, use the same.

    Node (i, j) is lane i % LANES of the upright block j * strips + i // LANES, and lane j % LANES of the turned block
    `turned` + i * turned_strips + j // LANES, with as many strips as LANES lines need. Nodes beyond the border fill up
    the blocks; they have no inverse mass.

    Attributes:
        lattice_x, lattice_y, lattice_z: as in `ClothState`.
        u_x, u_y, u_z: displacements [m].
        predicted_x, predicted_y, predicted_z: displacements before any spring acted, upright [m].
        inverse_mass: [1/kg].
        n_x, n_y, n_z, inverse_length, change, factor, tension: of the spring that leads on from the node.
        cell_multiplier: of the shear of the cell above the node, upright.
        is_taut: whether piece p of the lines of strip s has tension to straighten, at `s * pieces + p`, and from
            `turned` on for turned ones.
        v_x, v_y, v_z, share, free_share: of the air's kernels: velocity [m/s], share in the force on any triangle, and
            that of nodes that are not held.
        lower_x, lower_y, lower_z, upper_x, upper_y, upper_z: force of the air on the two triangles of the cell [N].
        turned: first turned block.
    """

    def __init__(self, blocks: int) -> None:
        self.turned = blocks
        count = 2 * blocks + SKEW
        self.lattice_x, self.lattice_y, self.lattice_z = (ti.Vector.field(LANES, ti.i32, shape=count) for _ in range(3))
        self.u_x, self.u_y, self.u_z, self.inverse_mass = (_blocks(count) for _ in range(4))
        self.predicted_x, self.predicted_y, self.predicted_z = (_blocks(count) for _ in range(3))
        self.n_x, self.n_y, self.n_z, self.inverse_length = (_blocks(count) for _ in range(4))
        self.change, self.factor, self.tension, self.cell_multiplier = (_blocks(count) for _ in range(4))
        self.is_taut = ti.field(ti.i32, shape=count)
        # The air has done before springs start, and works in the same memory.
        self.v_x, self.v_y, self.v_z = self.predicted_x, self.predicted_y, self.predicted_z
        self.share, self.free_share = self.inverse_mass, self.inverse_length
        self.lower_x, self.lower_y, self.lower_z = self.n_x, self.n_y, self.n_z
        self.upper_x, self.upper_y, self.upper_z = self.change, self.factor, self.tension


def _blocks(count: int) -> ti.MatrixField:
    return ti.Vector.field(LANES, ti.f32, shape=count)


def row_blocks(columns: int, rows: int) -> RowBlocks:
    """A workspace for a rectangle of so many nodes; nothing in it outlives a substep of one cloth."""
    needed = LANES * strips_of(columns) * strips_of(rows)
    blocks = LEAST_BLOCKS
    while blocks < needed:
        blocks *= 4
    return _workspace(blocks)


@functools.cache
def _workspace(blocks: int) -> RowBlocks:
    """Kept for good: Taichi is started once a process (`sim.core.runtime`), and its fields live as long."""
    return RowBlocks(blocks)


def rectangle_of(grid: Grid, first_node: int) -> Rectangle:
    """A rectangle for kernels."""
    return Rectangle(first_node, grid.columns, grid.rows, strips_of(grid.columns), strips_of(grid.rows))


def strips_of(lines: int) -> int:
    """Blocks that so many lines side by side need."""
    return -(-lines // LANES)


@ti.func
def two_blocks(values: ti.template(), block, next_block):
    """Two blocks as one vector, so that lanes can be looked up one to the side."""
    one, other = values[block], values[next_block]
    pair = ti.Vector([one[0] * 0 for _ in range(2 * LANES)])
    for at in ti.static(range(LANES)):
        pair[at] = one[at]
        pair[LANES + at] = other[at]
    return pair


@ti.func
def turn_strip(values: ti.template(), turned, strip, strips, turned_strips):
    """Copy the nodes of `strip`, LANES rows, from upright blocks to turned ones, which start at `turned`."""
    for b in range(strips):
        for lane in range(LANES):
            block = values[strip]  # of the right type; all of it is overwritten
            for row in range(LANES):
                block[row] = values[(strip * LANES + row) * strips + b][lane]
            values[turned + (b * LANES + lane) * turned_strips + strip] = block


@ti.func
def turn_strip_back(values: ti.template(), turned, strip, strips, turned_strips):
    """Copy the nodes of `strip` from turned blocks to upright ones."""
    for b in range(strips):
        for row in range(LANES):
            block = values[strip]
            for lane in range(LANES):
                block[lane] = values[turned + (b * LANES + lane) * turned_strips + strip][row]
            values[(strip * LANES + row) * strips + b] = block


@ti.func
def turn_displacements(blocks: ti.template(), strip, strips, turned_strips):
    """Copy the displacements of the nodes of `strip` from upright blocks to turned ones."""
    for values in ti.static((blocks.u_x, blocks.u_y, blocks.u_z)):
        turn_strip(values, blocks.turned, strip, strips, turned_strips)


@ti.func
def turn_displacements_back(blocks: ti.template(), strip, strips, turned_strips):
    """Copy the displacements of the nodes of `strip` from turned blocks to upright ones."""
    for values in ti.static((blocks.u_x, blocks.u_y, blocks.u_z)):
        turn_strip_back(values, blocks.turned, strip, strips, turned_strips)


@kernel
def load_blocks(blocks: ti.template(), nodes: Nodes, grid: Rectangle, is_short: ti.template()):
    """Fill upright and turned blocks with a cloth whose first node is `first`."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for strip in range(grid.turned_strips):
        for r in range(LANES):
            j = strip * LANES + r
            for b in range(grid.strips):
                x, y, z, w = Block(0.0), Block(0.0), Block(0.0), Block(0.0)
                l_x, l_y, l_z = IntegerBlock(0), IntegerBlock(0), IntegerBlock(0)
                if j < grid.rows:
                    for lane in range(ti.min(LANES, grid.columns - b * LANES)):
                        i = grid.first + j * grid.columns + b * LANES + lane
                        x[lane], y[lane], z[lane] = (
                            nodes.displacement[i].x,
                            nodes.displacement[i].y,
                            nodes.displacement[i].z,
                        )
                        l_x[lane], l_y[lane], l_z[lane] = nodes.lattice[i].x, nodes.lattice[i].y, nodes.lattice[i].z
                        w[lane] = nodes.inverse_mass[i]
                q = j * grid.strips + b
                blocks.u_x[q], blocks.u_y[q], blocks.u_z[q] = x, y, z
                blocks.predicted_x[q], blocks.predicted_y[q], blocks.predicted_z[q] = x, y, z
                blocks.lattice_x[q], blocks.lattice_y[q], blocks.lattice_z[q] = l_x, l_y, l_z
                blocks.inverse_mass[q] = w
        for values in ti.static((blocks.lattice_x, blocks.lattice_y, blocks.lattice_z, blocks.inverse_mass)):
            turn_strip(values, blocks.turned, strip, grid.strips, grid.turned_strips)


@kernel
def store_blocks(blocks: ti.template(), nodes: Nodes, grid: Rectangle, is_short: ti.template()):
    """Write the displacements of the upright blocks to the nodes of the cloth."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for j in range(grid.rows):
        for b in range(grid.strips):
            q = j * grid.strips + b
            x, y, z = blocks.u_x[q], blocks.u_y[q], blocks.u_z[q]
            for lane in range(ti.min(LANES, grid.columns - b * LANES)):
                nodes.displacement[grid.first + j * grid.columns + b * LANES + lane] = ti.math.vec3(
                    x[lane], y[lane], z[lane]
                )
