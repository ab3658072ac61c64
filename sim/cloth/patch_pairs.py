"""Lists of near elements for each pair of patches, searched anew where and when motion has used them up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cloth.patch_motion_kernels import (
    age_pairs,
    enclose_patches,
    fit_motions,
    measure_approach,
    merge_boxes,
    pair_patches,
    place_leaves,
    use_slack,
)
from sim.cloth.patches import Patches
from sim.cloth.self_collision_kernels import clear_lists, keep_distances, make_room

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

GROWTH = 1.5
MAX_PAIRS = 2**28
"""Most pairs of a list: 5 GiB on the device; so many mean that the step is far too large."""

TOO_MANY = f"more than {MAX_PAIRS} pairs of cloth elements are near each other; lower the step"


class PairList:
    """Pairs of elements, those of each pair of patches in a piece of its own; grows when it must.

    Attributes:
        end: pieces are before this place.
        vertices: a vertex and a triangle's corners, or the ends of two edges, (capacity,) ivec4; `NONE` where a piece
            is not full.
        patches: number of the pair of patches, (capacity,).
        wanted: distance that they keep [m], (capacity,).

    Args:
        are_edges: whether the elements are edges.
        capacity: pairs of elements to start with.
        pieces: pairs of patches.
    """

    def __init__(self, *, are_edges: bool, capacity: int, pieces: int) -> None:
        self._are_edges = are_edges
        self._end = ti.ndarray(ti.i32, 2)
        self._allocate(capacity)
        self.set_pieces(pieces)

    def set_pieces(self, capacity: int) -> None:
        """Make room for the pieces of so many pairs of patches, all empty."""
        self._start, self._room, self._found, self._again = (ti.ndarray(ti.i32, capacity) for _ in range(4))
        self.clear()

    def clear(self) -> None:
        """Forget all pieces."""
        self.end = 0
        self._start.fill(0)
        self._room.fill(0)
        self._end.fill(0)

    def fill(self, search: Callable[..., None], state: ClothState, rest: ti.Ndarray, searched: ti.Ndarray, count: int,
             *arguments: object) -> None:  # fmt: skip
        """Have a search list the elements of some pairs of patches; the pieces of all others stay as they are.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        self._list(search, searched, count, arguments)
        short, end = make_room(
            count, searched, self._start, self._room, self._found, self.vertices, self._end, self._again
        )[:2]  # fmt: skip
        if end < 0 or end > MAX_PAIRS:
            raise OverflowError(TOO_MANY)
        if end > self._capacity:
            self._grow(int(GROWTH * end))
        self.end = int(end)
        if short:
            self._list(search, self._again, int(short), arguments)
        keep_distances(
            count, searched, self._start, self._found, self.vertices, self._are_edges, rest, state.body,
            state.thickness, self.wanted, self.patches,
        )  # fmt: skip

    def _list(
        self, search: Callable[..., None], searched: ti.Ndarray, count: int, arguments: tuple[object, ...]
    ) -> None:
        pieces = (self._start, self._room, self._found, self.vertices)
        clear_lists(count, searched, *pieces)
        search(count, searched, *arguments, *pieces)

    def _allocate(self, capacity: int) -> None:
        self._capacity = capacity
        self.vertices = ti.Vector.ndarray(4, ti.i32, capacity)
        self.wanted = ti.ndarray(ti.f32, capacity)
        self.patches = ti.ndarray(ti.i32, capacity)

    def _grow(self, capacity: int) -> None:
        """Make room for so many pairs, and keep those that are listed: when lists grow shows in no search after it."""
        old, before = self._capacity, (self.vertices, self.wanted, self.patches)
        self._allocate(capacity)
        for source, target in zip(before, (self.vertices, self.wanted, self.patches), strict=True):
            values = source.to_numpy()
            target.from_numpy(np.concatenate([values, np.zeros((capacity - old, *values.shape[1:]), values.dtype)]))


