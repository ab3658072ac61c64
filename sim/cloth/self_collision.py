"""Cloth against cloth: which elements may meet, kept in a list for as long as motion allows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import Ageing, Boxes, Counters, Rest
from sim.cloth.near_pairs import find_near_pairs, range_of_vectors
from sim.cloth.patch_pairs import PairList, PatchPairs
from sim.cloth.patches import Patches, blocks_of
from sim.cloth.proximity_contacts import ContactList
from sim.core.arrays import on_device
from sim.core.host_access import copied
from sim.core.reductions import LaneReduction
from sim.core.scheduling import workers_for

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

Array = NDArray[np.float64]
Box = tuple[Array, Array]

REACH_IN_EDGES = 0.85
LEAST_SKIN_IN_EDGES = 0.15
"""How far lists of pairs reach, and at least farther than the thickness, in mean edges, if motion does not ask for
more: to last for many substeps at rest, but not list most neighbours in flat cloth, 0.9 mean edges and more off."""


class SelfCollision:
    """Finds the pairs of cloth elements, of one cloth or several, that are near each other.

    Every crossing of two triangles without a common corner, or with one, begins with a vertex that meets a triangle of
    which it is no corner, or with two edges without a common vertex that meet; so these are all pairs. Patches of some
    thirty triangles that may meet within some substeps are paired first; each pair of patches has a list of its
    elements within thickness + skin, which holds until their motion, apart from rigid motion in common, has used the
    skin up. What is found in the lists does not depend on when they were made.

    Attributes:
        patches: of the cloths.
        patch_pairs: which of them may meet, where they are, and how they move.
        listed: pairs of elements.
        thickness: the largest [m].
        mean_edge: at rest, of all cloths together [m]; how far lists reach.
        coarsest_edge: mean edge of the cloth where that is largest [m]; how far nodes are apart. `longest_edge` of all.
        meets: whether any elements may meet: of several cloths, or of one that collides with itself.
        searches: how many pairs of patches were searched since `begin_frame`, over the number of patches.
        outcome: what the last `finish` answers, on the device.

    Args:
        state: the cloths; a triangle without a common corner must not cross another at the start.
    """

    def __init__(self, state: ClothState) -> None:
        self.patches = Patches(state.host)
        self.patch_pairs = PatchPairs(self.patches)
        self._rest = Rest(state.body, on_device(state.host.position))
        self._blocks = blocks_of(self.patches)
        self._collides = ti.ndarray(ti.i32, len(state.names))
        self._taken = ti.ndarray(ti.i32, 4)
        elements = state.vertex_count + len(state.host.edges.nodes)
        self.listed = PairList(capacity=elements, met=self.patch_pairs.capacity)
        edges = state.host.position[state.host.edges.nodes]
        lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        self.mean_edge, self.longest_edge = float(lengths.mean()), float(lengths.max())
        cloth_of = state.host.body[state.host.edges.nodes[:, 0]]
        self.coarsest_edge = max(float(lengths[cloth_of == cloth].mean()) for cloth in np.unique(cloth_of))
        self._nothing = on_device(np.zeros(3, dtype=np.int32))
        self.outcome = self._nothing
        self.thickness = 0.0
        self._listed_for: tuple[bytes, tuple[bool, ...]] = (b"", ())
        self._is_forgotten, self._is_outrun = True, False
        self.begin_frame(state)

    def forget(self) -> None:
        """Search anew at the next `find`."""
        self._is_forgotten = True

    def begin_frame(self, state: ClothState) -> None:
        """Margins of contacts are what they are at the start of a run, and searches are counted anew.

        Lists are kept, unless thicknesses or flags have changed: no result depends on when they were made.
        """
        self._searched, self._was_changed = 0, False
        thickness = copied(state.thickness)  # of each node, as pairs are listed with the distance that they keep
        listed_for = thickness.tobytes(), state.self_collision
        if listed_for != self._listed_for:
            self._listed_for = listed_for
            self.thickness = float(thickness.max())
            self._collides.from_numpy(np.array(state.self_collision, dtype=np.int32))
            self.forget()
        self.meets = len(state.names) > 1 or any(state.self_collision)
        self.patch_pairs.set_margin(self.thickness, fits=self.meets)

    @property
    def searches(self) -> float:
        """How often the elements of a patch were searched since `begin_frame`, on average."""
        return self._searched / max(self.patches.count, 1)

    def look(self, state: ClothState) -> None:
        """Note how cloth moves in this substep."""
        is_aged = self.meets and not (self._is_forgotten or self._is_outrun)
        self._asked = self.patch_pairs.look(state, self._ageing if is_aged else None)
        self._looked: tuple[float, bool] | None = None
        self._is_searched = False

    def looked(self) -> tuple[float, bool]:
        """How far vertices get apart from their common motion [m]; and whether pairs of patches hold, so that `find`
        could find all. Else it does when it is called again. Where none may meet none is said to move.
        """
        if self._looked is None:
            motion, holds = self._asked()
            self._is_outrun |= not holds
            self._searched += self.patch_pairs.expired_count
            self._looked = (motion, holds) if self.meets else (0.0, True)
        return self._looked

    @property
    def _ageing(self) -> Ageing:
        """How pairs of patches are aged."""
        edge = self.mean_edge
        least_skin = max(REACH_IN_EDGES * edge - self.thickness, LEAST_SKIN_IN_EDGES * edge)
        return Ageing(self.thickness, least_skin, self.listed.on_device.piece_due)

    def warm_up(self) -> None:
        """Compile what carries lists over, and what makes room in them."""
        self.listed.carry(0, self.patch_pairs.carried, self.patch_pairs.capacity)
        self.listed.resize(self.listed.capacity)

    def finish(
        self, state: ClothState, predicted: ti.Ndarray, contacts: ContactList, count: int, *, is_changed: bool
    ) -> Callable[[], list[int]]:
        """See `PatchPairs.finish`."""
        if not (self.meets or is_changed or self._was_changed):
            self.outcome = self._nothing
            return lambda: [0, 0, 0]
        self.outcome = self.patch_pairs.counters.found
        self._was_changed = is_changed
        return self.patch_pairs.finish(state, predicted, contacts, count, is_changed=is_changed)

    def find(self, state: ClothState, contacts: ContactList, recovery: float, *, is_ahead: bool = False) -> None:
        """Append the pairs that are too near, get there, or might cross; after `look`.

        All pairs are listed first that vertices can bring within their thickness, or together, in this substep. Pairs
        that are not listed come no nearer than a thickness without contacts, and do not meet where these displace
        vertices within their margins.

        Args:
            state: in a substep.
            contacts: the list.
            recovery: share of a missing distance that the substep gives back [-].
            is_ahead: not to wait for what `look` has found; if pairs of patches do not hold, nothing is appended.
        """
        met, listed = self.patch_pairs, self.listed
        if not is_ahead or self._is_forgotten or self._is_outrun:
            self.looked()
        if not self.meets:
            return
        if self._is_forgotten or self._is_outrun:
            keeps = met.meet(self.thickness, self.mean_edge, self._collides, keeps=not self._is_forgotten)
            if keeps:
                listed.carry(met.count, met.carried, met.capacity)
            else:
                listed.set_pieces(met.capacity)
            self._is_forgotten = self._is_outrun = False
            self._searched += met.age(state, self._ageing)
            self._looked, self._is_searched = (self.looked()[0], True), False
        if not (is_ahead or met.expired_count or met.due_count):
            return
        find_near_pairs(
            (int(not self._is_searched), listed.capacity, workers_for(1)),
            Counters(self._taken, met.counters.found),
            met.on_device,
            Boxes(met.bounds.low, met.bounds.high),
            self._blocks,
            listed.on_device,
            state.surface,
            self._rest,
            recovery,
            contacts.found,
        )
        self._is_searched = True


def box_of(vectors: ti.Ndarray, first: int, end: int, ends_of: LaneReduction) -> Callable[[], Box]:
    """Asks for middle and half edges of the box around vectors, (3,) each, the same whatever their order.

    Args:
        vectors: of which those from `first` up to `end` are looked at, at least one.
        first, end: numbers.
        ends_of: of six maxima.
    """
    count = end - first
    asked = range_of_vectors.later(vectors, first, count, ends_of.over(count))

    def answer() -> Box:
        ends = ends_of.unpack(asked()).astype(np.float64)
        return 0.5 * (ends[:3] - ends[3:]), 0.5 * (ends[:3] + ends[3:])

    return answer
