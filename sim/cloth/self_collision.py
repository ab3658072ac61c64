"""Cloth against cloth: which elements may meet, kept in a list for as long as motion allows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cloth.patch_pairs import PairList, PatchPairs
from sim.cloth.patches import Patches
from sim.cloth.proximity_contacts import ContactList
from sim.cloth.self_collision_kernels import (
    enclose_edges,
    find_near_pairs,
    pair_edges,
    pair_vertices_with_triangles,
    range_of_vectors,
)

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

REACH_IN_EDGES = 0.6
LEAST_SKIN_IN_EDGES = 0.15
"""How far lists of pairs reach, and at least farther than the thickness, in mean edges, if motion does not ask for
more: to last for many substeps at rest, but not list the neighbours in flat cloth, 0.6 mean edges and more off."""

SUBSTEPS_OF_PATCHES = 22.0
"""How many substeps' motion of the whole cloth the list of pairs of patches allows for."""

NEGLIGIBLE = 0.01
"""Part of the thickness that contacts may add to the motion of a substep without it being looked at anew."""


class SelfCollision:
    """Finds the pairs of cloth elements, of one cloth or several, that are near each other.

    Every crossing of two triangles without a common corner, or with one, begins with a vertex that meets a triangle of
    which it is no corner, or with two edges without a common vertex that meet; so these are all pairs. Patches of some
    twenty triangles that may meet within some substeps are paired first; each pair of patches has a list of its
    elements within thickness + skin, which holds until their motion, apart from rigid motion in common, has used the
    skin up. What is found in the lists does not depend on when they were made.

    Attributes:
        with_triangles, of_edges: the listed pairs.
        thickness: the largest [m].
        mean_edge: at rest [m].
        searches: how many pairs of patches were searched since `forget`, over the number of patches.

    Args:
        state: the cloths; a triangle without a common corner must not cross another at the start.
    """

    def __init__(self, state: ClothState) -> None:
        self._patches = Patches(state.host)
        self._met = PatchPairs(self._patches)
        self._rest = ti.Vector.ndarray(3, ti.f32, state.vertex_count)
        self._rest.from_numpy(state.host.position.astype(np.float32))
        self._half_edges = ti.Vector.ndarray(3, ti.f32, max(state.edge_count, 1))
        self._edge_spheres = ti.Vector.ndarray(4, ti.f32, max(state.edge_count, 1))
        self._collides = ti.ndarray(ti.i32, len(state.names))
        self.with_triangles = PairList(are_edges=False, capacity=state.vertex_count, pieces=self._met.capacity)
        self.of_edges = PairList(are_edges=True, capacity=state.edge_count, pieces=self._met.capacity)
        edges = state.host.position[state.host.edges]
        self.mean_edge = float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).mean())
        self.forget(state)

    def forget(self, state: ClothState) -> None:
        """Search anew at the next substep; thicknesses and flags may have changed."""
        self._searched = 0
        self._used, self._added, self._reach = 0.0, 0.0, -math.inf
        self.thickness = float(state.thickness.to_numpy().max())
        self._collides.from_numpy(np.array(state.self_collision, dtype=np.int32))

    @property
    def searches(self) -> float:
        """How often the elements of a patch were searched since `forget`, on average."""
        return self._searched / max(self._patches.count, 1)

    def prepare(self, state: ClothState, whole: float, margin: float) -> None:
        """Have all pairs listed that vertices can bring within their thickness, or together, in this substep.

        Args:
            state: in a substep.
            whole: how far vertices get apart from their common motion [m].
            margin: how far each may be displaced beyond its displacement now [m]; pairs that are not listed come no
                nearer than a thickness without that, and do not meet with it.
        """
        self._met.enclose(state)
        self._met.fit(state)
        nearer, more = 2.0 * whole, max(2.0 * margin - self.thickness, 0.0)
        is_new = self._used + nearer + more >= self._reach
        if is_new:
            self._pair_patches(nearer, more)
        self._search(state, nearer, more, is_new=is_new)

    def follow(self, state: ClothState, whole: float, change: float) -> None:
        """A substep is over.

        Args:
            state: at the end of its displacements.
            whole: as in the last `prepare`.
            change: how far vertices were displaced beyond their displacements there at most [m].
        """
        self._added = 2.0 * change
        if self._added > NEGLIGIBLE * self.thickness:
            self._met.fit(state)
            self._met.measure(2.0 * whole + self._added, self._used)
            self._met.use(0.0)
        else:
            self._met.use(self._added)
        self._used += 2.0 * whole + self._added

    def find(self, state: ClothState, contacts: ContactList, margin: float, recovery: float) -> int:
        """Append the listed pairs that are too near, get there, or might cross; the number of contacts then, or needed.

        Args:
            state: in a substep.
            contacts: the list.
            margin: how far vertices may be displaced beyond their displacements now [m].
            recovery: share of a missing distance that the substep gives back [-].
        """
        found = 0
        for pairs, are_edges in ((self.with_triangles, False), (self.of_edges, True)):
            found = find_near_pairs(
                pairs.vertices, pairs.wanted, pairs.patches, self._met.approach, pairs.end, are_edges,
                state.position, state.displacement, state.friction, margin, recovery, *contacts.found_arrays,
            )  # fmt: skip
        return int(found)

    def _pair_patches(self, nearer: float, more: float) -> None:
        """List the pairs of patches that can meet within some substeps of this motion."""
        self._used, self._reach = 0.0, SUBSTEPS_OF_PATCHES * (nearer + self._added) + self.mean_edge + more
        room = self._met.capacity
        self._met.meet(self.thickness + self._reach, self._collides)
        if self._met.capacity > room:
            for pairs in (self.with_triangles, self.of_edges):
                pairs.set_pieces(self._met.capacity)

    def _search(self, state: ClothState, nearer: float, more: float, *, is_new: bool) -> None:
        """Search the pairs of patches that have to be."""
        met, patches, edge = self._met, self._patches, self.mean_edge
        if is_new:
            self.with_triangles.clear()
            self.of_edges.clear()
        least_skin = max(REACH_IN_EDGES * edge - self.thickness, LEAST_SKIN_IN_EDGES * edge)
        count = met.age(self.thickness, least_skin, nearer, more, self._used, is_new=is_new)
        if not count:
            return
        self._searched += count
        where = (met.pairs, met.low, met.high, met.reach)
        triangles = (state.position, patches.first_vertex, patches.vertices, patches.first_triangle, patches.triangles)
        edges = (patches.first_edge, patches.edges, self._half_edges, self._edge_spheres)
        enclose_edges(state.edge_count, state.position, *edges[1:])
        self.with_triangles.fill(
            pair_vertices_with_triangles, state, self._rest, met.expired, count, *where, *triangles
        )
        self.of_edges.fill(pair_edges, state, self._rest, met.expired, count, *where, *edges)


def half_range(vectors: ti.Ndarray, count: int) -> tuple[float, float]:
    """How far vectors differ from a common one at most, by the diagonal of half their box; and their largest length.

    Both are upper bounds, the same whatever the order of the vectors.
    """
    ends = np.array(range_of_vectors(vectors, count)[:6], dtype=np.float64)
    if not count:
        return 0.0, 0.0
    half = 0.5 * np.linalg.norm(ends[:3] + ends[3:])
    return float(half), float(np.linalg.norm(np.maximum(np.abs(ends[:3]), np.abs(ends[3:]))))
