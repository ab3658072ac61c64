"""Kernels of cloth against cloth: pairs of elements that may meet soon, and those of them that meet in this substep."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.proximity import (
    closest_on_edges,
    closest_on_triangle,
    distance_of_edges,
    distance_to_triangle,
    unit_or,
)
from sim.cloth.proximity_contacts import EDGE_EDGE, INACTIVE, VERTEX_TRIANGLE, Quadruples, Weights, least_displacement
from sim.launch import fast_launch
from sim.reductions import Results, reduced, runs_on_gpu
from sim.work_sharing import begin_sharing, next_item

Pairs = ti.types.ndarray(dtype=ti.types.vector(2, ti.i32), ndim=1)
Triples = ti.types.ndarray(dtype=ti.types.vector(3, ti.i32), ndim=1)
Two = ti.types.vector(2, ti.i32)
Four = ti.types.vector(4, ti.i32)

OF_REST_DISTANCE = 0.7
"""Elements that are nearer than their thickness when the cloth is flat keep this part of their distance there."""


OF_EDGES = 0.8
"""Part of the thickness that edges keep: between flat layers, whose edges cross four times as often as vertices meet
triangles, vertices alone then push."""

END_OF_EDGE = 1.0e-3
"""Share of an edge that counts as its end."""

LANES = 8
"""Threads of a GPU that search a pair of patches: enough to share out the work of a few of them."""

BLOCK = 16
"""Elements that are compared with one at a time: two instructions of eight lanes, and few places that only fill up."""

FAR = 1.0e9
"""Coordinate of what is far from everything [m]; the fourth power of a distance to it is finite in float32."""

NONE = -1
"""In the place of a vertex: the block has no element there."""

SEARCHED_AT_A_TIME, DUE_AT_A_TIME, CARRIED_AT_A_TIME = 1, 4, 64
"""Pairs of patches that a thread takes at a time: some microseconds of work."""

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


@ti.func
def pair_thickness(a: ti.i32, b: ti.i32, cloth: Integers, thickness: Floats, at_rest: ti.f32) -> ti.f32:
    """Distance that two elements keep [m]: between different cloths, or within one, where it is shorter at rest."""
    wanted = 0.5 * (thickness[a] + thickness[b])
    return ti.select(cloth[a] == cloth[b], ti.min(wanted, OF_REST_DISTANCE * at_rest), wanted)


@ti.func
def lowest_bit(bits: ti.i32) -> ti.i32:
    """Number of the lowest bit that is set, of less than 2^24: a float32 has it in its exponent."""
    return (ti.bit_cast(ti.cast(bits & -bits, ti.f32), ti.i32) >> 23) - 127


@fast_launch
@ti.kernel
def search_patches(
    count: ti.i32, searched: Integers, edge_count: ti.i32, edge_searched: Integers, lanes: ti.i32, workers: ti.i32,
    taken: Integers, patches: Pairs, low: Vectors, high: Vectors, reach: Floats, position: Vectors,
    first_vertex: Integers, vertices: Integers, first_triangle: Integers, triangles: Triples,
    low_x: Floats, low_y: Floats, low_z: Floats, high_x: Floats, high_y: Floats, high_z: Floats,
    first_edge: Integers, edges: Pairs,
    mid_x: Floats, mid_y: Floats, mid_z: Floats, half_x: Floats, half_y: Floats, half_z: Floats, slack: Floats,
    pieces: Quadruples, piece_due: Floats, pairs: Quadruples, wanted: Floats, due: Floats,
    edge_pieces: Quadruples, edge_piece_due: Floats, edge_pairs: Quadruples, edge_wanted: Floats, edge_due: Floats,
):  # fmt: skip
    """List the vertices of each of two patches with the triangles of the other within `reach` [m] of them, and the
    edges of both within that of each other.

    Args:
        count: number of pairs of patches whose vertices are searched; their numbers are `searched`; `edge_count` and
            `edge_searched` likewise for edges.
        lanes: threads that share a pair.
        workers, taken: see `sim.work_sharing`.
        first_triangle to high_z: see `ElementBlocks.triangles`; `first_edge` to `half_z` `ElementBlocks.edges`.
        slack: how much nearer pairs may come that are not listed [m].
        pieces to due: of vertices with triangles, see `PairList`; `edge_pieces` to `edge_due` of edges.
    """
    begin_sharing(taken, 0)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, SEARCHED_AT_A_TIME)
        while item < (count + edge_count) * lanes:
            if item < count * lanes:
                pair_vertices_with_triangles(
                    searched[item // lanes], item % lanes, lanes, patches, low, high, reach, position, first_vertex,
                    vertices, first_triangle, triangles, low_x, low_y, low_z, high_x, high_y, high_z, slack, pieces,
                    piece_due, pairs, wanted, due,
                )  # fmt: skip
            else:
                pair_edges(
                    edge_searched[item // lanes - count], item % lanes, lanes, patches, low, high, reach, first_edge,
                    edges, mid_x, mid_y, mid_z, half_x, half_y, half_z, slack, edge_pieces, edge_piece_due, edge_pairs,
                    edge_wanted, edge_due,
                )  # fmt: skip
            item = next_item(item, worker, taken, 0, SEARCHED_AT_A_TIME)


@ti.func
def pair_vertices_with_triangles(
    p: ti.i32, lane: ti.i32, lanes: ti.i32, patches: Pairs, low: Vectors, high: Vectors, reach: Floats,
    position: Vectors, first_vertex: Integers, vertices: Integers, first_block: Integers, triangles: Triples,
    low_x: Floats, low_y: Floats, low_z: Floats, high_x: Floats, high_y: Floats, high_z: Floats,
    slack: Floats, pieces: Quadruples, piece_due: Floats, pairs: Quadruples, wanted: Floats, due: Floats,
):  # fmt: skip
    """List the vertices of each of two patches that are near triangles of the other, as one of several threads."""
    soonest = NEVER
    for side in range(2):
        m, other = patches[p][side], patches[p][1 - side]
        place = first_vertex[m] + lane
        least, most = low[other] - reach[p], high[other] + reach[p]
        if side == 1 and m == other:
            place = first_vertex[m + 1]
        while place < first_vertex[m + 1]:
            v = vertices[place]
            place += lanes
            x = position[v]
            if (x >= least).all() and (x <= most).all():
                below, above = x - reach[p], x + reach[p]
                for block in range(first_block[other], first_block[other + 1]):
                    near = 0
                    for k in range(BLOCK):
                        t = block * BLOCK + k
                        is_beside = low_x[t] < above[0] and high_x[t] > below[0]
                        is_beside = is_beside and low_y[t] < above[1] and high_y[t] > below[1]
                        is_beside = is_beside and low_z[t] < above[2] and high_z[t] > below[2]
                        near |= ti.cast(is_beside, ti.i32) << k
                    while near != 0:
                        t = block * BLOCK + lowest_bit(near)
                        near &= near - 1
                        corners = triangles[t]
                        own = ti.cast(v == corners[0] or v == corners[1] or v == corners[2], ti.i32)
                        if own == 0:
                            a, b = position[corners[0]] - x, position[corners[1]] - x
                            c = position[corners[2]] - x
                            apart = distance_to_triangle(ti.math.vec3(0.0), a, b, c)
                            if apart < reach[p]:
                                slot = ti.atomic_add(pieces[p][2], 1)
                                if slot < pieces[p][1]:
                                    there = pieces[p][0] + slot
                                    pairs[there] = Four(v, corners[0], corners[1], corners[2])
                                    wanted[there], due[there] = UNKNOWN, slack[p] - apart
                                    soonest = ti.max(soonest, slack[p] - apart)
    ti.atomic_max(piece_due[p], soonest)


@ti.func
def pair_edges(
    p: ti.i32, lane: ti.i32, lanes: ti.i32, patches: Pairs, low: Vectors, high: Vectors, reach: Floats,
    first_block: Integers, edges: Pairs,
    mid_x: Floats, mid_y: Floats, mid_z: Floats, half_x: Floats, half_y: Floats, half_z: Floats,
    slack: Floats, pieces: Quadruples, piece_due: Floats, pairs: Quadruples, wanted: Floats, due: Floats,
):  # fmt: skip
    """List the edges of two patches that are near each other and share no vertex, as one of several threads.

    Edges are first told apart by their shadows on the line through their midpoints, which are disjoint for most
    neighbours in flat cloth; spheres around them do not.
    """
    soonest = NEVER
    m, other = patches[p][0], patches[p][1]
    within = reach[p] * reach[p]
    least, most = low[other] - reach[p], high[other] + reach[p]
    place = first_block[m] * BLOCK + lane
    while place < first_block[m + 1] * BLOCK:
        e, own = edges[place], place
        x, y, z = mid_x[place], mid_y[place], mid_z[place]
        g, h, i = half_x[place], half_y[place], half_z[place]
        place += lanes
        middle, half = ti.math.vec3(x, y, z), ti.math.vec3(g, h, i)
        if (middle + ti.abs(half) >= least).all() and (middle - ti.abs(half) <= most).all():
            for block in range(ti.select(m == other, own // BLOCK, first_block[other]), first_block[other + 1]):
                near = 0
                for k in range(BLOCK):
                    f = block * BLOCK + k
                    dx, dy, dz = mid_x[f] - x, mid_y[f] - y, mid_z[f] - z
                    squared = dx * dx + dy * dy + dz * dz
                    shadows = ti.abs(g * dx + h * dy + i * dz)
                    shadows += ti.abs(half_x[f] * dx + half_y[f] * dy + half_z[f] * dz)
                    beyond = ti.max(squared - shadows, 0.0)
                    near |= ti.select(beyond * beyond <= within * squared, 1, 0) << k
                if m == other and block == own // BLOCK:
                    # Each pair once: only edges after this one.
                    near &= -2 << (own % BLOCK)
                while near != 0:
                    there = block * BLOCK + lowest_bit(near)
                    near &= near - 1
                    f = edges[there]
                    if share_no_vertex(e, f) == 1:
                        between = ti.math.vec3(mid_x[there], mid_y[there], mid_z[there]) - middle
                        far_half = ti.math.vec3(half_x[there], half_y[there], half_z[there])
                        apart = distance_of_edges(-half, half, between - far_half, between + far_half)
                        if apart < reach[p]:
                            slot = ti.atomic_add(pieces[p][2], 1)
                            if slot < pieces[p][1]:
                                place_of_pair = pieces[p][0] + slot
                                # In this order, so that rounding does not depend on that of the patches.
                                pairs[place_of_pair] = ti.select(
                                    f[0] < e[0], Four(f[0], f[1], e[0], e[1]), Four(e[0], e[1], f[0], f[1])
                                )
                                wanted[place_of_pair], due[place_of_pair] = UNKNOWN, slack[p] - apart
                                soonest = ti.max(soonest, slack[p] - apart)
    ti.atomic_max(piece_due[p], soonest)


@fast_launch
@ti.kernel
def make_room(
    count: ti.i32, searched: Integers, pieces: Quadruples, end: Integers, again: Integers,
    edge_pieces: Quadruples, edge_end: Integers, edge_again: Integers,
) -> ti.math.ivec4:  # fmt: skip
    """After a search: pieces that were too short move to the end, empty.

    Returns how many of these there are, and where the end is now, of both lists. Their numbers are `again`; `end` has
    the end, then how many there are.
    """
    searched_end = count
    end[1], edge_end[1] = 0, 0
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for k in range(searched_end):
        lengthen(searched[k], pieces, end, again)
        lengthen(searched[k], edge_pieces, edge_end, edge_again)
    return ti.math.ivec4(end[1], end[0], edge_end[1], edge_end[0])


@ti.func
def lengthen(p: ti.i32, pieces: Quadruples, end: Integers, again: Integers):
    """Move a piece to the end if more was found than it has room for."""
    found = pieces[p][2]
    if found > pieces[p][1]:
        room = found + found // 2
        pieces[p] = Four(ti.atomic_add(end[0], room), room, 0, 0)
        again[ti.atomic_add(end[1], 1)] = p


@fast_launch
@ti.kernel
def carry_pieces(
    count: ti.i32, workers: ti.i32, taken: Integers, carried: Integers, pieces_before: Quadruples,
    piece_due_before: Floats, before: Quadruples, wanted_before: Floats, due_before: Floats, pieces: Quadruples,
    piece_due: Floats, pairs: Quadruples,
    wanted: Floats, due: Floats, end: Integers,
) -> ti.i32:  # fmt: skip
    """Pieces of the pairs of patches that were listed before, at the places of their numbers now; returns the end.

    Args:
        carried: numbers that pairs of patches had before, or -1.
    """
    end[0] = 0
    begin_sharing(taken, 0)
    for worker in range(workers):
        p = next_item(-1, worker, taken, 0, CARRIED_AT_A_TIME)
        while p < count:
            pieces[p], piece_due[p] = Four(0), NEVER
            if carried[p] >= 0:
                first, found = pieces_before[carried[p]][0], pieces_before[carried[p]][2]
                start = ti.atomic_add(end[0], found)
                pieces[p], piece_due[p] = Four(start, found, found, 0), piece_due_before[carried[p]]
                for k in range(found):
                    pairs[start + k] = before[first + k]
                    wanted[start + k], due[start + k] = wanted_before[first + k], due_before[first + k]
            p = next_item(p, worker, taken, 0, CARRIED_AT_A_TIME)
    return end[0]


@fast_launch
@ti.kernel
def find_near_pairs(
    count: ti.i32, lanes: ti.i32, workers: ti.i32, taken: Integers, due_pairs: Integers,
    pieces: Quadruples, piece_due: Floats, pairs: Quadruples, wanted: Floats, due: Floats,
    edge_pieces: Quadruples, edge_piece_due: Floats, edge_pairs: Quadruples, edge_wanted: Floats, edge_due: Floats,
    slack: Floats, left: Floats, approach: Floats, allowed: Floats,
    position: Vectors, displacement: Vectors, rest: Vectors, cloth: Integers,
    thickness: Floats, vertex_friction: Floats, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
):  # fmt: skip
    """Append the pairs that are nearer than they shall be, or get there, and those that might cross.

    The displacement along the line of shortest distance counts. A pair might cross when its vertices, displaced as
    they are now and by contacts besides, come together: then it is watched, `INACTIVE`. They come no nearer than by
    twice their motion against their mean, nor than by the `approach` [m] of their patches; contacts are `allowed` so
    much more [m]. Pairs that have been farther off than their patches have approached since are not even looked at.

    Args:
        count: number of pairs of patches that are looked at, `due_pairs`; `lanes` threads share one.
        workers, taken: see `sim.work_sharing`; twice as many items, as edges of a pair of patches are one of their own.
        pieces to due: of vertices with triangles, see `PairList`; `edge_pieces` to `edge_due` of edges.
    """
    begin_sharing(taken, 0)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, DUE_AT_A_TIME)
        while item < 2 * count * lanes:
            if item < count * lanes:
                look_at_piece(
                    due_pairs[item // lanes], item % lanes, lanes, pieces, piece_due, pairs, wanted, due, slack, left,
                    approach, allowed, False, position, displacement, rest, cloth, thickness, vertex_friction,
                    recovery, vertices, weights, normal, floor, kind, arm, friction, counter, capacity,
                )  # fmt: skip
            else:
                look_at_piece(
                    due_pairs[item // lanes - count], item % lanes, lanes, edge_pieces, edge_piece_due, edge_pairs,
                    edge_wanted, edge_due, slack, left, approach, allowed, True, position, displacement, rest, cloth,
                    thickness, vertex_friction, recovery, vertices, weights, normal, floor, kind, arm, friction,
                    counter, capacity,
                )  # fmt: skip
            item = next_item(item, worker, taken, 0, DUE_AT_A_TIME)


@ti.func
def look_at_piece(
    both: ti.i32, lane: ti.i32, lanes: ti.i32, pieces: Quadruples, piece_due: Floats, pairs: Quadruples,
    wanted: Floats, due: Floats, slack: Floats, left: Floats, approach: Floats, allowed: Floats,
    are_edges: ti.template(), position: Vectors, displacement: Vectors, rest: Vectors, cloth: Integers,
    thickness: Floats, vertex_friction: Floats, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
):  # fmt: skip
    """Look at the pairs of elements of one pair of patches that are due, as one of several threads."""
    soonest, is_left = NEVER, left[both]
    place, end = pieces[both][0] + lane, pieces[both][0] + pieces[both][2]
    while place < end:
        if due[place] >= is_left:
            due[place] = look_at_pair(
                place, pairs, wanted, slack[both], approach[both], allowed[both], are_edges, position, displacement,
                rest, cloth, thickness, vertex_friction, recovery, vertices, weights, normal, floor, kind, arm,
                friction, counter, capacity,
            )  # fmt: skip
        soonest = ti.max(soonest, due[place])
        place += lanes
    ti.atomic_max(piece_due[both], soonest)


@ti.func
def look_at_pair(
    p: ti.i32, pairs: Quadruples, wanted: Floats, slack: ti.f32, approach: ti.f32, allowed: ti.f32,
    are_edges: ti.template(), position: Vectors, displacement: Vectors, rest: Vectors, cloth: Integers,
    thickness: Floats, vertex_friction: Floats, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.f32:  # fmt: skip
    """Append a pair if it has to be; returns when it is due [m]."""
    v = pairs[p]
    x, u = position[v[0]], displacement[v[0]]
    x1, x2, x3 = position[v[1]] - x, position[v[2]] - x, position[v[3]] - x
    zero = ti.math.vec3(0.0)
    weight = ti.math.vec4(0.0)
    part = 1.0
    if ti.static(are_edges):
        shares = closest_on_edges(zero, x1, x2, x3)
        weight = ti.math.vec4(1.0 - shares[0], shares[0], shares[1] - 1.0, -shares[1])
        # What is nearest at an end of an edge is a vertex, which is near to a triangle too.
        part = ti.select(ti.min(shares, 1.0 - shares).min() > END_OF_EDGE, OF_EDGES, 0.0)
    else:
        shares = closest_on_triangle(zero, x1, x2, x3)
        weight = ti.math.vec4(1.0, -shares[0], -shares[1], -shares[2])
    apart = weight[1] * x1 + weight[2] * x2 + weight[3] * x3
    distance = apart.norm()
    if distance < ti.max(0.5 * (thickness[v[0]] + thickness[v[2]]), approach + allowed):
        u1, u2, u3 = displacement[v[1]] - u, displacement[v[2]] - u, displacement[v[3]] - u
        mean = 0.25 * (u1 + u2 + u3)
        motion = ti.max(mean.norm(), (u1 - mean).norm(), (u2 - mean).norm(), (u3 - mean).norm())
        if wanted[p] == UNKNOWN:
            a, b, c, d = rest[v[0]], rest[v[1]], rest[v[2]], rest[v[3]]
            at_rest = distance_of_edges(a, b, c, d) if ti.static(are_edges) else distance_to_triangle(a, b, c, d)
            wanted[p] = pair_thickness(v[0], v[2], cloth, thickness, at_rest)
        keeps = part * wanted[p]
        if distance < ti.max(keeps, ti.min(2.0 * motion, approach) + allowed):
            across = x1.cross(x3 - x2) if ti.static(are_edges) else (x2 - x1).cross(x3 - x1)
            n = unit_or(apart, across)
            least = least_displacement(distance, keeps, recovery)
            slot = ti.atomic_add(counter[0], 1)
            if slot < capacity:
                pushes = distance < keeps or n.dot(weight[1] * u1 + weight[2] * u2 + weight[3] * u3) < least
                vertices[slot], weights[slot], normal[slot] = v, weight, n
                floor[slot] = ti.select(pushes and keeps > 0.0, least, INACTIVE)
                kind[slot] = EDGE_EDGE if ti.static(are_edges) else VERTEX_TRIANGLE
                arm[slot] = zero
                friction[slot] = ti.sqrt(vertex_friction[v[0]] * vertex_friction[v[2]])
    return slack - distance


@fast_launch
@ti.kernel
def range_of_vectors(
    vectors: Vectors, count: ti.i32, items: ti.i32, lane_step: ti.i32, item_step: ti.i32, partial: Floats,
    lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats, is_short: ti.template(),
) -> Results:  # fmt: skip
    """Largest components, then those of the negative vectors, six maxima."""
    if ti.static(is_short):
        ti.loop_config(serialize=True)
    for lane in range(lanes):
        most, least = ti.math.vec3(-FAR), ti.math.vec3(FAR)
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count:
                most, least = ti.max(most, vectors[i]), ti.min(least, vectors[i])
        for axis in ti.static(range(3)):
            partial[axis * lanes + lane], partial[(3 + axis) * lanes + lane] = most[axis], -least[axis]
    return reduced(partial, lanes, quantities, maxima, nodes)
