"""Lists of near elements for each pair of patches, searched anew where and when motion has used them up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.patch_motion_kernels import (
    age_pairs,
    finish_patches,
    look_at_patches,
    measure_changes,
    merge_boxes,
    pair_patches,
    place_leaves,
)
from sim.cloth.patches import Patches
from sim.cloth.self_collision_kernels import LANES, keep_distances, make_room
from sim.reductions import MAX_QUANTITIES, LaneReduction, runs_on_gpu

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

GROWTH = 1.5
MAX_PAIRS = 2**28
"""Most pairs of a list: 5 GiB on the device; so many mean that the step is far too large."""

SUBSTEPS_OF_PATCHES = (12.0, 60.0)
PATCH_REACH_IN_EDGES = 3.0
"""How many substeps' motion of the patches the list of their pairs allows for: as many as take them so many mean edges,
but in this range. All pairs are searched when the list is made anew, and each costs a little in every substep."""

MARGIN = 0.5
"""How far contacts are expected to push, in thicknesses; where they push farther, pairs are looked at again."""

STILL = 1.0e-3
"""Part of the thickness by which displacements of a patch may differ without a turn being fitted to them: a list lasts
for a hundred substeps even so, and cloth that falls or lies is looked at once instead of twice."""

TOO_MANY = f"more than {MAX_PAIRS} pairs of cloth elements are near each other; lower the step"


class PairList:
    """Pairs of elements, those of each pair of patches in a piece of its own; grows when it must.

    Attributes:
        end: pieces are before this place.
        vertices: a vertex and a triangle's corners, or the ends of two edges, (capacity,) ivec4; `NONE` where a piece
            is not full.
        patches: number of the pair of patches, (capacity,).
        wanted: distance that they keep [m], (capacity,).
        found: number of elements in each piece.

    Args:
        are_edges: whether the elements are edges.
        capacity: pairs of elements to start with.
        pieces: pairs of patches.
    """

    def __init__(self, *, are_edges: bool, capacity: int, pieces: int) -> None:
        self._are_edges = are_edges
        self._lanes = LANES if runs_on_gpu() else 1
        self._end = ti.ndarray(ti.i32, 2)
        self._allocate(capacity)
        self.set_pieces(pieces)

    def set_pieces(self, capacity: int) -> None:
        """Make room for the pieces of so many pairs of patches, all empty."""
        self._start, self._room, self.found, self._again = (ti.ndarray(ti.i32, capacity) for _ in range(4))
        self.clear()

    def clear(self) -> None:
        """Forget all pieces."""
        self.end = 0
        self._start.fill(0)
        self._room.fill(0)
        self._end.fill(0)

    def fill(self, search: Callable[..., None], state: ClothState, rest: ti.Ndarray, searched: ti.Ndarray, count: int,
             *arguments: object) -> None:  # fmt: skip
        """Have a search list the elements of some pairs of patches, `found` being 0; the pieces of all others stay.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        pieces = (self._start, self._room, self.found)
        search(count, self._lanes, searched, *arguments, *pieces, self.vertices)
        short, end = make_room(
            count, searched, *pieces, self.vertices, self._end, self._again
        )[:2]  # fmt: skip
        if end < 0 or end > MAX_PAIRS:
            raise OverflowError(TOO_MANY)
        if end > self._capacity:
            self._grow(int(GROWTH * end))
        self.end = int(end)
        if short:
            search(int(short), self._lanes, self._again, *arguments, *pieces, self.vertices)
        keep_distances(
            count, searched, *pieces, self.vertices, self._are_edges, rest, state.body,
            state.thickness, self.wanted, self.patches,
        )  # fmt: skip

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
        low, high: boxes around patches at the last `look` [m], (m,) vec3.
        motion_arrays: the rigid motion of each patch in the substep: centre [m], shift [m], turn [rad], (m,) vec3;
            distance of its corners from the centre, and of their displacements from that motion, at most [m], (m,).
        expired: numbers of the pairs to be searched; `needed` is 1 for their patches, (m,).
        approach: how much nearer points of a pair come at most in this substep [m], (count,); `allowed` how much
            contacts may add to it.
        reach: how far to search for the elements of each pair [m], (count,).

    Args:
        patches: of the cloths.
    """

    def __init__(self, patches: Patches) -> None:
        self.patches = patches
        m = max(patches.count, 1)
        self.low, self.high, self._centre, self._shift, self._turn = (ti.Vector.ndarray(3, ti.f32, m) for _ in range(5))
        (
            self._radius,
            self._rest,
            self._motion,
            self._change,
            self._margin,
            self._more,
            self._spent,
            self._reach,
            self._way,
        ) = (ti.ndarray(ti.f32, m) for _ in range(9))
        self._expected = ti.Vector.ndarray(3, ti.f32, patches.vertex_count)
        self._tree_low, self._tree_high = (ti.Vector.ndarray(3, ti.f32, 2 * patches.leaves) for _ in range(2))
        self._counter = ti.ndarray(ti.i32, 1)
        self.needed = ti.ndarray(ti.i32, m)
        self.needed.fill(0)
        self._maxima = LaneReduction(maxima=MAX_QUANTITIES, sums=0)
        self._astray, self._half_thickness, self._still = 0.0, 0.0, 0.0
        self.count = 0
        self._allocate(8 * m)

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.pairs = ti.Vector.ndarray(2, ti.i32, capacity)
        self.expired = ti.ndarray(ti.i32, capacity)
        self.reach, self._wake, self._slack, self.approach, self.allowed = (
            ti.ndarray(ti.f32, capacity) for _ in range(5)
        )

    @property
    def motion_arrays(self) -> tuple[ti.Ndarray, ...]:
        """See above."""
        return self._centre, self._shift, self._turn, self._radius, self._rest

    @property
    def _fitted(self) -> tuple[ti.Ndarray, ...]:
        return self.low, self.high, *self.motion_arrays

    def set_margin(self, thickness: float) -> None:
        """Allow contacts to displace vertices by half a thickness [m], whatever they did before."""
        self._half_thickness, self._still = 0.5 * thickness, STILL * thickness
        self._margin.fill(MARGIN * thickness)
        self._more.fill(max(MARGIN * thickness - self._half_thickness, 0.0))

    def look(self, state: ClothState) -> tuple[NDArray[np.float64], bool]:
        """Note where patches are and how they move in this substep.

        Returns the largest components of the displacements [m], then those of their negatives, (6,); and whether the
        pairs of patches hold for this substep, if they held before.
        """
        patches, lanes, n = self.patches, self._maxima.lanes, self.patches.vertex_count
        partial, lane_count, *_, nodes = self._maxima.tree
        *ends, self._astray, beyond = look_at_patches(
            n, lanes.items(n), lanes.lane_step(n), lanes.item_step(), self._still, state.position,
            state.displacement, self._expected, patches.count, lanes.items(patches.count),
            lanes.lane_step(patches.count), patches.first_corner, patches.corners, *self._fitted, self._motion,
            self._more, self._spent, self._reach, self._way, partial, lane_count, nodes,
        )  # fmt: skip
        return np.array(ends, dtype=np.float64), beyond <= 0.0

    def meet(self, thickness: float, edge: float, collides: ti.Ndarray) -> None:
        """List the pairs of patches that may get within a thickness [m]; nothing is known about them yet.

        Args:
            thickness: the largest [m].
            edge: the mean one [m].
            collides: which cloths do with themselves, (b,).
        """
        patches = self.patches
        self._astray = 0.0
        tree = self._tree_low, self._tree_high
        place_leaves(
            patches.count, patches.leaves, self.low, self.high, self._motion, self._change, self._more,
            *SUBSTEPS_OF_PATCHES, PATCH_REACH_IN_EDGES * edge, 0.5 * edge, 0.5 * thickness, self._reach, self._spent,
            *tree,
        )  # fmt: skip
        first = patches.leaves
        while first := first // 2:
            merge_boxes(first, *tree)
        while True:
            found = pair_patches(
                patches.count, patches.leaves, *tree, patches.cloth, collides, self.pairs, self._counter, self.capacity
            )
            if found < 0 or found > MAX_PAIRS:
                raise OverflowError(TOO_MANY)
            if found <= self.capacity:
                break
            self._allocate(int(GROWTH * found))
        self.count = int(found)

    def age(self, thickness: float, least_skin: float, *, is_new: bool) -> int:
        """Find which pairs have to be searched in this substep, and how far each; returns how many there are.

        Args:
            thickness: distance within which all elements have to be listed [m].
            least_skin: how far beyond to search at least [m].
            is_new: whether elements of all pairs have to be looked at anew.
        """
        return int(
            age_pairs(
                self.count, self.pairs, *self._fitted, self._motion, self._margin, self._more, self._spent, self._way,
                thickness, least_skin, self._astray, int(is_new), self._wake, self._slack, self.approach, self.allowed,
                self.reach, self.expired, self.needed, self._counter,
            )
        )  # fmt: skip

    def measure_changes(self, state: ClothState, predicted: ti.Ndarray) -> tuple[float, float]:
        """How far contacts displaced vertices at most [m]; and those that they displaced farther than allowed for.

        Where they did, they may displace half as much again from now on.
        """
        patches, lanes = self.patches, self._maxima.lanes
        partial, lane_count, *_, nodes = self._maxima.tree
        largest, beyond = measure_changes(
            patches.count, lanes.items(patches.count), lanes.lane_step(patches.count), lanes.item_step(),
            patches.first_corner, patches.corners, state.displacement, predicted, self._half_thickness, self._change,
            self._margin, self._more, partial, lane_count, nodes,
        )  # fmt: skip
        return float(largest), float(beyond)

    def finish(self, state: ClothState, negligible: float, *, is_changed: bool) -> None:
        """A substep is over: its motion is used up, and what contacts added to it, if they did.

        Args:
            state: at the end of its displacements.
            negligible: what they may add without the motion of patches being looked at anew [m].
            is_changed: whether `measure_changes` was asked in this substep.
        """
        patches = self.patches
        finish_patches(
            patches.vertex_count, self._still, state.position, state.displacement, self._expected,
            patches.count, patches.first_corner, patches.corners, *self._fitted, self._motion, self._change,
            int(is_changed), self._astray, negligible, MARGIN * 2.0 * self._half_thickness, self._half_thickness,
            self._margin, self._more, self._spent, self.count, self.pairs, self.approach, self._slack,
        )  # fmt: skip