class PatchPairs:
    """The pairs of patches that may meet within some substeps, and how much nearer each may come unsearched.

    Attributes:
        count: number of pairs of patches.
        pairs: their numbers, the smaller first, (count,) ivec2.
        low, high: boxes around patches at the last `prepare` [m], (m,) vec3.
        expired: numbers of the pairs to be searched.
        approach: how much nearer points of a pair come at most in this substep [m], (count,).
        reach: how far to search for the elements of each pair [m], (count,).

    Args:
        patches: of the cloths.
    """

    def __init__(self, patches: Patches) -> None:
        self.patches = patches
        m = max(patches.count, 1)
        self.low, self.high, self._centre, self._shift, self._turn = (ti.Vector.ndarray(3, ti.f32, m) for _ in range(5))
        self._radius, self._rest = ti.ndarray(ti.f32, m), ti.ndarray(ti.f32, m)
        self._tree_low, self._tree_high = (ti.Vector.ndarray(3, ti.f32, 2 * patches.leaves) for _ in range(2))
        self._counter = ti.ndarray(ti.i32, 1)
        self.count = 0
        self._allocate(8 * m)

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.pairs = ti.Vector.ndarray(2, ti.i32, capacity)
        self.expired = ti.ndarray(ti.i32, capacity)
        self.reach, self._wake, self._slack, self.approach = (ti.ndarray(ti.f32, capacity) for _ in range(4))

    def enclose(self, state: ClothState) -> None:
        """Note where patches are."""
        enclose_patches(
            self.patches.count, self.patches.first_corner, self.patches.corners, state.position, self.low, self.high
        )

    def fit(self, state: ClothState) -> None:
        """Note how patches move in this substep."""
        fit_motions(
            self.patches.count, self.patches.first_corner, self.patches.corners, state.position, state.displacement,
            *self._motion,
        )  # fmt: skip

    def meet(self, reach: float, collides: ti.Ndarray) -> None:
        """List the pairs of patches within reach [m], of cloths that may meet; nothing is known about them yet."""
        patches = self.patches
        tree = (self.low, self.high, self._tree_low, self._tree_high)
        place_leaves(patches.count, patches.leaves, *tree)
        first = patches.leaves
        while first := first // 2:
            merge_boxes(first, self._tree_low, self._tree_high)
        while True:
            found = pair_patches(
                patches.count, patches.leaves, *tree, patches.cloth, collides, reach, self.pairs, self._counter,
                self.capacity,
            )  # fmt: skip
            if found < 0 or found > MAX_PAIRS:
                raise OverflowError(TOO_MANY)
            if found <= self.capacity:
                break
            self._allocate(int(GROWTH * found))
        self.count = int(found)

    def age(self, thickness: float, least_skin: float, whole: float, more: float, used: float, *, is_new: bool) -> int:
        """Find which pairs have to be searched in this substep, and how far each; returns how many there are.

        Args:
            thickness: distance within which all elements have to be listed [m].
            least_skin: how far beyond to search at least [m].
            whole: how much nearer any two points of the cloths come at most [m].
            more: how much nearer they may come besides [m].
            used: sum of what `whole` was since the pairs of patches were listed [m].
            is_new: whether elements of all pairs have to be looked at anew.
        """
        return int(
            age_pairs(
                self.count, self.pairs, self.low, self.high, *self._motion, thickness, least_skin, whole, more, used,
                int(is_new), self._wake, self._slack, self.approach, self.reach, self.expired, self._counter,
            )
        )  # fmt: skip

    def measure(self, whole: float, used: float) -> None:
        """Note how much nearer pairs come by the motion that was fitted last, of those that it can bring together."""
        measure_approach(self.count, self.pairs, *self._motion, whole, used, self._wake, self.approach)

    def use(self, more: float) -> None:
        """A substep is over: its motion, and `more` [m] that was added to it at most, are used up."""
        use_slack(self.count, more, self.approach, self._slack)

    @property
    def _motion(self) -> tuple[ti.Ndarray, ...]:
        return self._centre, self._shift, self._turn, self._radius, self._rest
