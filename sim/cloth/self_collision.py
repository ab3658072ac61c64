"""Cloth against cloth: which elements may meet, kept in a list for as long as motion allows."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cloth.proximity_contacts import ContactList
from sim.cloth.self_collision_kernels import (
    enclose_elements,
    find_near_pairs,
    gather_half_edges,
    pair_edges,
    pair_vertices_with_triangles,
    range_of_vectors,
)
from sim.cloth.self_collision_motion import CELL_IN_EDGES, LocalMotion
from sim.cloth.spatial_hash import SpatialHash

if TYPE_CHECKING:
    from sim.cloth.state import ClothState

REACH_IN_EDGES = 0.6
LEAST_SKIN_IN_EDGES = 0.2
"""How far the list of pairs reaches, and at least farther than the thickness, in mean edges, if motion does not ask for
more: to last for many substeps at rest, but not list the neighbours in flat cloth, 0.6 mean edges and more off."""

SKIN_IN_MOTIONS = 4.5
"""Least skin in motions of the substep, of cloth against cloth nearby; so that the list lasts for two."""

SUBSTEPS_OF_LIST = 4.0
"""How many substeps' motion of the whole cloth the coarse cells allow for."""

GROWTH = 1.5
MAX_PAIRS = 2**28
"""Most pairs of a list: 5 GiB on the device; so many mean that the step is far too large."""


class PairList:
    """Pairs of elements; grows when it must.

    Attributes:
        count: number of pairs.
        vertices: a vertex and a triangle's corners, or the ends of two edges, (capacity,) of 4-vectors.
        wanted: distance that they keep [m], (capacity,).
    """

    def __init__(self, capacity: int) -> None:
        self.count = 0
        self._allocate(capacity)

    def fill(self, search, *arguments: object) -> None:
        """Run a search that appends pairs, again with more room where there was too little."""
        found = search(*arguments, self.vertices, self.wanted, self._counter, self._capacity)
        if found < 0 or found > MAX_PAIRS:
            raise OverflowError(f"more than {MAX_PAIRS} pairs of cloth elements are near each other; lower the step")
        if found > self._capacity:
            self._allocate(int(GROWTH * found))
            search(*arguments, self.vertices, self.wanted, self._counter, self._capacity)
        self.count = int(found)

    def _allocate(self, capacity: int) -> None:
        self._capacity = capacity
        self.vertices = ti.Vector.ndarray(4, ti.i32, capacity)
        self.wanted = ti.ndarray(ti.f32, capacity)
        self._counter = ti.ndarray(ti.i32, 1)


