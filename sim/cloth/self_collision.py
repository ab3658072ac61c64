"""Cloth against cloth: which elements may meet, patch by patch, kept in lists that are searched anew where and when
motion has used them up.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import (
    Boxes,
    BoxTree,
    EdgeBlocks,
    Followed,
    Four,
    KnownPairs,
    MovingPatches,
    PairPieces,
    PairSearch,
    PatchBlocks,
    PatchLists,
    PatchMotion,
    PatchNodes,
    PatchPairArrays,
    TestedContacts,
    TriangleBlocks,
    Two,
)
from sim.cloth.contacts import GROWTH, ContactList
from sim.cloth.near_pairs import BLOCK, NEVER, NONE, carry_pieces, find_near_pairs, keep_pairs, range_of_vectors
from sim.cloth.patch_motion_kernels import (
    LARGEST_STILL,
    end_contacts,
    look_at_patches,
    merge_boxes,
    pair_patches,
    place_leaves,
    sort_known,
)
from sim.cloth.state import ClothState, HostCloths
from sim.core.arrays import on_device
from sim.core.bundles import with_room
from sim.core.host_access import copied
from sim.core.reductions import LaneReduction, runs_on_gpu
from sim.core.scheduling import workers_for

TRIANGLES_PER_PATCH, ON_GPU = 32, 24
"""Most triangles of a patch: few enough for all of them to move nearly as one, and enough for one pair of patches to
stand for hundreds of pairs of elements; on a GPU fewer, as the threads of a pair work longer than those of others."""


class Patches:
    """Splits cloths into compact patches, by halving each along its longest extent until it is small.

    Every triangle, edge and vertex belongs to one of the m patches. A binary tree over their numbers is a hierarchy of
    boxes, as they are in the order of the halvings.

    Attributes:
        count: number of patches, m.
        vertex_count: of all patches, n.
        leaves: m rounded up to a power of two.
        lists: elements in the order of the patches.
        corners: all vertices of each patch's triangles, which its edges end at, its own and others.
        cloth: of each patch, (m,).

    Args:
        host: the cloths where they start; every vertex is one of a triangle.
    """

    def __init__(self, host: HostCloths) -> None:
        triangles, edges = host.triangles, host.edges.nodes
        patch = _patch_of_triangles(host)
        self.count = int(patch.max()) + 1 if len(patch) else 0
        self.vertex_count = len(host.position)
        self.leaves = 1 << max(self.count - 1, 0).bit_length()
        order, first_triangle = np.argsort(patch, kind="stable"), _starts(patch, self.count)
        corner_patch, corner = np.unique(np.stack([np.repeat(patch, 3), triangles.ravel()]), axis=1)
        self.corners = PatchNodes(self.count, on_device(_starts(corner_patch, self.count)), on_device(corner))
        # The first patch that a vertex is a corner of owns it, and so an edge: the first with both of its ends in a
        # triangle, as edges are sides of triangles.
        owner = np.full(len(host.position), self.count)
        np.minimum.at(owner, corner, corner_patch)
        own = on_device(_starts(np.sort(owner), self.count)), on_device(np.argsort(owner, kind="stable"))
        edge_owner = np.full(len(edges), self.count)
        np.minimum.at(edge_owner, host.edges.of_side, np.repeat(patch, 3))
        first_edge, in_order = _starts(np.sort(edge_owner), self.count), np.argsort(edge_owner, kind="stable")
        elements = first_edge, edges[in_order], first_triangle, triangles[order]
        self.lists = PatchLists(PatchNodes(self.count, *own), *map(on_device, elements))
        self.cloth = on_device(host.body[triangles[order[first_triangle[:-1]], 0]])


def _patch_of_triangles(host: HostCloths) -> NDArray[np.int64]:
    """Number of the patch of each triangle, (k,)."""
    patch = np.zeros(len(host.triangles), dtype=np.int64)
    centre = host.position[host.triangles].mean(axis=1)
    most, count = ON_GPU if runs_on_gpu() else TRIANGLES_PER_PATCH, 0
    for first, last in zip(host.first_triangle[:-1], host.first_triangle[1:], strict=True):
        halvings = max(int(np.ceil(np.log2(max(last - first, 1) / most))), 0)
        order = np.arange(first, last)
        for level in range(halvings):
            # All parts of a level at once: each is sorted along its own longest extent, and cut in its middle.
            bounds = (last - first) * np.arange(2**level + 1) // 2**level
            part = np.repeat(np.arange(2**level), np.diff(bounds))
            inner = bounds[:-1]
            extent = np.maximum.reduceat(centre[order], inner) - np.minimum.reduceat(centre[order], inner)
            along = centre[order, extent.argmax(axis=1)[part]]
            order = order[np.lexsort((along, part))]
        bounds = (last - first) * np.arange(2**halvings + 1) // 2**halvings
        patch[order] = count + np.repeat(np.arange(2**halvings), np.diff(bounds))
        count += 2**halvings
    return patch


def _starts(patch: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Where each of the patches begins among values in their order; and the number of all, (count + 1,)."""
    starts: NDArray[np.int64] = np.concatenate([[0], np.cumsum(np.bincount(patch, minlength=count))])
    return starts


