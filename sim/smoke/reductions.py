"""Sums and maxima over a grid that do not depend on how many threads take part.

Each lane of each row (`lanes`) is reduced by one thread of a caller's kernel, and its partial results by a tree whose
shape depends on the grid and the kind of device alone. All of it is single precision, since Metal has no other: a sum
of n lanes of m cells errs by (m + n/256 + 256) units of 6e-8 at most, relative to the sum of the magnitudes.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func
from sim.core.reductions import BRANCHES, device_lanes
from sim.smoke.lanes import Grid

Pair = ti.types.vector(2, ti.f32)
"""What a kernel returns of a reduction."""

Pairs = ti.types.ndarray(dtype=ti.math.vec2, ndim=1)


@bundle
class Rows(NamedTuple):
    """Two numbers of each lane of each row, and the nodes of the tree that reduces them.

    A kernel leaves numbers at `partial[partial_place(box, i, j, lane)]` and goes on with `sum_up` or `find_maxima` at
    its outermost level, where their loops run in parallel; what comes after has the result in `nodes[0]`.
    """

    partial: Pairs
    nodes: Pairs
    length: ti.i32  # of `partial`
    items: ti.i32  # most partial results of a node
    node_step: ti.i32  # distance of the first ones of neighbouring nodes
    item_step: ti.i32  # distance of neighbouring ones of a node
    last_nodes: ti.i32  # how many one thread combines at last
    is_deep: ti.template()  # whether there is a parallel step before that


def new_rows(box: Grid) -> Rows:
    """Room for a reduction over the rows of a grid."""
    length = box.nx * box.ny * box.lanes
    nodes = device_lanes()
    # Many nodes are combined in one more parallel step; few are as quickly combined by one thread.
    is_deep = nodes.count > 2 * BRANCHES
    return Rows(
        ti.Vector.ndarray(2, ti.f32, length),
        ti.Vector.ndarray(2, ti.f32, nodes.count),
        length,
        nodes.items(length),
        nodes.lane_step(length),
        nodes.item_step(),
        nodes.count // BRANCHES if is_deep else nodes.count,
        is_deep,
    )


def with_nodes_of_its_own(rows: Rows) -> Rows:
    """Room for a second reduction in a kernel, of which the partial results take the place of the first one's.

    Taichi takes what a kernel has read outside of its loops for what is still there, whatever loops have stored since.
    """
    return rows._replace(nodes=ti.Vector.ndarray(2, ti.f32, rows.nodes.shape[0]))


@func
def partial_place(box: Grid, i: ti.i32, j: ti.i32, lane: ti.i32) -> ti.i32:
    """Where the lane of a row leaves its numbers."""
    return ((i - 1) * box.ny + j - 1) * box.lanes + lane


@func
def sum_up(rows: Rows):
    """Set the result to the sums."""
    _reduce(rows, False)


@func
def find_maxima(rows: Rows):
    """Set the result to the maxima; the numbers are not negative."""
    _reduce(rows, True)


@func
def _reduce(rows: Rows, of_maxima: ti.template()):
    for node in range(rows.nodes.shape[0]):
        total = ti.Vector([0.0, 0.0])
        for item in range(rows.items):
            at = node * rows.node_step + item * rows.item_step
            if at < rows.length:
                total = _combine(total, rows.partial[at], of_maxima)
        rows.nodes[node] = total
    if ti.static(rows.is_deep):
        for node in range(rows.last_nodes):
            total = rows.nodes[node]
            for branch in range(1, BRANCHES):
                total = _combine(total, rows.nodes[node + branch * rows.last_nodes], of_maxima)
            rows.nodes[node] = total
    ti.loop_config(serialize=True)
    for _ in range(1):
        total = rows.nodes[0]
        for node in range(1, rows.last_nodes):
            total = _combine(total, rows.nodes[node], of_maxima)
        rows.nodes[0] = total


@func
def _combine(first, second, of_maxima: ti.template()):
    return ti.max(first, second) if ti.static(of_maxima) else first + second
