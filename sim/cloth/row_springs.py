"""Rectangles of nodes on a CPU: eight neighbouring lines side by side, so that its vector units compute them at once.

Lists of springs keep a core busy with addresses: 45 ns a spring, for some 40 operations. In a rectangle neighbours are
known, and what eight lines along one direction do is the same. So a cloth is copied into blocks of eight nodes, once a
substep: in upright blocks the lanes are neighbouring columns and lines run along y; in turned ones the lanes are rows
and lines run along x. Lines of a block are solved by one task, from their first node to their last.

Two things decide whether the compiler makes vector instructions of this (LLVM 15 in Taichi 1.7.4), each a factor of 4:
a loop over lanes reads and writes local blocks alone, which whole blocks are read into and written from; and nothing is
added to with `+=` in memory, which Taichi makes an atomic operation.

What `xpbd`, `device_cells` and `threads` do for lists is done here for lines, threads along one direction; `quantum` is
the unit of the lattice [m], `dt_squared` in s².
"""

import functools

import taichi as ti

from sim.cloth.bundles import Lines, Nodes
from sim.cloth.device_cells import over_relaxed
from sim.cloth.device_springs import TINY_LENGTH
from sim.cloth.threads import LARGEST_RESIDUAL, direction_of, excess_of, tension_to_turn
from sim.core.arrays import Floats
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


BEND_COLOURS = 3
"""Bend springs along a line that share no node: every third one."""