def blocks_of(patches: Patches) -> PatchBlocks:
    """Edges and triangles of each patch in whole blocks, which are filled up with elements that are far from all.

    One array for each component, and blocks of a length that the compiler knows: so it compares eight elements in an
    instruction. `NONE` is in places that only fill up.
    """
    lists, count = patches.lists, patches.count
    triangles = TriangleBlocks(*_blocks(lists.triangles, lists.first_triangle, count))
    return PatchBlocks(lists.vertices, triangles, EdgeBlocks(*_blocks(lists.edges, lists.first_edge, count)))


def _blocks(elements: ti.Ndarray, first: ti.Ndarray, count: int) -> tuple[ti.Ndarray, ...]:
    """First block of each patch, the elements in their places, and room for six components."""
    numbers, starts = elements.to_numpy(), first.to_numpy()[: count + 1].astype(np.int64)
    blocks: NDArray[np.int64] = np.concatenate([[0], np.cumsum(-(-np.diff(starts) // BLOCK))]).astype(np.int64)
    places = max(int(blocks[-1]), 1) * BLOCK
    padded = np.full((places, numbers.shape[1]), NONE, dtype=np.int32)
    for block, (start, end) in zip(blocks, pairwise(starts), strict=False):
        padded[block * BLOCK : block * BLOCK + end - start] = numbers[start:end]
    return (
        on_device(np.resize(blocks, max(len(blocks), 2))),
        on_device(padded),
        *(ti.ndarray(ti.f32, places) for _ in range(6)),
    )


Array = NDArray[np.float64]
Box = tuple[Array, Array]

REACH_IN_EDGES = 0.85
LEAST_SKIN_IN_EDGES = 0.15
"""How far lists of pairs reach, and at least farther than the thickness, in mean edges, if motion does not ask for
more: to last for many substeps at rest, but not list most neighbours in flat cloth, 0.9 mean edges and more off."""

MARGIN = 0.5
"""How far contacts are expected to push, in thicknesses; where they push farther, pairs are looked at again."""

STILL = 1.0e-3
"""Part of the thickness by which displacements of a patch may differ without a turn being fitted to them: a list lasts
for a hundred substeps even so, and cloth that falls or lies is looked at once instead of twice."""

MAX_PAIRS = 2**28
"""Most pairs of a list: 6 GiB on the device, and as much again while they are carried over. So many mean that the step
is far too large."""

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
        ends, self._taken = ti.ndarray(ti.i32, 2), ti.ndarray(ti.i32, 1)
        self.capacity = capacity
        self.on_device = PairPieces(ends=ends, **_pieces(met), **_places(capacity))
        self._spare = PairPieces(ends=ends, **_pieces(met), **_places(1))

    def set_pieces(self, met: int) -> None:
        """Make room for the pieces of so many pairs of patches, all empty."""
        self.on_device.ends.fill(0)
        self.on_device, self._spare = (each._replace(**_pieces(met)) for each in (self.on_device, self._spare))

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
            now = now._replace(**_pieces(met))
        if now.pairs.shape[0] < self.capacity:
            now = now._replace(**_places(self.capacity))
        self.on_device, self._spare = now, before
        carry_pieces(2 * count, workers_for(count), self._taken, carried, before, now)

    def reach_to(self, end: int) -> bool:
        """Whether pieces up to this place did not fit, so that their search has to go on; now there is room, and what
        was listed is kept.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        if not 0 <= end <= MAX_PAIRS:
            raise OverflowError(TOO_MANY)
        if end <= self.capacity:
            return False
        self.resize(int(GROWTH * end))
        return True

    def resize(self, capacity: int) -> None:
        """Have so many places, with what they hold."""
        kept, before = min(self.capacity, capacity), self.on_device
        self.capacity, self.on_device = capacity, before._replace(**_places(capacity))
        keep_pairs(kept, before, self.on_device)


def _pieces(met: int) -> dict[str, ti.Ndarray]:
    """Room for the pieces of so many pairs of patches, in which nothing is listed."""
    due = ti.ndarray(ti.f32, 2 * met)
    due.fill(NEVER)
    return {"pieces": ti.ndarray(Four, 2 * met), "piece_due": due, "again": ti.ndarray(ti.i32, 2 * met)}


def _places(capacity: int) -> dict[str, ti.Ndarray]:
    """Room for so many pairs of elements."""
    wanted, due = (ti.ndarray(ti.f32, capacity) for _ in range(2))
    return {"pairs": ti.ndarray(Four, capacity), "wanted": wanted, "due": due}


class SelfCollision:
    """Finds the pairs of cloth elements, of one cloth or several, that are near each other.

    These are vertices with triangles of which they are no corner, and edges without a common vertex: each crossing
    begins with a pair of them. Patches that may meet within some substeps are paired first; each pair of patches has a
    list of its elements within thickness + skin, which holds until their motion, apart from rigid motion in common, has
    used the skin up. What is found does not depend on when lists were made. Where nothing may meet, bodies still need
    boxes of patches.

    Attributes:
        patches: of the cloths.
        moving: where patches are, how they move in the substep, and how far contacts may displace them.
        met: the pairs of patches that may meet within some substeps, and how much nearer each may come unsearched.
        carried: numbers that these had before they were last paired, or -1.
        listed: pairs of elements.
        thickness: the largest [m].
        mean_edge: at rest, of all cloths together [m]; how far lists reach.
        coarsest_edge: mean edge of the cloth where that is largest [m]; how far nodes are apart. `longest_edge` of all.
        meets: whether any elements may meet: of several cloths, or of one that collides with itself.
        expired_count, due_count: how many pairs of patches have to be searched, and have elements to be looked at.
        outcome: what the last `finish` answers, on the device.

    Args:
        state: the cloths; a triangle without a common corner must not cross another at the start.
    """

    def __init__(self, state: ClothState) -> None:
        self._state, self.patches = state, Patches(state.host)
        m, n, host = self.patches.count, state.vertex_count, state.host
        self.moving: MovingPatches = with_room(
            MovingPatches,
            m,
            corners=self.patches.corners,
            boxes=with_room(Boxes, m),
            motion=with_room(PatchMotion, m),
        )
        self._expected = ti.Vector.ndarray(3, ti.f32, n)
        self._at_rest, self._blocks = on_device(host.position), blocks_of(self.patches)
        self._tree: BoxTree = with_room(BoxTree, 2 * self.patches.leaves, leaves=self.patches.leaves)
        self._taken, self._found = (ti.ndarray(ti.i32, 4) for _ in range(2))
        self._first_known, self._needed = ti.ndarray(ti.i32, 2 * max(m, 1)), ti.ndarray(ti.i32, max(m, 1))
        self._collides = ti.ndarray(ti.i32, len(state.names))
        self._maxima = LaneReduction(maxima=7, sums=0)
        self._room_for_met(8 * max(m, 1))
        self.listed = PairList(capacity=n + len(host.edges.nodes), met=self._met_capacity)
        edges = host.position[host.edges.nodes]
        lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
        self.mean_edge, self.longest_edge = float(lengths.mean()), float(lengths.max())
        cloth_of = host.body[host.edges.nodes[:, 0]]
        self.coarsest_edge = max(float(lengths[cloth_of == cloth].mean()) for cloth in np.unique(cloth_of))
        self.outcome = self._nothing = on_device(np.zeros(3, dtype=np.int32))
        self.thickness = self._astray = 0.0
        self.due_count = self.expired_count = 0
        self._listed_for: tuple[bytes, tuple[bool, ...]] = (b"", ())
        self._is_forgotten, self._is_outrun = True, False
        self.begin_frame()

    def _room_for_met(self, capacity: int) -> None:
        self._met_capacity = capacity
        kept = {"needed": self._needed, "taken": self._taken, "found": self._found}
        self.met: PatchPairArrays = with_room(PatchPairArrays, capacity, count=0, **kept)
        self._spare = ti.ndarray(Two, capacity), ti.ndarray(ti.f32, capacity)
        self.carried, self._known = (ti.ndarray(ti.i32, capacity) for _ in range(2))

    def forget(self) -> None:
        """Search anew at the next `find`."""
        self._is_forgotten = True

    def begin_frame(self) -> None:
        """Margins of contacts are what they are at the start of a run, and searches are counted anew.

        Lists are kept, unless thicknesses or flags have changed: no result depends on when they were made.
        """
        state = self._state
        self._searched, self._was_changed = 0, False
        thickness = copied(state.thickness)  # of each node, as pairs are listed with the distance that they keep
        listed_for = thickness.tobytes(), state.self_collision
        if listed_for != self._listed_for:
            self._listed_for = listed_for
            self.thickness = float(thickness.max())
            self._collides.from_numpy(np.array(state.self_collision, dtype=np.int32))
            self.forget()
        self.meets = len(state.names) > 1 or any(state.self_collision)
        self.moving.margin.fill(MARGIN * self.thickness)
        self.moving.more.fill(0.0)

    @property
    def searches(self) -> float:
        """How often the elements of a patch were searched since `begin_frame`, on average."""
        return self._searched / max(self.patches.count, 1)

    @property
    def _followed(self) -> Followed:
        nodes = self._state.position, self._state.displacement, self._expected
        return Followed(*nodes, self.moving, self.met, self.thickness, self._astray)

    def look(self) -> None:
        """Note how cloth moves in this substep."""
        is_aged = self.meets and not (self._is_forgotten or self._is_outrun)
        self._asked = self._ask(looks=True, ages=is_aged)
        self._looked: tuple[float, bool] | None = None
        self._is_searched = False

    def _ask(self, *, looks: bool, ages: bool) -> Callable[[], tuple[float, bool]]:
        """Look at the patches, then find which of their pairs have to be searched; either or both.

        Asks how far vertices get apart from their common motion [m], and whether the pairs hold for this substep.
        """
        vertex_count = self._state.vertex_count if looks and self.meets else 0
        edge = self.mean_edge
        asked = look_at_patches.later(
            vertex_count,
            self._maxima.over(vertex_count),
            STILL * self.thickness if self.meets else LARGEST_STILL,
            self._followed,
            max(REACH_IN_EDGES * edge - self.thickness, LEAST_SKIN_IN_EDGES * edge),
            self.listed.on_device.piece_due,
            (looks * workers_for(self.patches.count), ages * workers_for(int(self.met.count))),
        )

        def answer() -> tuple[float, bool]:
            motion, astray, expired, due = asked()
            if vertex_count:
                self._astray = float(np.int32(astray).view(np.float32))
            self.expired_count, self.due_count = max(int(expired), 0), int(due)
            self._searched += self.expired_count
            return float(np.int32(motion).view(np.float32)), expired >= 0

        return answer

    def looked(self) -> tuple[float, bool]:
        """How far vertices get apart from their common motion [m]; and whether pairs of patches hold, so that `find`
        could find all. Else it does when it is called again. Where none may meet none is said to move.
        """
        if self._looked is None:
            motion, holds = self._asked()
            self._is_outrun |= not holds
            self._looked = (motion, holds) if self.meets else (0.0, True)
        return self._looked

    def _pair_patches(self) -> None:
        """List the pairs of patches that may get within a thickness, with what is known of their elements unless that
        is forgotten.

        Raises:
            OverflowError: more pairs than any useful step has.
        """
        patches, tree = self.patches, self._tree
        # If cloth was put elsewhere, nothing would be left of what is known.
        keeps = not self._is_forgotten and self._astray < self.thickness
        place_leaves(self.moving, self.mean_edge, self.thickness, tree)
        first = patches.leaves
        while first := first // 2:
            merge_boxes(first, tree)
        before = self.met.pairs, self.met.slack
        known = KnownPairs(self._first_known, self._known, *before)
        sort_known(int(self.met.count) if keeps else 0, patches.count, known, self._found)
        pairs, slack = self._spare
        self.met, self._spare = self.met._replace(pairs=pairs, slack=slack), before
        while True:
            found = pair_patches(
                patches.count,
                workers_for(patches.count),
                tree,
                patches.cloth,
                self._collides,
                known,
                self.met,
                self.carried,
                self._met_capacity,
            )
            if not 0 <= found <= MAX_PAIRS:
                raise OverflowError(TOO_MANY)
            if found <= self._met_capacity:
                break
            self._room_for_met(int(GROWTH * found))
        self.met = self.met._replace(count=int(found))
        if keeps:
            self.listed.carry(int(found), self.carried, self._met_capacity)
        else:
            self._astray = 0.0
            self.listed.set_pieces(self._met_capacity)

    def warm_up(self) -> None:
        """Compile what carries lists over, and what makes room in them."""
        self.listed.carry(0, self.carried, self._met_capacity)
        self.listed.resize(self.listed.capacity)

    def find(self, contacts: ContactList, recovery: float, *, is_ahead: bool = False) -> None:
        """Append the pairs that are too near, get there, or might cross; after `look`.

        Pairs that are not listed come no nearer than a thickness without contacts, and do not meet where these displace
        vertices within their margins.

        Args:
            contacts: the list.
            recovery: share of a missing distance that the substep gives back [-].
            is_ahead: not to wait for what `look` has found; if pairs of patches do not hold, nothing is appended.
        """
        if not is_ahead or self._is_forgotten or self._is_outrun:
            self.looked()
        if not self.meets:
            return
        if self._is_forgotten or self._is_outrun:
            self._pair_patches()
            self._is_forgotten = self._is_outrun = False
            self._ask(looks=False, ages=True)()
            self._looked, self._is_searched = (self.looked()[0], True), False
        if not (is_ahead or self.expired_count or self.due_count):
            return
        find_near_pairs(
            (int(not self._is_searched), self.listed.capacity, workers_for(1)),
            PairSearch(
                self.met,
                self.moving.boxes,
                self._blocks,
                self.listed.on_device,
                self._state.surface,
                self._state.body,
                self._at_rest,
                recovery,
                contacts.found,
            ),
        )
        self._is_searched = True

    def finish(
        self, predicted: ti.Ndarray, contacts: ContactList, count: int, *, is_changed: bool
    ) -> Callable[[], list[int]]:
        """Test contacts, and if all is well the substep is over: its motion is used up, and what contacts added to it.

        Asks for what `end_contacts` returns.

        Args:
            predicted: displacements as contacts were looked for.
            contacts: in the substep.
            count: of those that are tested.
            is_changed: whether contacts changed displacements.
        """
        if not (self.meets or is_changed or self._was_changed):
            self.outcome = self._nothing
            return lambda: [0, 0, 0]
        self.outcome, self._was_changed = self._found, is_changed
        state, patches = self._state, workers_for(self.patches.count)
        return end_contacts.later(
            count if self.meets else 0,
            contacts.found,
            TestedContacts(contacts.impulses().impulse, state.inverse_mass, state.thickness, contacts.crossing),
            state.vertex_count if self.meets else 0,
            predicted,
            int(is_changed),
            self._followed,
            (is_changed * patches, patches, workers_for(int(self.met.count))),
        )


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
