"""Search of the pairs of patches that need it, and of the listed pairs of elements for contacts, in one launch."""

import taichi as ti

from sim.cloth.bundles import (
    Contacts,
    EdgeBlocks,
    PairPieces,
    PatchNodes,
    PatchPairArrays,
    Surface,
    TriangleBlocks,
)
from sim.cloth.element_blocks import enclose_elements
from sim.cloth.self_collision_kernels import (
    lanes_of_pair,
    lengthen,
    look_at_piece,
    pair_edges,
    pair_vertices_with_triangles,
)
from sim.core.arrays import Integers, Vectors
from sim.core.launch import kernel
from sim.core.reductions import runs_on_gpu
from sim.core.scheduling import begin_sharing, next_item

ENCLOSED_AT_A_TIME, SEARCHED_AT_A_TIME, DUE_AT_A_TIME = 8, 1, 4
"""Patches of which most are not needed, and pairs of patches, that a thread takes at a time: some microseconds."""


@kernel
def find_near_pairs(
    numbers: ti.math.ivec4,
    workers: ti.math.ivec3,
    taken: Integers,
    met: PatchPairArrays,
    needed: Integers,
    low: Vectors,
    high: Vectors,
    vertices: PatchNodes,
    blocks: TriangleBlocks,
    edge_blocks: EdgeBlocks,
    listed: PairPieces,
    listed_edges: PairPieces,
    again: Integers,
    edges_again: Integers,
    ends: Integers,
    surface: Surface,
    cloth: Integers,
    rest: Vectors,
    recovery: ti.f32,
    contacts: Contacts,
):
    """List the elements of the pairs of patches that are `expired`: the vertices of each of two patches with the
    triangles of the other within `reach` [m] of them, and the edges of both within that of each other. Then append the
    listed pairs that are nearer than they shall be, or get there, and those that might cross.

    Pieces that are too short for what is found move to the end of their list, and are searched again. If a list is too
    short for that, nothing else is done: once it is longer, a call that searches no pairs goes on from there.

    Of contacts, the displacement along the line of shortest distance counts. A pair might cross when its vertices,
    displaced as they are now and by contacts besides, come together: then it is watched, `INACTIVE`. They come no
    nearer than by twice their motion against their mean, nor than by the `approach` [m] of their patches; contacts are
    `allowed` so much more [m]. Pairs that have been farther off than their patches have approached since are not even
    looked at.

    Args:
        numbers: of pairs of patches that are searched, and that are due; most pairs of elements of both lists.
        workers, taken: see `sim.core.scheduling`; for patches, for searches, and for pairs that are due.
        met, needed, low, high: all pairs of patches; whether a pair of a patch is searched, 0 after; their boxes [m].
        vertices, blocks, edge_blocks: elements of the patches.
        listed, listed_edges: lists of vertices with triangles, and of edges.
        again, edges_again: get the numbers of their pieces that were too short.
        ends: of both lists; then how many pieces are to be searched again.
        surface, cloth: of all nodes.
        rest: positions of all nodes at rest [m].
        recovery: share of a missing distance that the substep gives back [-].
        contacts: the list; its second and third number become the ends that both lists need.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    count, due_count, enclosing, searching, looking = numbers[0], numbers[1], workers[0], workers[1], workers[2]
    lanes = ti.static(lanes_of_pair())
    if count > 0:
        ends[2], ends[3] = 0, 0
    begin_sharing(taken, 0)
    for worker in range(enclosing):
        item = next_item(-1, worker, taken, 0, ENCLOSED_AT_A_TIME)
        while item < vertices.count + count:
            if item >= vertices.count:
                p = met.expired[item - vertices.count]
                listed.pieces[p][2], listed_edges.pieces[p][2] = 0, 0
            elif needed[item] == 1:
                needed[item] = 0
                enclose_elements(item, surface.position, edge_blocks, blocks)
            item = next_item(item, worker, taken, 0, ENCLOSED_AT_A_TIME)
    begin_sharing(taken, 1)
    for worker in range(searching):
        item = next_item(-1, worker, taken, 1, SEARCHED_AT_A_TIME)
        while item < 2 * count * lanes:
            if item < count * lanes:
                p = met.expired[item // lanes]
                pair_vertices_with_triangles(p, item % lanes, lanes, met, low, high, surface, vertices, blocks, listed)
            else:
                p = met.expired[item // lanes - count]
                pair_edges(p, item % lanes, lanes, met, low, high, edge_blocks, listed_edges)
            item = next_item(item, worker, taken, 1, SEARCHED_AT_A_TIME)
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for k in range(count):
        lengthen(met.expired[k], listed.pieces, again, ends, 0)
        lengthen(met.expired[k], listed_edges.pieces, edges_again, ends, 1)
    fits = ti.cast(ends[0] <= numbers[2] and ends[1] <= numbers[3], ti.i32)
    short, short_edges = fits * ends[2], fits * ends[3]
    searching_again, looking_now = ti.min(short + short_edges, 1) * searching, fits * looking
    if ti.static(runs_on_gpu()):
        searching_again = (short + short_edges) * lanes
    begin_sharing(taken, 2)
    for worker in range(searching_again):
        item = next_item(-1, worker, taken, 2, SEARCHED_AT_A_TIME)
        while item < (short + short_edges) * lanes:
            if item < short * lanes:
                p = again[item // lanes]
                pair_vertices_with_triangles(p, item % lanes, lanes, met, low, high, surface, vertices, blocks, listed)
            else:
                p = edges_again[item // lanes - short]
                pair_edges(p, item % lanes, lanes, met, low, high, edge_blocks, listed_edges)
            item = next_item(item, worker, taken, 2, SEARCHED_AT_A_TIME)
    begin_sharing(taken, 3)
    for worker in range(looking_now):
        item = next_item(-1, worker, taken, 3, DUE_AT_A_TIME)
        while item < 2 * due_count * lanes:
            if item < due_count * lanes:
                look_at_piece(
                    met.due[item // lanes],
                    item % lanes,
                    lanes,
                    listed,
                    met,
                    False,
                    surface,
                    cloth,
                    rest,
                    recovery,
                    contacts,
                )
            else:
                look_at_piece(
                    met.due[item // lanes - due_count],
                    item % lanes,
                    lanes,
                    listed_edges,
                    met,
                    True,
                    surface,
                    cloth,
                    rest,
                    recovery,
                    contacts,
                )
            item = next_item(item, worker, taken, 3, DUE_AT_A_TIME)
    ends[2], ends[3] = ends[2] - short, ends[3] - short_edges
    contacts.counter[1], contacts.counter[2] = ends[0], ends[1]