class SelfCollision:
    """Finds the pairs of cloth elements, of one cloth or several, that are near each other.

    Every crossing of two triangles without a common corner, or with one, begins with a vertex that meets a triangle of
    which it is no corner, or with two edges without a common vertex that meet; so these are all pairs. They are found
    by a spatial hash within thickness + skin, and listed until motion, apart from that in common, has used the skin up.
    What is found in the list does not depend on when it was made.

    Attributes:
        with_triangles, of_edges: the listed pairs.
        thickness: the largest [m].
        mean_edge: at rest [m].
        searches: how often pairs were searched for since `forget`.

    Args:
        state: the cloths; a triangle without a common corner must not cross another at the start.
    """

    def __init__(self, state: ClothState) -> None:
        self._edge_count, self._triangle_count = len(state.host.edges), len(state.host.triangles)
        self._edge_hash = SpatialHash(self._edge_count)
        self._triangle_hash = SpatialHash(self._triangle_count)
        self._edge_spheres = ti.Vector.ndarray(4, ti.f32, self._edge_count)
        self._triangle_spheres = ti.Vector.ndarray(4, ti.f32, self._triangle_count)
        self._half_edges = ti.Vector.ndarray(3, ti.f32, self._edge_count)
        self._rest = ti.Vector.ndarray(3, ti.f32, state.vertex_count)
        self._rest.from_numpy(state.host.position.astype(np.float32))
        self._motion = LocalMotion(state.vertex_count)
        self._collides = ti.ndarray(ti.i32, len(state.names))
        self.with_triangles = PairList(4 * state.vertex_count)
        self.of_edges = PairList(4 * self._edge_count)
        edges = state.host.position[state.host.edges]
        self.mean_edge = float(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).mean())
        self.forget(state)

    def forget(self, state: ClothState) -> None:
        """Search anew at the next substep; thicknesses and flags may have changed."""
        self.searches = 0
        self._left = self._left_of_whole = -math.inf
        self.thickness = float(state.thickness.to_numpy().max())
        self._collides.from_numpy(np.array(state.self_collision, dtype=np.int32))

    def prepare(self, state: ClothState, whole: float) -> None:
        """Have all pairs listed that vertices can bring within their thickness, or together, in this substep.

        Args:
            state: in a substep.
            whole: how far vertices get apart from their common motion [m].
        """
        if self._left > 0.0 and self._motion.of(state.displacement) <= self._left and whole <= self._left_of_whole:
            return
        edge = self.mean_edge
        enclosed = self._enclose(state)
        # Elements with vertices in cells that are no neighbours are at least a cell less their own sizes apart.
        between = 2.0 * (enclosed[0] + enclosed[1]) + self.thickness
        self._motion.place(state.position, max(CELL_IN_EDGES * edge, between + SUBSTEPS_OF_LIST * whole))
        least = max(REACH_IN_EDGES * edge - self.thickness, LEAST_SKIN_IN_EDGES * edge)
        skin = max(least, SKIN_IN_MOTIONS * self._motion.of(state.displacement))
        self._search(state, self.thickness + skin, *enclosed)
        self._left, self._left_of_whole = 0.5 * skin, 0.5 * (self._motion.cell_size - between)

    def covers(self, state: ClothState, whole: float) -> bool:
        """Whether all pairs are listed that the displacements, as they are now, can bring together."""
        allowance = 0.5 * self.thickness
        return self._motion.of(state.displacement) < self._left + allowance and whole < self._left_of_whole + allowance

    def follow(self, state: ClothState, whole: float) -> None:
        """Note how far vertices get at most in the substep, apart from their common motion [m]."""
        self._left -= self._motion.of(state.displacement)
        self._left_of_whole -= whole

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
                pairs.vertices, pairs.wanted, pairs.count, are_edges,
                state.position, state.displacement, state.friction, margin, recovery, *contacts.found_arrays,
            )  # fmt: skip
        return int(found)

    def _enclose(self, state: ClothState) -> tuple[float, float]:
        """Spheres around edges and triangles where they are now; the largest radius of each [m]."""
        largest_edge, largest_triangle = enclose_elements(
            state.position, state.edges, self._edge_count, state.triangles, self._triangle_count,
            self._edge_spheres, self._triangle_spheres,
        )  # fmt: skip
        return float(largest_edge), float(largest_triangle)

    def _search(self, state: ClothState, radius: float, largest_edge: float, largest_triangle: float) -> None:
        self.searches += 1
        about = (state.position, self._rest, state.thickness, state.body, self._collides)
        cell_size = largest_triangle + radius
        spheres = self._triangle_hash
        spheres.sort(self._triangle_spheres, self._triangle_count, cell_size)
        self.with_triangles.fill(
            pair_vertices_with_triangles, state.vertex_count, *about, state.triangles,
            spheres.spheres, spheres.index, spheres.slot_start, spheres.mask, 1.0 / cell_size, radius,
        )  # fmt: skip
        cell_size = 2.0 * largest_edge + radius
        spheres = self._edge_hash
        spheres.sort(self._edge_spheres, self._edge_count, cell_size)
        gather_half_edges(state.position, state.edges, spheres.index, self._edge_count, self._half_edges)
        self.of_edges.fill(
            pair_edges, self._edge_count, *about, state.edges, self._half_edges,
            spheres.spheres, spheres.index, spheres.slot_start, spheres.mask, 1.0 / cell_size, radius,
        )  # fmt: skip


def half_range(vectors: ti.Ndarray, count: int) -> tuple[float, float]:
    """How far vectors differ from a common one at most, by the diagonal of half their box; and their largest length.

    Both are upper bounds, the same whatever the order of the vectors.
    """
    ends = np.array(range_of_vectors(vectors, count)[:6], dtype=np.float64)
    if not count:
        return 0.0, 0.0
    half = 0.5 * np.linalg.norm(ends[:3] + ends[3:])
    return float(half), float(np.linalg.norm(np.maximum(np.abs(ends[:3]), np.abs(ends[3:]))))
