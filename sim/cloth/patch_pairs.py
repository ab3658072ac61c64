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
    Four,
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
    Two,
)
from sim.cloth.near_pairs import NEVER, carry_pieces, keep_pairs
from sim.cloth.patch_motion_kernels import (
    LARGEST_STILL,
    end_contacts,
    look_at_patches,
    merge_boxes,
    pair_patches,
    place_leaves,
    sort_known,
)
from sim.cloth.patches import Patches
from sim.core.bundles import with_room
from sim.core.reductions import LaneReduction
from sim.core.scheduling import workers_for

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
    """Pairs of elements, those of each pair of patches in pieces of their own; grows when it must.

    Attributes:
        on_device: the list for kernels.
        capacity: places of pairs.

    Args:
        capacity: pairs of elements to start with.
        met: pairs of patches.
    """

    def __init__(self, *, capacity: int, met: int) -> None:
        self._ends, self._taken = ti.ndarray(ti.i32, 2), ti.ndarray(ti.i32, 1)
        self.capacity = capacity
        self.on_device = PairPieces(*self._room_for_pieces(met), *_room_for_pairs(capacity))
        self._spare = PairPieces(*self._room_for_pieces(met), *_room_for_pairs(1))

    def _room_for_pieces(self, met: int) -> tuple[ti.Ndarray, ...]:
        """The first `OF_PIECES` arrays for so many pairs of patches, of which nothing is listed."""
        piece_due = ti.ndarray(ti.f32, 2 * met)
        piece_due.fill(NEVER)
        return ti.ndarray(Four, 2 * met), piece_due, ti.ndarray(ti.i32, 2 * met), self._ends

    def set_pieces(self, met: int) -> None:
        """Make room for the pieces of so many pairs of patches, all empty."""
        self._ends.fill(0)
        self.on_device = PairPieces(*self._room_for_pieces(met), *self.on_device[OF_PIECES:])
        self._spare = PairPieces(*self._room_for_pieces(met), *self._spare[OF_PIECES:])

    def carry(self, count: int, carried: ti.Ndarray, met: int) -> None:
        """Follow pairs of patches to their new numbers, with their pieces.

        Args:
            count: how many there are now.
            carried: their numbers before, or -1, (count,).
            met: most of them.
        """
        # Two sets of arrays in turn: new ones would have all launches prepared anew.
        before, now = self.on_device, self._spare
        if now.pieces.shape[0] < 2 * met:
            now = PairPieces(*self._room_for_pieces(met), *now[OF_PIECES:])
        if now.pairs.shape[0] < self.capacity:
            now = PairPieces(*now[:OF_PIECES], *_room_for_pairs(self.capacity))
        self.on_device, self._spare = now, before
        carry_pieces(2 * count, workers_for(count), self._taken, carried, before, now)

    def reach_to(self, end: int) -> bool:
        """Whether pieces up to this place did not fit, so that their search has to go on; now there is room, and what
        was listed is kept.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        if end < 0 or end > MAX_PAIRS:
            raise OverflowError(TOO_MANY)
        if end <= self.capacity:
            return False
        self.resize(int(GROWTH * end))
        return True

    def resize(self, capacity: int) -> None:
        """Have so many places, with what they hold."""
        kept, before = min(self.capacity, capacity), self.on_device
        self.capacity, self.on_device = capacity, PairPieces(*before[:OF_PIECES], *_room_for_pairs(capacity))
        keep_pairs(kept, before, self.on_device)


OF_PIECES = 4
"""How many of the arrays of `PairPieces`, the first ones, are of pieces; others are of pairs."""


def _room_for_pairs(capacity: int) -> tuple[ti.Ndarray, ...]:
    """Pairs, wanted, due."""
    return ti.ndarray(Four, capacity), ti.ndarray(ti.f32, capacity), ti.ndarray(ti.f32, capacity)


class PatchPairs:
    """The pairs of patches that may meet within some substeps, and how much nearer each may come unsearched.

    Attributes:
        on_device: the pairs for kernels.
        count: how many there are.
        capacity: room for so many.
        bounds: boxes around patches at the last `look`, and the rigid motion of each in the substep.
        budget: how far they move, and may be displaced by contacts.
        carried: numbers that pairs had before the last `meet`, or -1, (count,).
        counters: of `look_at_patches` and `end_contacts`.
        expired_count, due_count: how many pairs have to be searched, and have elements that have to be looked at.

    Args:
        patches: of the cloths.
    """

    def __init__(self, patches: Patches) -> None:
        self.patches = patches
        m = patches.count
        motion = with_room(PatchMotion, m)
        self.bounds: PatchBounds = with_room(PatchBounds, m, motion=motion)
        self.budget: PatchBudget = with_room(PatchBudget, m)
        self._expected = ti.Vector.ndarray(3, ti.f32, patches.vertex_count)
        self._tree: BoxTree = with_room(BoxTree, 2 * patches.leaves, leaves=patches.leaves)
        self._moving = MovingPatches(patches.corner_lists, self.bounds, self.budget)
        self.counters: Counters = with_room(Counters, 3)
        self._first_known = ti.ndarray(ti.i32, 2 * max(m, 1))
        self._maxima = LaneReduction(maxima=7, sums=0)
        self._astray, self._half_thickness, self._still, self._fits = 0.0, 0.0, 0.0, True
        self.due_count = self.expired_count = 0
        self._needed = ti.ndarray(ti.i32, max(m, 1))
        self._allocate(8 * max(m, 1))

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.on_device: PatchPairArrays = with_room(PatchPairArrays, capacity, count=0, needed=self._needed)
        self._spare = ti.ndarray(Two, capacity), ti.ndarray(ti.f32, capacity)
        self.carried, self._known = (ti.ndarray(ti.i32, capacity) for _ in range(2))

    @property
    def count(self) -> int:
        """Number of pairs of patches."""
        return int(self.on_device.count)

    def _tracked(self, state: ClothState) -> TrackedNodes:
        return TrackedNodes(state.position, state.displacement, self._expected)

    def set_margin(self, thickness: float, *, fits: bool = True) -> None:
        """Allow contacts to displace vertices by half a thickness [m], whatever they did before.

        Without pairs of patches nothing `fits`: bodies do with boxes of patches and of their displacements, and
        vertices are neither tested nor followed.
        """
        self._fits = fits
        self._half_thickness, self._still = 0.5 * thickness, STILL * thickness if fits else LARGEST_STILL
        self.budget.margin.fill(MARGIN * thickness)
        self.budget.more.fill(max(MARGIN * thickness - self._half_thickness, 0.0))

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
        known_count = self.count if keeps else 0
        if not keeps:
            self._astray = 0.0
        place_leaves(
            patches.count,
            self.bounds.low,
            self.bounds.high,
            self.budget,
            *SUBSTEPS_OF_PATCHES,
            PATCH_REACH_IN_EDGES * edge,
            0.5 * edge,
            0.5 * thickness,
            tree,
        )
        first = patches.leaves
        while first := first // 2:
            merge_boxes(first, tree)
        before = self.on_device.pairs, self.on_device.slack
        known = KnownPairs(self._first_known, self._known, *before)
        sort_known(known_count, patches.count, known, self.counters.found)
        pairs, slack = self._spare
        self.on_device, self._spare = self.on_device._replace(pairs=pairs, slack=slack), before
        while True:
            found = pair_patches(
                patches.count,
                workers_for(patches.count),
                self.counters.taken,
                tree,
                patches.cloth,
                collides,
                known,
                self.on_device,
                self.carried,
                self.counters.found,
                self.capacity,
            )
            if found < 0 or found > MAX_PAIRS:
                raise OverflowError(TOO_MANY)
            if found <= self.capacity:
                break
            self._allocate(int(GROWTH * found))
        self.on_device = self.on_device._replace(count=int(found))
        return keeps

    def age(self, state: ClothState, ageing: Ageing) -> int:
        """Find which pairs have to be searched in this substep, and how far each; returns how many there are.

        Args:
            state: at the start of the substep.
            ageing: how; `PairPieces.piece_due` is `NEVER` after this where a pair is due.
        """
        self._look(state, 0, ageing)()
        return self.expired_count

    def _look(self, state: ClothState, vertex_count: int, ageing: Ageing | None) -> Callable[[], tuple[float, bool]]:
        """Look at the patches unless there are no vertices, then age the pairs unless nothing is said about that."""
        patches, looks_at_patches = self.patches, vertex_count > 0
        vertex_count = vertex_count if self._fits else 0
        asked = look_at_patches.later(
            vertex_count,
            self._tracked(state),
            self._maxima.over(vertex_count),
            self._astray,
            self._still,
            self._moving,
            self.on_device,
            ageing or Ageing(0.0, 0.0, self.on_device.left),
            (workers_for(patches.count) if looks_at_patches else 0, workers_for(self.count) if ageing else 0),
            self.counters,
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
            is_changed: whether contacts changed displacements.
        """
        patches, half = self.patches, self._half_thickness
        return end_contacts.later(
            count if self._fits else 0,
            contacts.found,
            TestedContacts(contacts.impulses().impulse, state.inverse_mass, state.thickness, contacts.crossing),
            patches.vertex_count if self._fits else 0,
            self._tracked(state),
            predicted,
            self._moving,
            SubstepEnd(int(is_changed), self._astray, MARGIN * 2.0 * half, half),
            self.on_device,
            (is_changed * workers_for(patches.count), workers_for(patches.count), workers_for(self.count)),
            self.counters,
        )
