"""Kernels of cloth against cloth: pairs of elements that may meet soon, and those of them that meet in this substep."""

import taichi as ti

from sim.cloth.bundles import Four, PairPieces, PairSearch, PatchBlocks
from sim.cloth.contacts import (
    EDGE_EDGE,
    INACTIVE,
    VERTEX_TRIANGLE,
    append_contact,
    closest_on_edges,
    closest_on_triangle,
    distance_of_edges,
    distance_to_triangle,
    least_displacement,
    unit_or,
)
from sim.core.arrays import Integers, Vectors
from sim.core.bundles import func
from sim.core.launch import kernel, large_kernel
from sim.core.reductions import Results, Share, reduced_tree, runs_on_gpu
from sim.core.scheduling import NO_MORE, begin_sharing, next_item
from sim.core.warps import WARP, raise_to, whole_warps

BLOCK = 16
"""Elements that are compared with one at a time: two instructions of eight lanes, and few places that only fill up."""

FAR = 1.0e9  # coordinate of what is far from everything [m]; the fourth power of a distance to it is finite in float32
NONE = -1  # in the place of a vertex: the block has no element there

OF_REST_DISTANCE = 0.7
"""Elements that are nearer than their thickness when the cloth is flat keep this part of their distance there."""


OF_EDGES = 0.8
"""Part of the thickness that edges keep: between flat layers, whose edges cross four times as often as vertices meet
triangles, vertices alone then push."""

END_OF_EDGE = 1.0e-3
"""Share of an edge that counts as its end."""

LANES, LANES_OF_PIECE, EDGE_PARTS, VERTEX_PARTS = 32, 8, 2, 4
"""Threads of a GPU for a pair of patches, one for each edge or so, and those that look at a piece; how many times as
many search for one; and how many of these share a vertex, each with a part of a block of triangles."""


def on_gpu(threads: int) -> int:
    """Threads that share some work on a GPU; on a CPU one does it."""
    return threads if runs_on_gpu() else 1


ALONG_NORMAL = 0.5
"""Cosine of the angle between the shortest way of two elements and what is across both from which on that is meant."""

CARRIED_AT_A_TIME = 64
"""Pairs of patches that a thread takes at a time, as they are carried over: some microseconds of work."""

UNKNOWN = -1.0
"""Distance that a pair keeps where nobody has asked for it yet [m]."""

NEVER = -1.0e30
"""When a place is due in which no pair is listed."""

SAFETY_OF_DUE = 1.0e-3
"""Part of the thickness by which pairs are listed, and looked at, earlier than they could have come near: far more than
sums of float32 lose."""


@ti.func
def lowest_bit(bits: ti.i32) -> ti.i32:
    """Number of the lowest bit that is set, of less than 2^24: a float32 has it in its exponent."""
    return (ti.bit_cast(ti.cast(bits & -bits, ti.f32), ti.i32) >> 23) - 127


