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

Pairs = ti.types.ndarray(dtype=ti.types.vector(2, ti.i32), ndim=1)
Triples = ti.types.ndarray(dtype=ti.types.vector(3, ti.i32), ndim=1)
Two = ti.types.vector(2, ti.i32)
Four = ti.types.vector(4, ti.i32)
Spheres = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)
Six = ti.types.vector(6, ti.f32)

OF_REST_DISTANCE = 0.7
"""Elements that are nearer than their thickness when the cloth is flat keep this part of their distance there."""


OF_EDGES = 0.8
"""Part of the thickness that edges keep: between flat layers, whose edges cross four times as often as vertices meet
triangles, vertices alone then push."""

END_OF_EDGE = 1.0e-3
"""Share of an edge that counts as its end."""

LANES = 8
"""Threads that search a pair of patches: enough to share out the work of a few of them."""

NONE = -1
"""In the place of a vertex: the list has no pair there."""


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
def pair_vertex_with_triangles(
    v: ti.i32, first: ti.i32, last: ti.i32, position: Vectors, triangles: Triples, reach: ti.f32,
    p: ti.i32, start: Integers, room: Integers, found: Integers, pairs: Quadruples,
):  # fmt: skip
    """List a vertex with those of some triangles within `reach` [m] that it is no corner of."""
    x = position[v]
    for t in range(first, last):
        corners = triangles[t]
        a, b, c = position[corners[0]] - x, position[corners[1]] - x, position[corners[2]] - x
        if (ti.min(a, b, c) < reach).all() and (ti.max(a, b, c) > -reach).all():
            own = ti.cast(v == corners[0] or v == corners[1] or v == corners[2], ti.i32)
            if own == 0 and distance_to_triangle(ti.math.vec3(0.0), a, b, c) < reach:
                place = ti.atomic_add(found[p], 1)
                if place < room[p]:
                    pairs[start[p] + place] = Four(v, corners[0], corners[1], corners[2])


