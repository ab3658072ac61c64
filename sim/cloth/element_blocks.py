"""Bounds of a patch's edges and triangles, laid out so that a processor compares one element with a block of them."""

from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import EdgeBlocks, TriangleBlocks
from sim.cloth.patches import Patches
from sim.cloth.self_collision_kernels import BLOCK, FAR, NONE
from sim.core.arrays import Vectors, on_device
from sim.core.bundles import func


class ElementBlocks:
    """Edges and triangles of each patch in whole blocks, which are filled up with elements that are far from all.

    One array for each component, and blocks of a length that the compiler knows: so it compares eight elements in an
    instruction, where it took one after another from arrays of vectors.

    Attributes:
        edges: first block of each patch, (m + 1,); ends of the edges, (p,) ivec2, `NONE` in places that only fill up;
            then x, y, z of their midpoints, and half their vectors [m], (p,) each.
        triangles: first block of each patch, (m + 1,); corners, (q,) ivec3; then their boxes' lowest x, y, z, and
            highest [m], (q,) each.

    Args:
        patches: of the cloths.
    """

    def __init__(self, patches: Patches) -> None:
        self.edges = EdgeBlocks(*_blocks(patches.edges, patches.first_edge, patches.count))
        self.triangles = TriangleBlocks(*_blocks(patches.triangles, patches.first_triangle, patches.count))


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


@func
def enclose_elements(
    m: ti.i32,
    lane: ti.i32,
    lanes: ti.i32,
    position: Vectors,
    of_edges: EdgeBlocks,
    of_triangles: TriangleBlocks,
):
    """Midpoints of edges and half the vectors along them, and boxes of triangles, of a patch, as one of several
    threads.
    """
    place = of_edges.first_block[m] * BLOCK + lane
    while place < of_edges.first_block[m + 1] * BLOCK:
        middle, half = ti.math.vec3(FAR), ti.math.vec3(0.0)
        if of_edges.edges[place][0] != NONE:
            a, b = position[of_edges.edges[place][0]], position[of_edges.edges[place][1]]
            middle, half = 0.5 * (a + b), 0.5 * (b - a)
        of_edges.mid_x[place], of_edges.mid_y[place], of_edges.mid_z[place] = middle[0], middle[1], middle[2]
        of_edges.half_x[place], of_edges.half_y[place], of_edges.half_z[place] = half[0], half[1], half[2]
        place += lanes
    place = of_triangles.first_block[m] * BLOCK + lane
    while place < of_triangles.first_block[m + 1] * BLOCK:
        low, high = ti.math.vec3(FAR), ti.math.vec3(-FAR)
        corners = of_triangles.triangles[place]
        if corners[0] != NONE:
            a, b, c = position[corners[0]], position[corners[1]], position[corners[2]]
            low, high = ti.min(a, b, c), ti.max(a, b, c)
        of_triangles.low_x[place], of_triangles.low_y[place], of_triangles.low_z[place] = low[0], low[1], low[2]
        of_triangles.high_x[place], of_triangles.high_y[place], of_triangles.high_z[place] = high[0], high[1], high[2]
        place += lanes
