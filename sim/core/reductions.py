"""Reductions and tests whose result does not depend on the order in which threads run.

Sums of floating-point numbers depend on their order, so they are done in a fixed shape: a number of lanes that depends
on the kind of device alone, each with its own share of the numbers, and a tree over the lanes. No float atomics.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang import impl

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.core.launch import kernel

CPU_LANES = 256
GPU_LANES = 131072  # few for a CPU, whose threads read best what lies together; enough for a GPU to be busy
BRANCHES, LAST_BRANCHES = 128, 16  # numbers that one node of the tree takes together: of lanes, and at last
MAX_QUANTITIES = 8  # most maxima and sums of one reduction, which its kernel returns as a vector

Results = ti.types.vector(MAX_QUANTITIES, ti.f32)


@bundle
class Tree(NamedTuple):
    """Partial results of the lanes, and what `reduced` makes of them."""

    partial: Floats  # result q of lane l at q * lanes + l; the maxima come first
    lanes: ti.i32
    quantities: ti.i32  # maxima and sums
    maxima: ti.i32
    nodes: Floats  # of the tree


@bundle
class Share(NamedTuple):
    """The numbers of each lane: lane l has the numbers l * lane_step + k * item_step, k < items."""

    items: ti.i32
    lane_step: ti.i32
    item_step: ti.i32
    tree: Tree


@dataclass(frozen=True)
class Lanes:
    """Division of the numbers 0 ... n-1: lane l has l * lane_step + k * item_step for k < items_per_lane(n).

    A lane of a CPU has a run of neighbours; neighbouring lanes of a GPU have neighbouring numbers.
    """

    count: int
    on_gpu: bool

    def items(self, length: int) -> int:
        """Most numbers of one lane."""
        return (length + self.count - 1) // self.count

    def lane_step(self, length: int) -> int:
        """Distance of the first numbers of neighbouring lanes."""
        return 1 if self.on_gpu else self.items(length)

    def item_step(self) -> int:
        """Distance of neighbouring numbers of one lane."""
        return self.count if self.on_gpu else 1


class LaneReduction:
    """Several maxima and sums over the same numbers, of which a kernel leaves one partial result a lane.

    Attributes:
        lanes: how the kernel shares the numbers out.
        partial: result q of lane l at `partial[q * lanes.count + l]`; the maxima come first.
    """

    def __init__(self, *, maxima: int, sums: int) -> None:
        self.lanes = device_lanes()
        self.partial = ti.ndarray(ti.f32, (maxima + sums) * self.lanes.count)
        if maxima + sums > MAX_QUANTITIES:
            raise ValueError(f"a reduction has at most {MAX_QUANTITIES} quantities, not {maxima + sums}")
        self._maxima, self._quantities = maxima, maxima + sums
        self._nodes = ti.ndarray(ti.f32, self._quantities * (self.lanes.count // BRANCHES))

    @property
    def tree(self) -> Tree:
        """Partial results and their tree, as `reduced` takes them one by one."""
        return Tree(self.partial, self.lanes.count, self._quantities, self._maxima, self._nodes)

    def over(self, count: int) -> Share:
        """The reduction over `count` numbers, as a kernel takes it."""
        return Share(self.lanes.items(count), self.lanes.lane_step(count), self.lanes.item_step(), self.tree)

    def unpack(self, results: Sequence[float]) -> NDArray[np.float32]:
        """The maxima, then the sums, (maxima + sums,), of what a kernel returned from `reduced`."""
        return np.array(results[: self._quantities], dtype=np.float32)


def runs_on_gpu() -> bool:
    """Whether Taichi, which must have been started, runs on a GPU."""
    program = impl.get_runtime().prog
    if program is not _asked.get("program"):
        _asked.update(program=program, on_gpu=impl.current_cfg().arch not in (ti.x64, ti.arm64))
    return bool(_asked["on_gpu"])


_asked: dict[str, Any] = {}
"""What `runs_on_gpu` answered last, and of which program of Taichi: it is asked a dozen times in a substep."""


def device_lanes() -> Lanes:
    """The lanes that suit the device Taichi runs on."""
    on_gpu = runs_on_gpu()
    return Lanes(GPU_LANES if on_gpu else CPU_LANES, on_gpu)


@func
def is_finite(value: ti.f32) -> ti.i32:
    """Whether a number is neither NaN nor infinite; looks at the bits, as `fast_math` folds `x != x` to false."""
    return ti.cast((ti.bit_cast(value, ti.i32) & 0x7F800000) != 0x7F800000, ti.i32)


@func
def reduced(partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats) -> Results:
    """More levels of the tree: `BRANCHES` lanes to a node, nodes to `LAST_BRANCHES`, these to one, in a fixed order.

    For the outermost level of a kernel, after the loop over the lanes: its loops then run in parallel.
    """
    node_count = lanes // BRANCHES
    last_count = ti.min(node_count, LAST_BRANCHES)
    first_end, second_end, third_end = quantities * node_count, quantities * last_count, quantities
    # A CPU's few nodes are summed up sooner than other threads wake.
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for n in range(first_end):
        q = n // node_count
        first = q * lanes + n % node_count
        value = partial[first]
        for k in range(1, BRANCHES):
            other = partial[first + k * node_count]
            value = ti.select(q < maxima, ti.max(value, other), value + other)
        nodes[n] = value
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for n in range(second_end):
        q = n // last_count
        first = q * node_count + n % last_count
        value = nodes[first]
        for k in range(1, node_count // last_count):
            other = nodes[first + k * last_count]
            value = ti.select(q < maxima, ti.max(value, other), value + other)
        nodes[first] = value
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for q in range(third_end):
        value = nodes[q * node_count]
        for k in range(1, last_count):
            other = nodes[q * node_count + k]
            value = ti.select(q < maxima, ti.max(value, other), value + other)
        nodes[q * node_count] = value
    results = Results(0.0)
    for q in ti.static(range(MAX_QUANTITIES)):
        if q < quantities:
            results[q] = nodes[q * node_count]
    return results


@func
def reduced_tree(tree: Tree) -> Results:
    """As `reduced`."""
    return reduced(tree.partial, tree.lanes, tree.quantities, tree.maxima, tree.nodes)


@kernel
def sum_integers(values: Integers) -> ti.i32:
    """Sum of integers, exact in any order."""
    total = 0
    for i in range(values.shape[0]):
        total += values[i]
    return total
