"""Kernels of cloth against cloth: pairs of elements that may meet soon, and those of them that meet in this substep."""

import taichi as ti

from sim.cloth.bundles import (
    Boxes,
    Contacts,
    EdgeBlocks,
    Four,
    PairPieces,
    PatchBlocks,
    PatchPairArrays,
    Quadruples,
    Rest,
    Surface,
    Two,
)
from sim.cloth.proximity import closest_on_edges, closest_on_triangle, distance_of_edges, distance_to_triangle, unit_or
from sim.cloth.proximity_contacts import EDGE_EDGE, INACTIVE, VERTEX_TRIANGLE, append_contact, least_displacement
from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.reductions import Results, Share, reduced, runs_on_gpu
from sim.core.scheduling import begin_sharing, next_item
from sim.core.warps import raise_to

OF_REST_DISTANCE = 0.7
"""Elements that are nearer than their thickness when the cloth is flat keep this part of their distance there."""


OF_EDGES = 0.8
"""Part of the thickness that edges keep: between flat layers, whose edges cross four times as often as vertices meet
triangles, vertices alone then push."""

END_OF_EDGE = 1.0e-3
"""Share of an edge that counts as its end."""

LANES, PARTS = 32, 4
"""Threads of a GPU for a pair of patches, one for each edge or so; and how many times as many for a search, one for
each block: few pairs are searched at rest, and a thread takes long."""


def lanes_of_pair() -> int:
    """Threads that share the work of a pair of patches."""
    return LANES if runs_on_gpu() else 1


def parts_of_search() -> int:
    """How many times as many share a search, by the blocks of elements that an element is compared with."""
    return PARTS if runs_on_gpu() else 1


BLOCK = 16
"""Elements that are compared with one at a time: two instructions of eight lanes, and few places that only fill up."""

ALONG_NORMAL = 0.5
"""Cosine of the angle between the shortest way of two elements and what is across both from which on that is meant."""

FAR = 1.0e9
"""Coordinate of what is far from everything [m]; the fourth power of a distance to it is finite in float32."""

NONE = -1
"""In the place of a vertex: the block has no element there."""

CARRIED_AT_A_TIME = 64
"""Pairs of patches that a thread takes at a time, as they are carried over: some microseconds of work."""

UNKNOWN = -1.0
"""Distance that a pair keeps where nobody has asked for it yet [m]."""

NEVER = -1.0e30
"""When a place is due in which no pair is listed."""

SAFETY_OF_DUE = 1.0e-3
"""Part of the thickness by which pairs are listed, and looked at, earlier than they could have come near: a thousand
times what sums of float32 lose, so that what is found does not depend on when lists were made."""


@ti.func
def share_no_vertex(e: Two, f: Two) -> ti.i32:
    """Whether two edges have four different ends."""
    nearest = ti.min(ti.abs(e[0] - f[0]), ti.abs(e[0] - f[1]), ti.abs(e[1] - f[0]), ti.abs(e[1] - f[1]))
    return ti.cast(nearest > 0, ti.i32)


@func
def pair_thickness(a: ti.i32, b: ti.i32, rest: Rest, surface: Surface, at_rest: ti.f32) -> ti.f32:
    """Distance that two elements keep [m]: between different cloths, or within one, where it is shorter at rest."""
    wanted = 0.5 * (surface.thickness[a] + surface.thickness[b])
    return ti.select(rest.cloth[a] == rest.cloth[b], ti.min(wanted, OF_REST_DISTANCE * at_rest), wanted)


@ti.func
def lowest_bit(bits: ti.i32) -> ti.i32:
    """Number of the lowest bit that is set, of less than 2^24: a float32 has it in its exponent."""
    return (ti.bit_cast(ti.cast(bits & -bits, ti.f32), ti.i32) >> 23) - 127