@fast_launch
@ti.kernel
def pair_vertices_with_triangles(
    count: ti.i32, searched: Integers, patches: Pairs, low: Vectors, high: Vectors, reach: Floats, position: Vectors,
    first_vertex: Integers, vertices: Integers, first_triangle: Integers, triangles: Triples,
    start: Integers, room: Integers, found: Integers, pairs: Quadruples,
):  # fmt: skip
    """List the vertices of each of two patches with the triangles of the other within `reach` [m] of them.

    Args:
        count: number of pairs of patches that are searched; their numbers are `searched`.
        start, room: where pairs of elements are listed, and how many fit; `found` gets how many there are.
    """
    for item in range(count * LANES):
        p = searched[item // LANES]
        for side in range(2):
            m, other = patches[p][side], patches[p][1 - side]
            if side == 0 or m != other:
                least, most = low[other] - reach[p], high[other] + reach[p]
                place = first_vertex[m] + item % LANES
                while place < first_vertex[m + 1]:
                    v = vertices[place]
                    if (position[v] >= least).all() and (position[v] <= most).all():
                        pair_vertex_with_triangles(
                            v, first_triangle[other], first_triangle[other + 1], position, triangles, reach[p],
                            p, start, room, found, pairs,
                        )  # fmt: skip
                    place += LANES


@ti.func
def are_surely_apart(between: ti.math.vec3, half_e: ti.math.vec3, half_f: ti.math.vec3, radius: ti.f32) -> ti.i32:
    """Whether edges are apart in their shadows on the line through their midpoints; true of most neighbours in flat
    cloth, which the spheres around them do not tell apart."""
    squared = between.norm_sqr()
    beyond = ti.max(squared - ti.abs(half_e.dot(between)) - ti.abs(half_f.dot(between)), 0.0)
    return ti.cast(beyond * beyond > radius * radius * squared, ti.i32)


@fast_launch
@ti.kernel
def enclose_edges(count: ti.i32, position: Vectors, edges: Pairs, half_edges: Vectors, spheres: Spheres):
    """Half the vector along each edge, and the sphere around it: midpoint and radius [m]."""
    for e in range(count):
        a, b = position[edges[e][0]], position[edges[e][1]]
        half_edges[e] = 0.5 * (b - a)
        spheres[e] = ti.math.vec4(0.5 * (a + b), half_edges[e].norm())


@fast_launch
@ti.kernel
def pair_edges(
    count: ti.i32, searched: Integers, patches: Pairs, low: Vectors, high: Vectors, reach: Floats,
    first_edge: Integers, edges: Pairs, half_edges: Vectors, spheres: Spheres,
    start: Integers, room: Integers, found: Integers, pairs: Quadruples,
):  # fmt: skip
    """List the edges of two patches that are within `reach` [m] of each other and share no vertex; as above."""
    for item in range(count * LANES):
        p = searched[item // LANES]
        m, other = patches[p][0], patches[p][1]
        least, most = low[other] - reach[p], high[other] + reach[p]
        place = first_edge[m] + item % LANES
        while place < first_edge[m + 1]:
            e, half, sphere = edges[place], half_edges[place], spheres[place]
            x = sphere.xyz
            if (x + ti.abs(half) >= least).all() and (x - ti.abs(half) <= most).all():
                for there in range(ti.select(m == other, place + 1, first_edge[other]), first_edge[other + 1]):
                    between = spheres[there].xyz - x
                    within = reach[p] + sphere.w + spheres[there].w
                    if between.norm_sqr() < within * within:
                        f, other_half = edges[there], half_edges[there]
                        is_near = are_surely_apart(between, half, other_half, reach[p]) == 0
                        is_near = is_near and share_no_vertex(e, f) == 1
                        slot = room[p]
                        if (
                            is_near
                            and distance_of_edges(-half, half, between - other_half, between + other_half) < reach[p]
                        ):
                            slot = ti.atomic_add(found[p], 1)
                        if slot < room[p]:
                            # In this order, so that rounding does not depend on that of the patches.
                            pairs[start[p] + slot] = ti.select(
                                f[0] < e[0], Four(f[0], f[1], e[0], e[1]), Four(e[0], e[1], f[0], f[1])
                            )
            place += LANES


@fast_launch
@ti.kernel
def clear_lists(
    count: ti.i32, searched: Integers, start: Integers, room: Integers, found: Integers, pairs: Quadruples
):  # fmt: skip
    """Empty the lists of the pairs of patches that are searched."""
    for k in range(count):
        p = searched[k]
        for place in range(start[p], start[p] + room[p]):
            pairs[place] = Four(NONE)
        found[p] = 0


@fast_launch
@ti.kernel
def make_room(
    count: ti.i32, searched: Integers, start: Integers, room: Integers, found: Integers, pairs: Quadruples,
    end: Integers, again: Integers,
) -> ti.math.ivec2:  # fmt: skip
    """Move lists that were too short to the end; returns how many, and where the end is now.

    Their numbers are `again`; `end` has the end, then how many there are.
    """
    end[1] = 0
    for k in range(count):
        p = searched[k]
        if found[p] > room[p]:
            for place in range(start[p], start[p] + room[p]):
                pairs[place] = Four(NONE)
            room[p] = found[p] + found[p] // 2
            start[p] = ti.atomic_add(end[0], room[p])
            again[ti.atomic_add(end[1], 1)] = p
    return ti.math.ivec2(end[1], end[0])


@fast_launch
@ti.kernel
def keep_distances(
    count: ti.i32, searched: Integers, start: Integers, found: Integers, pairs: Quadruples, are_edges: ti.template(),
    rest: Vectors, cloth: Integers, thickness: Floats, wanted: Floats, patches: Integers,
):  # fmt: skip
    """Distances that the listed elements keep [m], and the number of their pair of patches."""
    for k in range(count):
        p = searched[k]
        for place in range(start[p], start[p] + found[p]):
            v = pairs[place]
            a, b, c, d = rest[v[0]], rest[v[1]], rest[v[2]], rest[v[3]]
            at_rest = distance_of_edges(a, b, c, d) if ti.static(are_edges) else distance_to_triangle(a, b, c, d)
            patches[place] = p
            wanted[place] = pair_thickness(v[0], v[2], cloth, thickness, at_rest)


@fast_launch
@ti.kernel
def find_near_pairs(
    pairs: Quadruples, wanted: Floats, patches: Integers, approach: Floats, count: ti.i32, are_edges: ti.template(),
    position: Vectors, displacement: Vectors, vertex_friction: Floats, margin: ti.f32, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """Append the pairs that are nearer than they shall be, or get there, and those that might cross.

    The displacement along the line of shortest distance counts. A pair might cross when its vertices, displaced as
    they are now and by up to `margin` [m] besides, come together: then it is watched, `INACTIVE`. They come no nearer
    than by twice their motion against their mean, nor than by the `approach` [m] of their `patches`. Returns the number
    of contacts so far.
    """
    for p in range(count):
        v = pairs[p]
        if v[0] == NONE:
            continue
        x, u = position[v[0]], displacement[v[0]]
        x1, x2, x3 = position[v[1]] - x, position[v[2]] - x, position[v[3]] - x
        u1, u2, u3 = displacement[v[1]] - u, displacement[v[2]] - u, displacement[v[3]] - u
        zero = ti.math.vec3(0.0)
        weight = ti.math.vec4(0.0)
        across = ti.math.vec3(0.0)
        keeps = wanted[p]
        if ti.static(are_edges):
            shares = closest_on_edges(zero, x1, x2, x3)
            weight = ti.math.vec4(1.0 - shares[0], shares[0], shares[1] - 1.0, -shares[1])
            across = x1.cross(x3 - x2)
            # What is nearest at an end of an edge is a vertex, which is near to a triangle too.
            keeps *= ti.select(ti.min(shares, 1.0 - shares).min() > END_OF_EDGE, OF_EDGES, 0.0)
        else:
            shares = closest_on_triangle(zero, x1, x2, x3)
            weight = ti.math.vec4(1.0, -shares[0], -shares[1], -shares[2])
            across = (x2 - x1).cross(x3 - x1)
        apart = weight[1] * x1 + weight[2] * x2 + weight[3] * x3
        distance = apart.norm()
        mean = 0.25 * (u1 + u2 + u3)
        motion = ti.max(mean.norm(), (u1 - mean).norm(), (u2 - mean).norm(), (u3 - mean).norm())
        if distance < ti.max(keeps, ti.min(2.0 * motion, approach[patches[p]]) + 2.0 * margin):
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
    return counter[0]


@fast_launch
@ti.kernel
def largest_change(vectors: Vectors, before: Vectors, count: ti.i32) -> ti.f32:
    """Largest distance of vectors from what they were."""
    largest = 0.0
    for i in range(count):
        ti.atomic_max(largest, (vectors[i] - before[i]).norm())
    return largest


@fast_launch
@ti.kernel
def copy_vectors(vectors: Vectors, count: ti.i32, copy: Vectors):
    """Keep what vectors are."""
    for i in range(count):
        copy[i] = vectors[i]


@fast_launch
@ti.kernel
def range_of_vectors(vectors: Vectors, count: ti.i32) -> Six:
    """Largest components, then those of the negative vectors; exact in any order."""
    large_x, large_y, large_z = -1.0e30, -1.0e30, -1.0e30
    small_x, small_y, small_z = -1.0e30, -1.0e30, -1.0e30
    for i in range(count):
        ti.atomic_max(large_x, vectors[i][0])
        ti.atomic_max(large_y, vectors[i][1])
        ti.atomic_max(large_z, vectors[i][2])
        ti.atomic_max(small_x, -vectors[i][0])
        ti.atomic_max(small_y, -vectors[i][1])
        ti.atomic_max(small_z, -vectors[i][2])
    return Six(large_x, large_y, large_z, small_x, small_y, small_z)
