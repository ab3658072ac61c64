"""Lists of near elements for each pair of patches, searched anew where and when motion has used them up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cloth.bundles import (
    Ageing,
    BoxTree,
    Counters,
    KnownPairs,
    MovingPatches,
    PairPieces,
    PatchBounds,
    PatchBudget,
    PatchMotion,
    PatchPairArrays,
    SubstepEnd,
    TestedContacts,
    TrackedNodes,
)
from sim.cloth.contact_end import end_contacts
from sim.cloth.loop_costs import NODE_NS
from sim.cloth.patch_motion_kernels import (
    look_at_patches,
    merge_boxes,
    pair_patches,
    place_leaves,
    sort_known,
)
from sim.cloth.patches import Patches
from sim.cloth.self_collision_kernels import NEVER, carry_pieces
from sim.core.reductions import LaneReduction
from sim.core.scheduling import is_short, workers_for

if TYPE_CHECKING:
    from sim.cloth.proximity_contacts import ContactList
    from sim.cloth.state import ClothState

GROWTH = 1.5
MAX_PAIRS = 2**28
"""Most pairs of a list: 6 GiB on the device, and as much again while they are carried over. So many mean that the step
is far too large."""

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
        vertices: a vertex and a triangle's corners, or the ends of two edges, (capacity,) ivec4.
        wanted: distance that they keep [m], (capacity,); `UNKNOWN` until they have come so near that it matters.
        due: they are looked at when `PatchPairs.left` is not above it [m], (capacity,).
        pieces: first place of each piece, places, and how many of them are taken, (pairs of patches,) ivec4.
        piece_due: the largest `due` of each piece [m]; `NEVER` where nothing is listed.
        capacity: places of pairs.
        again: numbers of the pieces that were too short.

    Args:
        capacity: pairs of elements to start with.
        pieces: pairs of patches.
        ends: of all lists, on the device.
        number: of this one.
    """

    def __init__(self, *, capacity: int, pieces: int, ends: ti.Ndarray, number: int) -> None:
        self._ends, self._number = ends, number
        self._taken = ti.ndarray(ti.i32, 1)
        self._allocate(capacity)
        self.set_pieces(pieces)

    @property
    def on_device(self) -> PairPieces:
        """The list for kernels."""
        return PairPieces(self.pieces, self.piece_due, *self._listed, self.again)

    @property
    def _listed(self) -> tuple[ti.Ndarray, ...]:
        return self.vertices, self.wanted, self.due

    def set_pieces(self, capacity: int) -> None:
        """Make room for the pieces of so many pairs of patches, all empty."""
        self.end = 0
        self._ends.fill(0)
        self.pieces, self.piece_due, self.again = _room_for_pieces(capacity)
        self._spare_pieces = _room_for_pieces(capacity)

    def carry(self, count: int, carried: ti.Ndarray, capacity: int) -> None:
        """Follow pairs of patches to their new numbers, with their pieces.

        Args:
            count: how many there are now.
            carried: their numbers before, or -1, (count,).
            capacity: most of them.
        """
        # Two sets of arrays in turn: new ones would have all launches prepared anew.
        before = self.on_device
        pieces, listed = (self.pieces, self.piece_due, self.again), self._listed
        if self._spare_pieces[0].shape[0] < capacity:
            self._spare_pieces = _room_for_pieces(capacity)
        if self._spare[0].shape[0] < self.capacity:
            self._spare = _room_for_pairs(self.capacity)
        self.pieces, self.piece_due, self.again = self._spare_pieces
        self.vertices, self.wanted, self.due = self._spare
        self._spare_pieces, self._spare = pieces, listed
        self.end = int(
            carry_pieces(
                count, workers_for(count), self._taken, carried, before, self.on_device, self._ends, self._number
            )
        )

    def reach_to(self, end: int) -> bool:
        """Whether pieces up to this place did not fit; now there is room.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        if end < 0 or end > MAX_PAIRS:
            raise OverflowError(TOO_MANY)
        self.end, fits = end, end <= self.capacity
        if not fits:
            self._grow(int(GROWTH * end))
        return not fits

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.vertices, self.wanted, self.due = _room_for_pairs(capacity)
        self._spare = _room_for_pairs(1)

    def _grow(self, capacity: int) -> None:
        """Make room for so many pairs, and keep those that are listed: when lists grow shows in no search after it."""
        old, before = self.capacity, self._listed
        self._allocate(capacity)
        for source, target in zip(before, self._listed, strict=True):
            values = source.to_numpy()
            target.from_numpy(np.concatenate([values, np.zeros((capacity - old, *values.shape[1:]), values.dtype)]))


def _room_for_pairs(capacity: int) -> tuple[ti.Ndarray, ...]:
    """Arrays of `PairList`: vertices, wanted, due."""
    return ti.Vector.ndarray(4, ti.i32, capacity), *(ti.ndarray(ti.f32, capacity) for _ in range(2))


def _room_for_pieces(capacity: int) -> tuple[ti.Ndarray, ...]:
    """Arrays of `PairList`: pieces, all empty, when they are due, numbers of those that are searched again."""
    pieces, piece_due = ti.Vector.ndarray(4, ti.i32, capacity), ti.ndarray(ti.f32, capacity)
    pieces.fill(0)
    piece_due.fill(NEVER)
    return pieces, piece_due, ti.ndarray(ti.i32, capacity)


def _room_for_patch_pairs(capacity: int) -> tuple[ti.Ndarray, ti.Ndarray]:
    """Arrays of `PatchPairs`: pairs, slack."""
    return ti.Vector.ndarray(2, ti.i32, capacity), ti.ndarray(ti.f32, capacity)


class PatchPairs:
    """The pairs of patches that may meet within some substeps, and how much nearer each may come unsearched.

    Attributes:
        count: number of pairs of patches.
        pairs: their numbers, the smaller first, (count,) ivec2.
        bounds: boxes around patches at the last `look`, and the rigid motion of each in the substep.
        expired: numbers of the pairs to be searched; `needed` is 1 for their patches, (m,).
        due: numbers of the pairs of which elements have to be looked at, `due_count` of them.
        approach: how much nearer points of a pair come at most in this substep [m], (count,); `allowed` how much
            contacts may add to it.
        slack: how much nearer elements of a pair may come that are not listed [m], (count,); `left` how much of it
            those may use up that are, until they are due.
        carried: numbers that pairs had before the last `meet`, or -1, (count,).
        counters: of `look_at_patches` and `end_contacts`.
        reach: how far to search for the elements of each pair [m], (count,).

    Args:
        patches: of the cloths.
    """

    def __init__(self, patches: Patches) -> None:
        self.patches = patches
        m = max(patches.count, 1)
        low, high, *fitted = (ti.Vector.ndarray(3, ti.f32, m) for _ in range(5))
        self.bounds = PatchBounds(low, high, PatchMotion(*fitted, *(ti.ndarray(ti.f32, m) for _ in range(2))))
        self._budget = PatchBudget(*(ti.ndarray(ti.f32, m) for _ in PatchBudget._fields))
        self._expected = ti.Vector.ndarray(3, ti.f32, patches.vertex_count)
        self._tree = BoxTree(patches.leaves, *(ti.Vector.ndarray(3, ti.f32, 2 * patches.leaves) for _ in range(2)))
        self._moving = MovingPatches(patches.corner_lists, self.bounds, self._budget)
        self._counter, self._taken = (ti.ndarray(ti.i32, 3) for _ in range(2))
        self.counters = Counters(self._taken, self._counter)
        self._first_known = ti.ndarray(ti.i32, 2 * m)
        self.needed = ti.ndarray(ti.i32, m)
        self.needed.fill(0)
        self._maxima = LaneReduction(maxima=7, sums=0)
        self._astray, self._half_thickness, self._still = 0.0, 0.0, 0.0
        self.count = self.due_count = self.expired_count = 0
        self._is_short = is_short(patches.vertex_count, NODE_NS)
        self._allocate(8 * m)

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.pairs, self.slack = _room_for_patch_pairs(capacity)
        self._spare = _room_for_patch_pairs(capacity)
        self.expired, self.carried, self._known, self.due = (ti.ndarray(ti.i32, capacity) for _ in range(4))
        self.reach, self._wake, self.left, self.approach, self.allowed = (
            ti.ndarray(ti.f32, capacity) for _ in range(5)
        )

    @property
    def on_device(self) -> PatchPairArrays:
        """The pairs for kernels."""
        return PatchPairArrays(
            count=self.count,
            pairs=self.pairs,
            slack=self.slack,
            wake=self._wake,
            left=self.left,
            approach=self.approach,
            allowed=self.allowed,
            reach=self.reach,
            due=self.due,
            expired=self.expired,
            needed=self.needed,
        )

    def _tracked(self, state: ClothState) -> TrackedNodes:
        return TrackedNodes(state.position, state.displacement, self._expected)

    def set_margin(self, thickness: float) -> None:
        """Allow contacts to displace vertices by half a thickness [m], whatever they did before."""
        self._half_thickness, self._still = 0.5 * thickness, STILL * thickness
        self._budget.margin.fill(MARGIN * thickness)
        self._budget.more.fill(max(MARGIN * thickness - self._half_thickness, 0.0))

    def look(self, state: ClothState, ageing: Ageing | None = None) -> Callable[[], tuple[float, bool]]:
        """Note where patches are and how they move in this substep.

        Asks how far vertices get apart from their common motion [m]; and whether the pairs of patches hold for this
        substep, if they held before. If they are to be aged then, they have been.

        Args:
            state: at the start of the substep.
            ageing: how, if the pairs held before.
        """
        return self._look(state, self.patches.vertex_count, ageing)

    def meet(self, thickness: float, edge: float, collides: ti.Ndarray, *, keeps: bool = False) -> bool:
        """List the pairs of patches that may get within a thickness [m].

        Returns whether what was known about the pairs still holds, which have changed their numbers (`carried`).

        Args:
            thickness: the largest [m].
            edge: the mean one [m].
            collides: which cloths do with themselves, (b,).
            keeps: whether what is known about pairs would hold, as far as this object knows.
        """
        patches, tree = self.patches, self._tree
        keeps = keeps and self._astray < thickness  # else cloth was put elsewhere, and nothing would be left of it
        if not keeps:
            self.count, self._astray = 0, 0.0
        place_leaves(
            patches.count,
            self.bounds.low,
            self.bounds.high,
            self._budget,
            *SUBSTEPS_OF_PATCHES,
            PATCH_REACH_IN_EDGES * edge,
            0.5 * edge,
            0.5 * thickness,
            tree,
        )
        first = patches.leaves
        while first := first // 2:
            merge_boxes(first, tree)
        before = self.pairs, self.slack
        known = KnownPairs(self._first_known, self._known, *before)
        sort_known(self.count, patches.count, known, self._counter)
        self.pairs, self.slack = self._spare
        self._spare = before
        while True:
            found = pair_patches(
                patches.count,
                workers_for(patches.count),
                self._taken,
                tree,
                patches.cloth,
                collides,
                known,
                self.on_device,
                self.carried,
                self._counter,
                self.capacity,
            )
            if found < 0 or found > MAX_PAIRS:
                raise OverflowError(TOO_MANY)
            if found <= self.capacity:
                break
            self._allocate(int(GROWTH * found))
        self.count = int(found)
        return keeps

    def age(self, state: ClothState, ageing: Ageing) -> int:
        """Find which pairs have to be searched in this substep, and how far each; returns how many there are.

        Args:
            state: at the start of the substep.
            ageing: how; `PairList.piece_due` of both lists is `NEVER` after this where a pair is due.
        """
        self._look(state, 0, ageing)()
        return self.expired_count

    def _look(self, state: ClothState, vertex_count: int, ageing: Ageing | None) -> Callable[[], tuple[float, bool]]:
        """Look at the patches unless there are no vertices, then age the pairs unless nothing is said about that."""
        patches = self.patches
        asked = look_at_patches.later(
            vertex_count,
            self._tracked(state),
            self._maxima.over(vertex_count),
            self._astray,
            self._still,
            self._moving,
            self.on_device,
            ageing or Ageing(0.0, 0.0, self.left, self.left),
            (workers_for(patches.count) if vertex_count else 0, workers_for(self.count) if ageing else 0),
            self.counters,
            self._is_short,
        )

        def answer() -> tuple[float, bool]:
            motion, astray, expired, due = asked()
            if vertex_count:
                self._astray = float(np.int32(astray).view(np.float32))
            self.expired_count, self.due_count = max(int(expired), 0), int(due)
            return float(np.int32(motion).view(np.float32)), expired >= 0

        return answer

    def finish(
        self,
        state: ClothState,
        predicted: ti.Ndarray,
        contacts: ContactList,
        count: int,
        negligible: float,
        *,
        is_changed: bool,
    ) -> Callable[[], list[int]]:
        """Test contacts, and if all is well the substep is over: its motion is used up, and what contacts added to it.

        Where they displaced patches farther than allowed for, they may displace these half as far again from now on.
        Asks for what `end_contacts` returns.

        Args:
            state: at the end of its displacements.
            predicted: displacements as contacts were looked for.
            contacts: in the substep.
            count: of those that are tested.
            negligible: what contacts may add without the motion of patches being looked at anew [m].
            is_changed: whether contacts changed displacements.
        """
        patches, half = self.patches, self._half_thickness
        return end_contacts.later(
            count,
            contacts.found,
            TestedContacts(contacts.impulse, state.inverse_mass, state.thickness, contacts.crossing),
            patches.vertex_count,
            self._tracked(state),
            predicted,
            self._moving,
            SubstepEnd(int(is_changed), self._astray, self._still, negligible, MARGIN * 2.0 * half, half),
            self.on_device,
            (is_changed * workers_for(patches.count), workers_for(patches.count), workers_for(self.count)),
            self.counters,
            self._is_short,
        )
