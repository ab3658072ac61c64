"""Sums and maxima over a grid that do not depend on how many threads take part.

Each lane of each row (`lanes`) is reduced by one thread of a caller's kernel, and its partial results by a tree whose
shape depends on the grid and the kind of device alone. All of it is single precision, since Metal has no other: a sum
of n lanes of m cells errs by (m + n/256 + 256) units of 6e-8 at most, relative to the sum of the magnitudes.
"""

import taichi as ti

from sim.core.reductions import BRANCHES, device_lanes
from sim.smoke.lanes import lane_count

Pair = ti.types.vector(2, ti.f32)
"""What a kernel returns of a reduction."""


@ti.data_oriented
class RowReductions:
    """Two numbers a lane, left by a caller's kernel at `partial[place(i, j, lane)]`, reduced over all rows.

    The caller's kernel goes on with `sum_up()` or `find_maxima()` at its outermost level, where their loops run in
    parallel; what comes after has the result.

    Attributes:
        partial: two numbers of each lane.
        result: two numbers over all lanes, a field without indices.
    """

    def __init__(self, rows_x: int, rows_y: int) -> None:
        self._lanes, self._rows_y = lane_count(), rows_y
        self._length = rows_x * rows_y * self._lanes
        nodes = device_lanes()
        self._nodes, self._items = nodes.count, nodes.items(self._length)
        self._node_step, self._item_step = nodes.lane_step(self._length), nodes.item_step()
        # Many nodes are combined in one more parallel step; few are as quickly combined by one thread.
        self._is_deep = self._nodes > 2 * BRANCHES
        self._last_nodes = self._nodes // BRANCHES if self._is_deep else self._nodes
        self.partial = ti.Vector.field(2, ti.f32, shape=self._length)
        self._node = ti.Vector.field(2, ti.f32, shape=self._nodes)
        self.result = ti.Vector.field(2, ti.f32, shape=())

    @property
    def device_bytes(self) -> int:
        """Memory that it has allocated [bytes]; on a GPU nearly all of it is that of the lanes, 32 a row."""
        return 8 * (self._length + self._nodes + 1)

    @ti.func
    def place(self, i: ti.i32, j: ti.i32, lane: ti.i32) -> ti.i32:
        """Where the lane of a row leaves its numbers; rows count from 1."""
        return ((i - 1) * self._rows_y + j - 1) * self._lanes + lane

    @ti.func
    def sum_up(self):
        """Set `result` to the sums."""
        self._reduce(False)

    @ti.func
    def find_maxima(self):
        """Set `result` to the maxima; the numbers are not negative."""
        self._reduce(True)

    @ti.func
    def _reduce(self, of_maxima: ti.template()):
        for node in range(self._nodes):
            total = ti.Vector([0.0, 0.0])
            for item in range(self._items):
                at = node * self._node_step + item * self._item_step
                if at < self._length:
                    total = self._combine(total, self.partial[at], of_maxima)
            self._node[node] = total
        if ti.static(self._is_deep):
            for node in range(self._last_nodes):
                total = self._node[node]
                for branch in range(1, BRANCHES):
                    total = self._combine(total, self._node[node + branch * self._last_nodes], of_maxima)
                self._node[node] = total
        ti.loop_config(serialize=True)
        for _ in range(1):
            total = self._node[0]
            for node in range(1, self._last_nodes):
                total = self._combine(total, self._node[node], of_maxima)
            self.result[None] = total

    @ti.func
    def _combine(self, first, second, of_maxima: ti.template()):
        return ti.max(first, second) if ti.static(of_maxima) else first + second