@func
def pair_vertices_with_triangles(
    p: ti.i32,
    thread: ti.i32,
    lanes: ti.i32,
    parts: ti.i32,
    met: PatchPairArrays,
    boxes: Boxes,
    surface: Surface,
    blocks: PatchBlocks,
    found: PairPieces,
):
    """List the vertices of each of two patches that are near triangles of the other, as one of several threads."""
    soonest, lane, part = NEVER, thread % lanes, thread // lanes
    for side in range(2):
        m, other = met.pairs[p][side], met.pairs[p][1 - side]
        place = blocks.vertices.first[m] + lane
        least, most = boxes.low[other] - met.reach[p], boxes.high[other] + met.reach[p]
        if side == 1 and m == other:
            place = blocks.vertices.first[m + 1]
        while place < blocks.vertices.first[m + 1]:
            v = blocks.vertices.nodes[place]
            place += lanes
            x = surface.position[v]
            if (x >= least).all() and (x <= most).all():
                within = met.reach[p] * met.reach[p]
                first, end = blocks.triangles.first_block[other] + part, blocks.triangles.first_block[other + 1]
                for k_block in range((end - first + parts - 1) // parts):
                    near, block = 0, first + k_block * parts
                    for k in range(BLOCK):
                        t = block * BLOCK + k
                        dx = ti.max(blocks.triangles.low_x[t] - x[0], x[0] - blocks.triangles.high_x[t], 0.0)
                        dy = ti.max(blocks.triangles.low_y[t] - x[1], x[1] - blocks.triangles.high_y[t], 0.0)
                        dz = ti.max(blocks.triangles.low_z[t] - x[2], x[2] - blocks.triangles.high_z[t], 0.0)
                        near |= ti.select(dx * dx + dy * dy + dz * dz <= within, 1, 0) << k
                    while near != 0:
                        t = block * BLOCK + lowest_bit(near)
                        near &= near - 1
                        corners = blocks.triangles.triangles[t]
                        own = ti.cast(v == corners[0] or v == corners[1] or v == corners[2], ti.i32)
                        if own == 0:
                            a, b = surface.position[corners[0]] - x, surface.position[corners[1]] - x
                            c = surface.position[corners[2]] - x
                            apart = distance_to_triangle(ti.math.vec3(0.0), a, b, c)
                            if apart < met.reach[p]:
                                slot = ti.atomic_add(found.pieces[p][2], 1)
                                if slot < found.pieces[p][1]:
                                    there = found.pieces[p][0] + slot
                                    found.pairs[there] = Four(v, corners[0], corners[1], corners[2])
                                    found.wanted[there], found.due[there] = UNKNOWN, met.slack[p] - apart
                                    soonest = ti.max(soonest, met.slack[p] - apart)
    raise_to(found.piece_due, p, soonest, lane)


@func
def pair_edges(
    p: ti.i32,
    thread: ti.i32,
    lanes: ti.i32,
    parts: ti.i32,
    met: PatchPairArrays,
    boxes: Boxes,
    blocks: EdgeBlocks,
    found: PairPieces,
):
    """List the edges of two patches that are near each other and share no vertex, as one of several threads.

    Edges are first told apart by their shadows on the line through their midpoints, and on what of that is across the
    first of them: disjoint for most neighbours in flat cloth, where spheres around them are not.
    """
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
                    if share_no_vertex(e, f) == 1:
                        between = ti.math.vec3(blocks.mid_x[there], blocks.mid_y[there], blocks.mid_z[there]) - middle
                        far_half = ti.math.vec3(blocks.half_x[there], blocks.half_y[there], blocks.half_z[there])
                        apart = distance_of_edges(-half, half, between - far_half, between + far_half)
                        if apart < met.reach[p]:
                            slot = ti.atomic_add(found.pieces[p][2], 1)
                            if slot < found.pieces[p][1]:
                                place_of_pair = found.pieces[p][0] + slot
                                # In this order, so that rounding does not depend on that of the patches.
                                found.pairs[place_of_pair] = ti.select(
                                    f[0] < e[0], Four(f[0], f[1], e[0], e[1]), Four(e[0], e[1], f[0], f[1])
                                )
                                found.wanted[place_of_pair], found.due[place_of_pair] = UNKNOWN, met.slack[p] - apart
                                soonest = ti.max(soonest, met.slack[p] - apart)
    raise_to(found.piece_due, p, soonest, lane)


@func
def lengthen(p: ti.i32, listed: PairPieces, ends: Integers, number: ti.template()):
    """Move a piece to the end of its list, empty, if more was found than it has room for; it is searched `again`."""
    found = listed.pieces[p][2]
    if found > listed.pieces[p][1]:
        places = found + found // 2
        listed.pieces[p] = Four(ti.atomic_add(ends[number], places), places, 0, 0)
        listed.again[ti.atomic_add(ends[2 + number], 1)] = p


@kernel
def carry_pieces(
    count: ti.i32,
    workers: ti.i32,
    taken: Integers,
    carried: Integers,
    before: PairPieces,
    now: PairPieces,
    ends: Integers,
    number: ti.i32,
) -> ti.i32:
    """Pieces of the pairs of patches that were listed before, at the places of their numbers now; returns the end.

    Args:
        carried: numbers that pairs of patches had before, or -1.
    """
    ends[number] = 0
    begin_sharing(taken, 0)
    for worker in range(workers):
        p = next_item(-1, worker, taken, 0, CARRIED_AT_A_TIME)
        while p < count:
            now.pieces[p], now.piece_due[p] = Four(0), NEVER
            if carried[p] >= 0:
                first, found = before.pieces[carried[p]][0], before.pieces[carried[p]][2]
                start = ti.atomic_add(ends[number], found)
                now.pieces[p], now.piece_due[p] = Four(start, found, found, 0), before.piece_due[carried[p]]
                for k in range(found):
                    now.pairs[start + k] = before.pairs[first + k]
                    now.wanted[start + k], now.due[start + k] = before.wanted[first + k], before.due[first + k]
            p = next_item(p, worker, taken, 0, CARRIED_AT_A_TIME)
    return ends[number]


@func
def look_at_piece(
    both: ti.i32,
    lane: ti.i32,
    lanes: ti.i32,
    listed: PairPieces,
    met: PatchPairArrays,
    are_edges: ti.template(),
    surface: Surface,
    rest: Rest,
    recovery: ti.f32,
    contacts: Contacts,
):
    """Look at the pairs of elements of one pair of patches that are due, as one of several threads."""
    soonest, is_left = NEVER, met.left[both]
    place, end = listed.pieces[both][0] + lane, listed.pieces[both][0] + listed.pieces[both][2]
    while place < end:
        if listed.due[place] >= is_left:
            listed.due[place] = look_at_pair(
                place,
                listed.pairs,
                listed.wanted,
                met.slack[both],
                met.approach[both],
                met.allowed[both],
                are_edges,
                surface,
                rest,
                recovery,
                contacts,
            )
        soonest = ti.max(soonest, listed.due[place])
        place += lanes
    raise_to(listed.piece_due, both, soonest, lane)


@func
def look_at_pair(
    p: ti.i32,
    pairs: Quadruples,
    wanted: Floats,
    slack: ti.f32,
    approach: ti.f32,
    allowed: ti.f32,
    are_edges: ti.template(),
    surface: Surface,
    rest: Rest,
    recovery: ti.f32,
    contacts: Contacts,
) -> ti.f32:
    """Append a pair if it has to be; returns when it is due [m]."""
    v = pairs[p]
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
    if distance < ti.max(0.5 * (surface.thickness[v[0]] + surface.thickness[v[2]]), approach + allowed):
        u1, u2, u3 = surface.displacement[v[1]] - u, surface.displacement[v[2]] - u, surface.displacement[v[3]] - u
        mean = 0.25 * (u1 + u2 + u3)
        motion = ti.max(mean.norm(), (u1 - mean).norm(), (u2 - mean).norm(), (u3 - mean).norm())
        if wanted[p] == UNKNOWN:
            a, b, c, d = (
                rest.position[v[0]],
                rest.position[v[1]],
                rest.position[v[2]],
                rest.position[v[3]],
            )
            at_rest = distance_of_edges(a, b, c, d) if ti.static(are_edges) else distance_to_triangle(a, b, c, d)
            wanted[p] = pair_thickness(v[0], v[2], rest, surface, at_rest)
        keeps = part * wanted[p]
        if distance < ti.max(keeps, ti.min(2.0 * motion, approach) + allowed):
            across = x1.cross(x3 - x2) if ti.static(are_edges) else (x2 - x1).cross(x3 - x1)
            n = unit_or(apart, across)
            # At a millionth of an element, rounding turns `apart` by so much that no plane across it is between both.
            if is_inside and ti.abs(across.dot(n)) > ALONG_NORMAL * across.norm():
                n = ti.math.sign(across.dot(n)) * unit_or(across, n)
            least = least_displacement(distance, keeps, recovery)
            pushes = distance < keeps or n.dot(weight[1] * u1 + weight[2] * u2 + weight[3] * u3) < least
            floor = ti.select(pushes and keeps > 0.0, least, INACTIVE)
            kind = EDGE_EDGE if ti.static(are_edges) else VERTEX_TRIANGLE
            friction = ti.sqrt(surface.friction[v[0]] * surface.friction[v[2]])
            append_contact(contacts, v, weight, n, floor, kind, zero, friction)
    return slack - distance


@kernel
def range_of_vectors(vectors: Vectors, first: ti.i32, count: ti.i32, share: Share) -> Results:
    """Largest components of some vectors, then those of the negative ones, six maxima."""
    for lane in range(share.tree.lanes):
        most, least = ti.math.vec3(-FAR), ti.math.vec3(FAR)
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count:
                most, least = ti.max(most, vectors[first + i]), ti.min(least, vectors[first + i])
        for axis in ti.static(range(3)):
            (
                share.tree.partial[axis * share.tree.lanes + lane],
                share.tree.partial[(3 + axis) * share.tree.lanes + lane],
            ) = most[axis], -least[axis]
    return reduced(share.tree.partial, share.tree.lanes, share.tree.quantities, share.tree.maxima, share.tree.nodes)
