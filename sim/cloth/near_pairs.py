"""Search of the pairs of patches that need it, and of the listed pairs of elements for contacts, in one launch."""

import taichi as ti

from sim.cloth.bundles import (
    Boxes,
    Contacts,
    Counters,
    PairLists,
    PatchBlocks,
    PatchPairArrays,
    Rest,
    Surface,
)
from sim.cloth.element_blocks import enclose_elements
from sim.cloth.self_collision_kernels import (
    lanes_of_pair,
    lengthen,
    look_at_piece,
    pair_edges,
    pair_vertices_with_triangles,
    parts_of_search,
)
from sim.core.launch import large_kernel
from sim.core.reductions import runs_on_gpu
from sim.core.scheduling import begin_sharing, next_item

ENCLOSED_AT_A_TIME, SEARCHED_AT_A_TIME, DUE_AT_A_TIME = 8, 1, 4
"""Patches of which most are not needed, and pairs of patches, that a thread takes at a time: some microseconds."""


@large_kernel
def find_near_pairs(
    numbers: ti.math.ivec4,
    counters: Counters,
    met: PatchPairArrays,
    boxes: Boxes,
    blocks: PatchBlocks,
    lists: PairLists,
    surface: Surface,
    rest: Rest,
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
        numbers: whether to search, not if that is done, and only room was missing; most pairs of elements of both
            lists; workers (`sim.core.scheduling`) of a CPU's loops that have anything to do.
        counters: how many pairs of patches are expired, and due, and whether the list of them does not hold: then
            nothing is done.
        met, boxes: all pairs of patches, of which `needed` is 0 after; where patches are.
        blocks: elements of the patches.
        lists: of vertices with triangles, and of edges; `again` gets the numbers of pieces that were too short.
        surface, rest: all nodes.
        recovery: share of a missing distance that the substep gives back [-].
        contacts: the list; its second and third number become the ends that both lists need.
    """
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    lanes = ti.static(lanes_of_pair())
    parts = ti.static(parts_of_search())
    threads = ti.static(lanes * parts)
    holds = ti.cast(counters.found[2] == 0, ti.i32)
    count, due_count, workers = holds * numbers[0] * counters.found[0], holds * counters.found[1], numbers[3]
    enclosing = searching = ti.min(count, 1) * workers
    looking = ti.min(due_count, 1) * workers
    if ti.static(runs_on_gpu()):
        enclosing, searching = ti.min(count, 1) * (blocks.vertices.count * lanes + count), 2 * count * threads
        looking = 2 * due_count * lanes
    if count > 0:
        lists.ends[2], lists.ends[3] = 0, 0
    begin_sharing(counters.taken, 0)
    for worker in range(enclosing):
        item = next_item(-1, worker, counters.taken, 0, ENCLOSED_AT_A_TIME)
        while item < blocks.vertices.count * lanes + count:
            if item >= blocks.vertices.count * lanes:
                p = met.expired[item - blocks.vertices.count * lanes]
                lists.triangles.pieces[p][2], lists.edges.pieces[p][2] = 0, 0
            elif met.needed[item // lanes] == 1:
                enclose_elements(item // lanes, item % lanes, lanes, surface.position, blocks.edges, blocks.triangles)
            item = next_item(item, worker, counters.taken, 0, ENCLOSED_AT_A_TIME)
    begin_sharing(counters.taken, 1)
    for worker in range(searching):
        item = next_item(-1, worker, counters.taken, 1, SEARCHED_AT_A_TIME)
        while item < 2 * count * threads:
            if item < count * threads:
                p = met.expired[item // threads]
                pair_vertices_with_triangles(
                    p, item % threads, lanes, parts, met, boxes, surface, blocks, lists.triangles
                )
            else:
                p = met.expired[item // threads - count]
                pair_edges(p, item % threads, lanes, parts, met, boxes, blocks.edges, lists.edges)
            item = next_item(item, worker, counters.taken, 1, SEARCHED_AT_A_TIME)
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for k in range(count):
        pair = met.pairs[met.expired[k]]
        met.needed[pair[0]], met.needed[pair[1]] = 0, 0
        lengthen(met.expired[k], lists.triangles, lists.ends, 0)
        lengthen(met.expired[k], lists.edges, lists.ends, 1)
    fits = ti.cast(lists.ends[0] <= numbers[1] and lists.ends[1] <= numbers[2], ti.i32)
    short, short_edges = fits * lists.ends[2], fits * lists.ends[3]
    searching_again, looking_now = ti.min(short + short_edges, 1) * workers, fits * looking
    if ti.static(runs_on_gpu()):
        searching_again = (short + short_edges) * threads
    begin_sharing(counters.taken, 2)
    for worker in range(searching_again):
        item = next_item(-1, worker, counters.taken, 2, SEARCHED_AT_A_TIME)
        while item < (short + short_edges) * threads:
            if item < short * threads:
                p = lists.triangles.again[item // threads]
                pair_vertices_with_triangles(
                    p, item % threads, lanes, parts, met, boxes, surface, blocks, lists.triangles
                )
            else:
                p = lists.edges.again[item // threads - short]
                pair_edges(p, item % threads, lanes, parts, met, boxes, blocks.edges, lists.edges)
            item = next_item(item, worker, counters.taken, 2, SEARCHED_AT_A_TIME)
    begin_sharing(counters.taken, 3)
    for worker in range(looking_now):
        item = next_item(-1, worker, counters.taken, 3, DUE_AT_A_TIME)
        while item < 2 * due_count * lanes:
            if item < due_count * lanes:
                look_at_piece(
                    met.due[item // lanes],
                    item % lanes,
                    lanes,
                    lists.triangles,
                    met,
                    False,
                    surface,
                    rest,
                    recovery,
                    contacts,
                )
            else:
                look_at_piece(
                    met.due[item // lanes - due_count],
                    item % lanes,
                    lanes,
                    lists.edges,
                    met,
                    True,
                    surface,
                    rest,
                    recovery,
                    contacts,
                )
            item = next_item(item, worker, counters.taken, 3, DUE_AT_A_TIME)
    lists.ends[2], lists.ends[3] = lists.ends[2] - short, lists.ends[3] - short_edges
    contacts.counter[1], contacts.counter[2], contacts.counter[4] = lists.ends[0], lists.ends[1], holds * fits
