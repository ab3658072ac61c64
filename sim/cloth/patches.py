"""Patches: a cloth's triangles in groups that lie together, with their edges and vertices, and a tree over them; bounds
of their elements, laid out so that a processor compares one element with a block of them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import EdgeBlocks, PatchBlocks, PatchLists, PatchNodes, TriangleBlocks
from sim.cloth.state import HostCloths
from sim.core.arrays import on_device
from sim.core.reductions import runs_on_gpu

BLOCK = 16
"""Elements that are compared with one at a time: two instructions of eight lanes, and few places that only fill up."""

FAR = 1.0e9  # coordinate of what is far from everything [m]; the fourth power of a distance to it is finite in float32
NONE = -1  # in the place of a vertex: the block has no element there

TRIANGLES_PER_PATCH, ON_GPU = 32, 24
"""Most triangles of a patch: few enough for all of them to move nearly as one, and enough for one pair of patches to
stand for hundreds of pairs of elements; on a GPU fewer, as the threads of a pair work longer than those of others."""


class Patches:
    """Splits cloths into compact patches, by halving each along its longest extent until it is small.

    Every triangle, edge and vertex belongs to one patch. The m patches are in the order of the halvings, so that a
    binary tree over their numbers is a hierarchy of boxes.

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
    instruction, where it took one after another from arrays of vectors. `NONE` is in places that only fill up.
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