@func
def pair_vertices_with_triangles(p: ti.i32, thread: ti.i32, lanes: ti.i32, parts: ti.template(), search: PairSearch):
    """List the vertices of each of two patches that are near triangles of the other, as one of several threads, of
    which `parts` share a vertex.
    """
    met, boxes, surface = ti.static((search.met, search.boxes, search.surface))
    blocks, found = ti.static((search.blocks, search.listed))
    tested = ti.static(BLOCK // parts)
    soonest, at_once = NEVER, lanes // parts
    lane, low = thread % at_once, thread // at_once * tested
    for side in range(2):
        m, other = met.pairs[p][side], met.pairs[p][1 - side]
        place = blocks.vertices.first[m] + lane
        least, most = boxes.low[other] - met.reach[p], boxes.high[other] + met.reach[p]
        if side == 1 and m == other:
            place = blocks.vertices.first[m + 1]
        while place < blocks.vertices.first[m + 1]:
            v = blocks.vertices.nodes[place]
            place += at_once
            x = surface.position[v]
            if (x >= least).all() and (x <= most).all():
                within = met.reach[p] * met.reach[p]
                for block in range(blocks.triangles.first_block[other], blocks.triangles.first_block[other + 1]):
                    near, first = 0, block * BLOCK + low
                    for k in range(tested):
                        t = first + k
                        dx = ti.max(blocks.triangles.low_x[t] - x[0], x[0] - blocks.triangles.high_x[t], 0.0)
                        dy = ti.max(blocks.triangles.low_y[t] - x[1], x[1] - blocks.triangles.high_y[t], 0.0)
                        dz = ti.max(blocks.triangles.low_z[t] - x[2], x[2] - blocks.triangles.high_z[t], 0.0)
                        near |= ti.select(dx * dx + dy * dy + dz * dz <= within, 1, 0) << k
                    while near != 0:
                        t = first + lowest_bit(near)
                        near &= near - 1
                        corners = blocks.triangles.triangles[t]
                        own = ti.cast(v == corners[0] or v == corners[1] or v == corners[2], ti.i32)
                        if own == 0:
                            a, b = surface.position[corners[0]] - x, surface.position[corners[1]] - x
                            c = surface.position[corners[2]] - x
                            apart = distance_to_triangle(ti.math.vec3(0.0), a, b, c)
                            if apart < met.reach[p]:
                                slot = ti.atomic_add(found.pieces[2 * p][2], 1)
                                if slot < found.pieces[2 * p][1]:
                                    there = found.pieces[2 * p][0] + slot
                                    found.pairs[there] = Four(v, corners[0], corners[1], corners[2])
                                    found.wanted[there], found.due[there] = UNKNOWN, met.slack[p] - apart
                                    soonest = ti.max(soonest, met.slack[p] - apart)
    raise_to(found.piece_due, 2 * p, soonest, thread, WARP)


@func
def pair_edges(p: ti.i32, thread: ti.i32, lanes: ti.i32, parts: ti.i32, search: PairSearch):
    """List the edges of two patches that are near each other and share no vertex, as one of several threads.

    Edges are first told apart by their shadows on the line through their midpoints, and on what of that is across the
    first of them.
    """
    met, boxes, blocks, found = ti.static((search.met, search.boxes, search.blocks.edges, search.listed))
    soonest, lane, part = NEVER, thread % lanes, thread // lanes
    m, other = met.pairs[p][0], met.pairs[p][1]
    within = met.reach[p] * met.reach[p]
    least, most = boxes.low[other] - met.reach[p], boxes.high[other] + met.reach[p]
    place = blocks.first_block[m] * BLOCK + lane
    while place < blocks.first_block[m + 1] * BLOCK:
        e, own = blocks.edges[place], place
        x, y, z = blocks.mid_x[place], blocks.mid_y[place], blocks.mid_z[place]
        g, h, i = blocks.half_x[place], blocks.half_y[place], blocks.half_z[place]
        place += lanes
        middle, half = ti.math.vec3(x, y, z), ti.math.vec3(g, h, i)
        steep = ti.max(half.norm_sqr(), 1.0e-30)
        if (middle + ti.abs(half) >= least).all() and (middle - ti.abs(half) <= most).all():
            first = ti.select(m == other, own // BLOCK, blocks.first_block[other]) + part
            for k_block in range((blocks.first_block[other + 1] - first + parts - 1) // parts):
                near, block = 0, first + k_block * parts
                for k in range(BLOCK):
                    f = block * BLOCK + k
                    dx, dy, dz = blocks.mid_x[f] - x, blocks.mid_y[f] - y, blocks.mid_z[f] - z
                    squared = dx * dx + dy * dy + dz * dz
                    own_shadow = g * dx + h * dy + i * dz
                    shadow = blocks.half_x[f] * dx + blocks.half_y[f] * dy + blocks.half_z[f] * dz
                    beyond = ti.max(squared - ti.abs(own_shadow) - ti.abs(shadow), 0.0)
                    is_near = beyond * beyond <= within * squared
                    along = own_shadow / steep
                    across = ti.max(squared - along * own_shadow, 0.0)
                    shadow -= along * (blocks.half_x[f] * g + blocks.half_y[f] * h + blocks.half_z[f] * i)
                    beyond = ti.max(across - ti.abs(shadow), 0.0)
                    near |= ti.select(is_near and beyond * beyond <= within * across, 1, 0) << k
                if m == other and block == own // BLOCK:
                    # Each pair once: only edges after this one.
                    near &= -2 << (own % BLOCK)
                while near != 0:
                    there = block * BLOCK + lowest_bit(near)
                    near &= near - 1
                    f = blocks.edges[there]
                    if ti.min(ti.abs(e[0] - f[0]), ti.abs(e[0] - f[1]), ti.abs(e[1] - f[0]), ti.abs(e[1] - f[1])) > 0:
                        between = ti.math.vec3(blocks.mid_x[there], blocks.mid_y[there], blocks.mid_z[there]) - middle
                        far_half = ti.math.vec3(blocks.half_x[there], blocks.half_y[there], blocks.half_z[there])
                        apart = distance_of_edges(-half, half, between - far_half, between + far_half)
                        if apart < met.reach[p]:
                            slot = ti.atomic_add(found.pieces[2 * p + 1][2], 1)
                            if slot < found.pieces[2 * p + 1][1]:
                                place_of_pair = found.pieces[2 * p + 1][0] + slot
                                # In this order, so that rounding does not depend on that of the patches.
                                found.pairs[place_of_pair] = ti.select(
                                    f[0] < e[0], Four(f[0], f[1], e[0], e[1]), Four(e[0], e[1], f[0], f[1])
                                )
                                found.wanted[place_of_pair], found.due[place_of_pair] = UNKNOWN, met.slack[p] - apart
                                soonest = ti.max(soonest, met.slack[p] - apart)
    raise_to(found.piece_due, 2 * p + 1, soonest, lane, WARP)


@func
def search_piece(piece: ti.i32, thread: ti.i32, search: PairSearch):
    """List what one piece of a pair of patches has, as one of several threads."""
    lanes, parts, of_vertex = ti.static((on_gpu(LANES), on_gpu(EDGE_PARTS), on_gpu(VERTEX_PARTS)))
    if piece % 2 == 0:
        pair_vertices_with_triangles(piece // 2, thread, lanes * parts, of_vertex, search)
    else:
        pair_edges(piece // 2, thread, lanes, parts, search)


@func
def lengthen(piece: ti.i32, listed: PairPieces):
    """Move a piece to the end of the list, empty, if more was found than it has room for; it is searched `again`."""
    found = listed.pieces[piece][2]
    if found > listed.pieces[piece][1]:
        places = found + found // 2
        listed.pieces[piece] = Four(ti.atomic_add(listed.ends[0], places), places, 0, 0)
        listed.again[ti.atomic_add(listed.ends[1], 1)] = piece


@kernel
def carry_pieces(
    count: ti.i32, workers: ti.i32, taken: Integers, carried: Integers, before: PairPieces, now: PairPieces
):
    """So many pieces of pairs of patches that were listed before, at the places of their numbers now; `carried` are
    the numbers that they had, or -1.

    Those that have any elements are listed in `again` meanwhile, as most have none.
    """
    lanes = ti.static(on_gpu(LANES))
    now.ends[0], now.ends[1] = 0, 0
    for piece in range(count):
        now.pieces[piece], now.piece_due[piece] = Four(0), NEVER
        old = 2 * carried[piece // 2] + piece % 2
        if old >= 0 and before.pieces[old][2] > 0:
            found = before.pieces[old][2]
            now.pieces[piece] = Four(ti.atomic_add(now.ends[0], found), found, found, 0)
            now.piece_due[piece] = before.piece_due[old]
            now.again[ti.atomic_add(now.ends[1], 1)] = piece
    moved, moving = now.ends[1], workers
    if ti.static(runs_on_gpu()):
        moving = moved * lanes
    begin_sharing(taken, 0)
    for worker in range(moving):
        item = next_item(-1, worker, taken, 0, CARRIED_AT_A_TIME)
        while item < moved * lanes:
            piece = now.again[item // lanes]
            first, start = before.pieces[2 * carried[piece // 2] + piece % 2][0], now.pieces[piece][0]
            k = item % lanes
            while k < now.pieces[piece][2]:
                now.pairs[start + k] = before.pairs[first + k]
                now.wanted[start + k], now.due[start + k] = before.wanted[first + k], before.due[first + k]
                k += lanes
            item = next_item(item, worker, taken, 0, CARRIED_AT_A_TIME)
    now.ends[1] = 0


@kernel
def keep_pairs(count: ti.i32, before: PairPieces, now: PairPieces):
    """The first pairs of a list at the same places of another."""
    for k in range(count):
        now.pairs[k], now.wanted[k], now.due[k] = before.pairs[k], before.wanted[k], before.due[k]


@func
def look_at_piece(both: ti.i32, lane: ti.i32, lanes: ti.template(), are_edges: ti.template(), search: PairSearch):
    """Look at the pairs of elements of one pair of patches that are due, as one of several threads; or at none, as
    `NO_MORE` of them.
    """
    listed, met = ti.static((search.listed, search.met))
    piece = 2 * both + ti.cast(are_edges, ti.i32)
    soonest, is_left = NEVER, met.left[both]
    place, end = lane, listed.pieces[piece][2]
    first = listed.pieces[piece][0]
    while place < end:
        p = first + place
        if listed.due[p] >= is_left:
            listed.due[p] = look_at_pair(p, both, are_edges, search)
        soonest = ti.max(soonest, listed.due[p])
        place += lanes
    raise_to(listed.piece_due, piece, soonest, lane, lanes)


@func
def look_at_pair(p: ti.i32, both: ti.i32, are_edges: ti.template(), search: PairSearch) -> ti.f32:
    """Append a pair if it has to be; returns when it is due [m]."""
    listed, met, surface, at_rest = ti.static((search.listed, search.met, search.surface, search.at_rest))
    v, approach, allowed = listed.pairs[p], met.approach[both], met.allowed[both]
    x, u = surface.position[v[0]], surface.displacement[v[0]]
    x1, x2, x3 = surface.position[v[1]] - x, surface.position[v[2]] - x, surface.position[v[3]] - x
    zero = ti.math.vec3(0.0)
    weight = ti.math.vec4(0.0)
    part = 1.0
    is_inside = True
    if ti.static(are_edges):
        shares = closest_on_edges(zero, x1, x2, x3)
        is_inside = ti.min(shares, 1.0 - shares).min() > 0.0
        weight = ti.math.vec4(1.0 - shares[0], shares[0], shares[1] - 1.0, -shares[1])
        # What is nearest at an end of an edge is a vertex, which is near to a triangle too.
        part = ti.select(ti.min(shares, 1.0 - shares).min() > END_OF_EDGE, OF_EDGES, 0.0)
    else:
        shares = closest_on_triangle(zero, x1, x2, x3)
        is_inside = shares.min() > 0.0
        weight = ti.math.vec4(1.0, -shares[0], -shares[1], -shares[2])
    apart = weight[1] * x1 + weight[2] * x2 + weight[3] * x3
    distance = apart.norm()
    thickness = 0.5 * (surface.thickness[v[0]] + surface.thickness[v[2]])
    if distance < ti.max(thickness, approach + allowed):
        u1, u2, u3 = surface.displacement[v[1]] - u, surface.displacement[v[2]] - u, surface.displacement[v[3]] - u
        mean = 0.25 * (u1 + u2 + u3)
        motion = ti.max(mean.norm(), (u1 - mean).norm(), (u2 - mean).norm(), (u3 - mean).norm())
        if listed.wanted[p] == UNKNOWN:
            a, b, c, d = at_rest[v[0]], at_rest[v[1]], at_rest[v[2]], at_rest[v[3]]
            apart_at_rest = distance_of_edges(a, b, c, d) if ti.static(are_edges) else distance_to_triangle(a, b, c, d)
            is_own = search.cloth[v[0]] == search.cloth[v[2]]
            listed.wanted[p] = ti.select(is_own, ti.min(thickness, OF_REST_DISTANCE * apart_at_rest), thickness)
        keeps = part * listed.wanted[p]
        if distance < ti.max(keeps, ti.min(2.0 * motion, approach) + allowed):
            across = x1.cross(x3 - x2) if ti.static(are_edges) else (x2 - x1).cross(x3 - x1)
            n = unit_or(apart, across)
            # At a millionth of an element, rounding turns `apart` by so much that no plane across it is between both.
            if is_inside and ti.abs(across.dot(n)) > ALONG_NORMAL * across.norm():
                n = ti.math.sign(across.dot(n)) * unit_or(across, n)
            least = least_displacement(distance, keeps, search.recovery)
            pushes = distance < keeps or n.dot(weight[1] * u1 + weight[2] * u2 + weight[3] * u3) < least
            floor = ti.select(pushes and keeps > 0.0, least, INACTIVE)
            kind = EDGE_EDGE if ti.static(are_edges) else VERTEX_TRIANGLE
            friction = ti.sqrt(surface.friction[v[0]] * surface.friction[v[2]])
            append_contact(search.contacts, v, weight, n, floor, kind, zero, friction)
    return met.slack[both] - distance


@kernel
def range_of_vectors(vectors: Vectors, first: ti.i32, count: ti.i32, share: Share) -> Results:
    """Largest components of some vectors, then those of the negative ones, six maxima."""
    (tree,) = ti.static((share.tree,))
    for lane in range(tree.lanes):
        most, least = ti.math.vec3(-FAR), ti.math.vec3(FAR)
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count:
                most, least = ti.max(most, vectors[first + i]), ti.min(least, vectors[first + i])
        for axis in ti.static(range(3)):
            tree.partial[axis * tree.lanes + lane], tree.partial[(3 + axis) * tree.lanes + lane] = (
                most[axis],
                -least[axis],
            )
    return reduced_tree(tree)


ENCLOSED_AT_A_TIME, SEARCHED_AT_A_TIME, DUE_AT_A_TIME = 8, 1, 4
"""Patches of which most are not needed, and pairs of patches, that a thread takes at a time: some microseconds."""


@func
def enclose_elements(m: ti.i32, lane: ti.i32, lanes: ti.i32, position: Vectors, blocks: PatchBlocks):
    """Midpoints of edges and half the vectors along them, and boxes of triangles, of a patch, as one of several
    threads.
    """
    of_edges, of_triangles = ti.static((blocks.edges, blocks.triangles))
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


@large_kernel
def find_near_pairs(numbers: ti.math.ivec3, search: PairSearch):
    """List the elements of the pairs of patches that are `expired`: the vertices of each of two patches with the
    triangles of the other within `reach` [m] of them, and the edges of both within that of each other. Then append the
    listed pairs that are nearer than they shall be, or get there, and those that might cross.

    Pieces that are too short for what is found move to the end of the list, and are searched again; where that is too
    short, by a call that searches no pairs, once it is longer.

    A pair might cross, and is watched, `INACTIVE`, when its vertices, displaced as they are now and by what contacts
    are `allowed` besides, come together: no nearer than by twice their motion against their mean, nor than by the
    `approach` of their patches.

    Args:
        numbers: whether to search, not if that is done, and only room was missing; most pairs of elements; workers
            (`sim.core.scheduling`) of a CPU's loops that have anything to do.
        search: `met.found` has how many pairs of patches are expired, and due, and whether the list of them does not
            hold: then nothing is done. `needed` is 0 after; the second number that contacts count becomes the end that
            `listed` needs.
    """
    met, blocks, listed = ti.static((search.met, search.blocks, search.listed))
    # Bounds before the first loop: each that is found between two loops would be a launch of its own on a GPU.
    lanes, of_piece = ti.static(on_gpu(LANES), on_gpu(LANES_OF_PIECE))
    threads = ti.static(lanes * on_gpu(EDGE_PARTS))
    holds = ti.cast(met.found[2] == 0, ti.i32)
    count, due_count, workers = holds * numbers[0] * met.found[0], holds * met.found[1], numbers[2]
    enclosing = searching = ti.min(count, 1) * workers
    due_end = whole_warps(due_count * of_piece)  # then those of edges, in warps of their own
    looking = ti.min(due_count, 1) * workers
    if ti.static(runs_on_gpu()):
        enclosing, searching = ti.min(count, 1) * (blocks.vertices.count * lanes + count), 2 * count * threads
        looking = 2 * due_end
    if count > 0:
        listed.ends[1] = 0
    begin_sharing(met.taken, 0)
    for worker in range(enclosing):
        item = next_item(-1, worker, met.taken, 0, ENCLOSED_AT_A_TIME)
        while item < blocks.vertices.count * lanes + count:
            if item >= blocks.vertices.count * lanes:
                p = met.expired[item - blocks.vertices.count * lanes]
                listed.pieces[2 * p][2], listed.pieces[2 * p + 1][2] = 0, 0
            elif met.needed[item // lanes] == 1:
                enclose_elements(item // lanes, item % lanes, lanes, search.surface.position, blocks)
            item = next_item(item, worker, met.taken, 0, ENCLOSED_AT_A_TIME)
    begin_sharing(met.taken, 1)
    for worker in range(searching):
        item = next_item(-1, worker, met.taken, 1, SEARCHED_AT_A_TIME)
        while item < 2 * count * threads:
            of_all = item // threads  # first vertices with triangles of all
            piece = 2 * met.expired[of_all % count] + of_all // count
            search_piece(piece, item % threads, search)
            item = next_item(item, worker, met.taken, 1, SEARCHED_AT_A_TIME)
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for k in range(count):
        p = met.expired[k]
        met.needed[met.pairs[p][0]], met.needed[met.pairs[p][1]] = 0, 0
        lengthen(2 * p, listed)
        lengthen(2 * p + 1, listed)
    fits = ti.cast(listed.ends[0] <= numbers[1], ti.i32)
    short = fits * listed.ends[1]
    searching_again, looking_now = ti.min(short, 1) * workers, fits * looking
    if ti.static(runs_on_gpu()):
        searching_again = short * threads
    begin_sharing(met.taken, 2)
    for worker in range(searching_again):
        item = next_item(-1, worker, met.taken, 2, SEARCHED_AT_A_TIME)
        while item < short * threads:
            search_piece(listed.again[item // threads], item % threads, search)
            item = next_item(item, worker, met.taken, 2, SEARCHED_AT_A_TIME)
    begin_sharing(met.taken, 3)
    for worker in range(looking_now):
        item = next_item(-1, worker, met.taken, 3, DUE_AT_A_TIME)
        while item < 2 * due_end:
            place = item % due_end // of_piece
            lane = ti.select(place < due_count, item % of_piece, NO_MORE)
            p = met.due[ti.min(place, due_count - 1)]
            if item < due_end:
                look_at_piece(p, lane, of_piece, False, search)
            else:
                look_at_piece(p, lane, of_piece, True, search)
            item = next_item(item, worker, met.taken, 3, DUE_AT_A_TIME)
    listed.ends[1] = listed.ends[1] - short
    search.contacts.counter[1], search.contacts.counter[3] = listed.ends[0], holds * fits