@large_kernel
def bend_lines(
    blocks: ti.template(),
    along: Lines,
    stiffness: Floats,
    quantum: ti.f32,
    dt_squared: ti.f32,
    gamma: ti.f32,
):
    """The bend springs of all lines along one direction, colour by colour, as `solve_bend`.

    `stiffness` is of the springs of each line [N/m], (strips * LANES,), `gamma` their damping over stiffness and dt.
    """
    for place in range(along.strips * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        strip = place // LEAST_RUN
        turn(blocks.u, strip, along)
        strength = Block(0.0)
        for at in range(LANES):
            strength[at] = dt_squared * stiffness[strip * LANES + at]
        for colour in range(BEND_COLOURS):
            for m in range((along.length - colour) // BEND_COLOURS):
                a = along.first + (colour + BEND_COLOURS * m) * along.strips + strip
                b, c = a + along.strips, a + 2 * along.strips
                u_a, u_b, u_c = blocks.u[a], blocks.u[b], blocks.u[c]
                p_a, p_b, p_c = blocks.lattice[a], blocks.lattice[b], blocks.lattice[c]
                w_a, w_b, w_c = blocks.inverse_mass[a], blocks.inverse_mass[b], blocks.inverse_mass[c]
                for at in range(LANES):
                    moved = lane(u_a, at) - 2.0 * lane(u_b, at) + lane(u_c, at)
                    at_start = (lane(p_a, at) - lane(p_b, at)) + (lane(p_c, at) - lane(p_b, at))
                    d = quantum * ti.cast(at_start, ti.f32) + moved
                    squared = d.dot(d)
                    error = squared + gamma * d.dot(moved)
                    weight = strength[at] * (w_a[at] + 4.0 * w_b[at] + w_c[at])
                    least = ti.max(squared, TINY_LENGTH * TINY_LENGTH)  # flat cloth has no error either
                    impulse = -strength[at] * error / (least * (weight * (1.0 + gamma) + 1.0)) * d
                    add_to_lane(u_a, at, w_a[at] * impulse)
                    add_to_lane(u_b, at, -2.0 * w_b[at] * impulse)
                    add_to_lane(u_c, at, w_c[at] * impulse)
                blocks.u[a], blocks.u[b], blocks.u[c] = u_a, u_b, u_c
        turn_back(blocks.u, strip, along)


@ti.func
def with_next(values: ti.template(), at, kind: ti.template()):
    """A block of vectors and the first lane of the block after it."""
    own, after = values[at], values[at + 1]
    wide = ti.Matrix.zero(kind, 3, LANES + 1)
    for c in ti.static(range(3)):
        for k in ti.static(range(LANES)):
            wide[c, k] = own[c, k]
        wide[c, LANES] = after[c, 0]
    return wide


@ti.func
def keep_with_next(values: ti.template(), at, wide: ti.template(), keeps_next):
    """Write a block back, and the first lane of the next one if that is kept, too."""
    own = VectorBlock(0.0)
    for c in ti.static(range(3)):
        for k in ti.static(range(LANES)):
            own[c, k] = wide[c, k]
    values[at] = own
    if keeps_next:
        for c in ti.static(range(3)):
            values[at + 1][c, 0] = wide[c, LANES]


@ti.func
def weights_with_next(values: ti.template(), at):
    """A block of numbers and the first lane of the block after it."""
    own, after = values[at], values[at + 1]
    wide = ti.Vector.zero(ti.f32, LANES + 1)
    for k in ti.static(range(LANES)):
        wide[k] = own[k]
    wide[LANES] = after[0]
    return wide


@large_kernel
def solve_cells_in_rows(
    blocks: ti.template(),
    parity: ti.i32,
    along: Lines,
    steps: ti.math.vec2,
    stiffness: ti.f32,
    quantum: ti.f32,
    dt_squared: ti.f32,
    is_first: ti.i32,
):
    """The shear of all cells in every second row of cells, from row `parity` on, as `solve_shear`, for upright lines.

    In each row every second cell first, then those between, which share nodes with them: all are computed alike, eight
    at a time, and every second one acts. `steps` are the lengths of a cell [m], `stiffness` is G times its area [J].
    """
    for place in range((along.length - parity) // 2 * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        pair = place // LEAST_RUN
        lower = (2 * pair + parity) * along.strips
        strength = stiffness * dt_squared
        half = ti.sqrt(0.5)
        # d_u + d_v and d_u - d_v are these multiples of the diagonals of a cell, upwards and downwards.
        total, between = 0.5 / steps[0] + 0.5 / steps[1], 0.5 / steps[0] - 0.5 / steps[1]
        for way in range(2):
            for k in range(along.strips):
                a, b = lower + k, lower + along.strips + k
                u_a, u_b = with_next(blocks.u, a, ti.f32), with_next(blocks.u, b, ti.f32)
                p_a, p_b = with_next(blocks.lattice, a, ti.i32), with_next(blocks.lattice, b, ti.i32)
                w_a, w_b = weights_with_next(blocks.inverse_mass, a), weights_with_next(blocks.inverse_mass, b)
                multiplier = blocks.cell_multiplier[a]
                rise, fall = VectorBlock(0.0), VectorBlock(0.0)
                cells = along.count - 1 - k * LANES
                for at in range(LANES):
                    upwards = ti.cast(lane(p_b, at + 1) - lane(p_a, at), ti.f32)
                    downwards = ti.cast(lane(p_a, at + 1) - lane(p_b, at), ti.f32)
                    up = quantum * upwards + (lane(u_b, at + 1) - lane(u_a, at))
                    down = quantum * downwards + (lane(u_a, at + 1) - lane(u_b, at))
                    more, less = total * up + between * down, total * down + between * up
                    longer, shorter = ti.max(more.norm(), TINY_LENGTH), ti.max(less.norm(), TINY_LENGTH)
                    n, m = half * more / longer, half * less / shorter
                    # Derivatives of e_s by the corners: of the upper right one, and of the lower right one.
                    by_upper, by_lower = total * n - between * m, between * n - total * m
                    weight = (w_a[at] + w_b[at + 1]) * by_upper.dot(by_upper)
                    weight += (w_a[at + 1] + w_b[at]) * by_lower.dot(by_lower)
                    before = ti.select(is_first, 0.0, multiplier[at])
                    error = strength * half * (longer - shorter) + before
                    stiff = strength * weight
                    acts = at < cells and at % 2 == way
                    change = ti.select(acts, -over_relaxed(stiff) * error / (stiff + 1.0), 0.0)
                    multiplier[at] = ti.select(acts, before + change, multiplier[at])
                    set_lane(rise, at, change * by_upper)
                    set_lane(fall, at, change * by_lower)
                for at in range(LANES):
                    add_to_lane(u_a, at, -w_a[at] * lane(rise, at))
                    add_to_lane(u_b, at, -w_b[at] * lane(fall, at))
                for at in range(LANES):
                    add_to_lane(u_a, at + 1, w_a[at + 1] * lane(fall, at))
                    add_to_lane(u_b, at + 1, w_b[at + 1] * lane(rise, at))
                blocks.cell_multiplier[a] = multiplier
                is_inner = k + 1 < along.strips
                keep_with_next(blocks.u, a, u_a, is_inner)
                keep_with_next(blocks.u, b, u_b, is_inner)


@large_kernel
def measure_lines(blocks: ti.template(), along: Lines, rest: ti.f32, quantum: ti.f32, strain: Blocks):
    """Strains at the nodes of all lines along one direction, of the two springs there or the one, for the lines across:
    in blocks of these.
    """
    for place in range(along.strips * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        strip = place // LEAST_RUN
        turn(blocks.u, strip, along)
        before = Block(0.0)
        for k in range(along.length):
            a = along.first + k * along.strips + strip
            after = Block(0.0)
            if k + 1 < along.length:
                u_a, u_b = blocks.u[a], blocks.u[a + along.strips]
                p_a, p_b = blocks.lattice[a], blocks.lattice[a + along.strips]
                for at in range(LANES):
                    d = quantum * ti.cast(lane(p_a, at) - lane(p_b, at), ti.f32) + (lane(u_a, at) - lane(u_b, at))
                    after[at] = d.norm() / rest - 1.0
            weight = ti.select(k == 0 or k + 1 == along.length, 1.0, 0.5)
            other = along.other_first + strip * LANES * along.other_strips + k // LANES
            for at in range(LANES):
                strain[other + at * along.other_strips][k % LANES] = weight * (before[at] + after[at])
            before = after


@large_kernel
def solve_lines(
    blocks: ti.template(),
    along: Lines,
    stiffness: Floats,
    rest: ti.f32,
    quantum: ti.f32,
    dt_squared: ti.f32,
    is_first: ti.i32,
    multipliers: Blocks,
    poisson: ti.f32,
    across: Blocks,
):
    """The threads along one direction exactly: the Thomas algorithm forth, then back, where nodes move.

    `stiffness` is as of `bend_lines`, `rest` the length of a spring [m]; `multipliers` of the spring that leads on from
    each node start at 0 if `is_first`; `across` are the strains at nodes along the other direction, if `poisson` is not
    0.
    """
    for place in range(along.strips * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        strip = place // LEAST_RUN
        turn(blocks.u, strip, along)
        compliance = Block(0.0)
        for at in range(LANES):
            compliance[at] = 1.0 / (dt_squared * stiffness[strip * LANES + at])
        n, inverse_pivot, solved = VectorBlock(0.0), Block(0.0), Block(0.0)
        for k in range(along.length - 1):
            a = along.first + k * along.strips + strip
            b = a + along.strips
            u_a, u_b, p_a, p_b = blocks.u[a], blocks.u[b], blocks.lattice[a], blocks.lattice[b]
            w_a, w_b, multiplier = blocks.inverse_mass[a], blocks.inverse_mass[b], multipliers[a]
            inverse_length, factor, shift = Block(0.0), Block(0.0), Block(0.0)
            if poisson > 0.0:
                shift = 0.5 * poisson * rest * (across[a] + across[b])
            for at in range(LANES):
                at_start = quantum * ti.cast(lane(p_a, at) - lane(p_b, at), ti.f32)
                d = at_start + (lane(u_a, at) - lane(u_b, at))
                length = ti.max(d.norm(), TINY_LENGTH)
                direction = direction_of(at_start, d / length)
                before = ti.select(is_first, 0.0, multiplier[at])
                coupling = -w_a[at] * direction.dot(lane(n, at))  # n is of the spring before
                lower = coupling * inverse_pivot[at]
                pivot = 1.0 / (w_a[at] + w_b[at] + compliance[at] - coupling * lower)
                solved[at] = (rest - shift[at] - length - compliance[at] * before - coupling * solved[at]) * pivot
                inverse_pivot[at], factor[at] = pivot, lower
                inverse_length[at], multiplier[at] = 1.0 / length, before
                set_lane(n, at, direction)
            blocks.n[a], blocks.change[a], blocks.factor[a] = n, solved, factor
            blocks.inverse_length[a], multipliers[a] = inverse_length, multiplier
        factor_after, change, largest = Block(0.0), Block(0.0), Block(0.0)
        after = VectorBlock(0.0)  # the push of the spring after the node
        for m in range(along.length - 1):
            a = along.first + (along.length - 2 - m) * along.strips + strip
            b = a + along.strips
            u_b, n_a, w_a, w_b = blocks.u[b], blocks.n[a], blocks.inverse_mass[a], blocks.inverse_mass[b]
            forward, factor, inverse_length = blocks.change[a], blocks.factor[a], blocks.inverse_length[a]
            multiplier, tension = multipliers[a], Block(0.0)
            for at in range(LANES):
                own = forward[at] - factor_after[at] * change[at]
                push = own * lane(n_a, at)
                add_to_lane(u_b, at, w_b[at] * (lane(after, at) - push))
                set_lane(after, at, push)
                factor_after[at], change[at] = factor[at], own
                multiplier[at] += own
                tension[at] = tension_to_turn(-multiplier[at] * inverse_length[at], w_a[at] + w_b[at])
                largest[at] = ti.max(largest[at], tension[at])
            blocks.u[b], multipliers[a], blocks.tension[a] = u_b, multiplier, tension
        head = along.first + strip
        u_a, w_a = blocks.u[head], blocks.inverse_mass[head]
        for at in range(LANES):
            add_to_lane(u_a, at, w_a[at] * lane(after, at))
        blocks.u[head] = u_a
        blocks.is_taut[head] = ti.cast(largest.max() > 0.0, ti.i32)
        turn_back(blocks.u, strip, along)


@large_kernel
def straighten_lines(blocks: ti.template(), along: Lines):
    """Let tension turn with the threads along one direction, in strips with too much of it."""
    for place in range(along.strips * LEAST_RUN):
        if place % LEAST_RUN != 0:
            continue
        strip = place // LEAST_RUN
        if blocks.is_taut[along.first + strip]:
            turn(blocks.u, strip, along)
            turn(blocks.predicted, strip, along)
            straighten_strip(blocks, along.first + strip, along)
            turn_back(blocks.u, strip, along)


@func
def straighten_strip(blocks: ti.template(), line: ti.i32, along: Lines):
    """Solve (1 + w_i (t_i-1 + t_i)) e_i - w_i t_i-1 e_i-1 - w_i t_i e_i+1 = e~_i of LANES threads.

    Forth, with what the head was moved by as the first row, and back; `n` and `factor` of a spring hold what is solved
    at the node that it leads from.
    """
    moved, share, t_before = VectorBlock(0.0), Block(0.0), Block(0.0)
    for k in range(along.length):
        a = line + k * along.strips
        u, predicted, w_a, t_after = blocks.u[a], blocks.predicted[a], blocks.inverse_mass[a], blocks.tension[a]
        is_last = k + 1 == along.length
        for at in range(LANES):
            pull = w_a[at] * t_before[at]
            t_before[at] = ti.select(is_last, 0.0, t_after[at])
            onward = w_a[at] * t_before[at]
            pivot = 1.0 / (1.0 + onward + pull * (1.0 - share[at]))
            set_lane(moved, at, pivot * (lane(u, at) - lane(predicted, at) + pull * lane(moved, at)))
            share[at] = pivot * onward
        blocks.n[a], blocks.factor[a] = moved, share
    e = VectorBlock(0.0)
    for m in range(along.length):
        a = line + (along.length - 1 - m) * along.strips
        u, predicted, share_a = blocks.n[a], blocks.predicted[a], blocks.factor[a]
        for at in range(LANES):
            set_lane(e, at, lane(u, at) + share_a[at] * lane(e, at))
            set_lane(u, at, lane(predicted, at) + lane(e, at))
        blocks.u[a] = u


@kernel
def measure_excess_in_lines(
    multipliers: Blocks,
    along: Lines,
    stiffness: Floats,
    rest: ti.f32,
    poisson: ti.f32,
    across: Blocks,
    nodes: Nodes,
    dt_squared: ti.f32,
) -> ti.math.vec2:
    """The same of a rectangle's threads along one direction.

    Args:
        multipliers: from `solve_lines`, and at the same places.
        along: the lines.
        stiffness: of the springs of each line [N/m].
        rest: length of a spring [m].
        poisson: Poisson's ratio [-].
        across: strains at nodes along the other direction, as the threads took them, if `poisson` is not 0.
        nodes: of all cloths.
        dt_squared: [s²].
    """
    ti.loop_config(serialize=True)
    largest, unconverged = 0.0, 0.0
    for line in range(along.count):
        for k in range(along.length - 1):
            block = along.first + line // LANES + k * along.strips
            i = along.first_node + line * along.line_step + k * along.node_step
            multiplier = multipliers[block][line % LANES]
            shift = 0.0
            if poisson > 0.0:
                after = block + along.strips
                shift = 0.5 * poisson * rest * (across[block][line % LANES] + across[after][line % LANES])
            excess = excess_of(i, i + along.node_step, rest, shift, stiffness[line], multiplier, nodes, dt_squared)
            largest = ti.max(largest, excess)
            if excess > LARGEST_RESIDUAL:
                unconverged += 1.0
    return ti.math.vec2(largest, unconverged)
