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
from sim.cloth.spatial_hash import Spheres, cell_of, slot_of
from sim.launch import fast_launch

Pairs = ti.types.ndarray(dtype=ti.types.vector(2, ti.i32), ndim=1)
Triples = ti.types.ndarray(dtype=ti.types.vector(3, ti.i32), ndim=1)
Two = ti.types.vector(2, ti.i32)
Four = ti.types.vector(4, ti.i32)
Six = ti.types.vector(6, ti.f32)

OF_REST_DISTANCE = 0.7
"""Elements that are nearer than their thickness when the cloth is flat keep this part of their distance there."""


OF_EDGES = 0.8
"""Part of the thickness that edges keep: between flat layers, whose edges cross four times as often as vertices meet
triangles, vertices alone then push."""

END_OF_EDGE = 1.0e-3
"""Share of an edge that counts as its end."""


@fast_launch
@ti.kernel
def enclose_elements(
    position: Vectors, edges: Pairs, edge_count: ti.i32, triangles: Triples, triangle_count: ti.i32,
    edge_spheres: Spheres, triangle_spheres: Spheres,
) -> ti.math.vec2:  # fmt: skip
    """Spheres around edges and triangles; returns the largest radius of each [m]."""
    largest_edge, largest_triangle = 0.0, 0.0
    for e in range(edge_count):
        a, b = position[edges[e][0]], position[edges[e][1]]
        radius = 0.5 * (b - a).norm()
        edge_spheres[e] = ti.math.vec4(0.5 * (a + b), radius)
        ti.atomic_max(largest_edge, radius)
    for t in range(triangle_count):
        a, b, c = position[triangles[t][0]], position[triangles[t][1]], position[triangles[t][2]]
        # Twice the area over the longest edge is small for slivers: the box's centre keeps their radius small too.
        low, high = ti.min(a, b, c), ti.max(a, b, c)
        centre = 0.5 * (low + high)
        radius = ti.max((a - centre).norm(), (b - centre).norm(), (c - centre).norm())
        triangle_spheres[t] = ti.math.vec4(centre, radius)
        ti.atomic_max(largest_triangle, radius)
    return ti.math.vec2(largest_edge, largest_triangle)


@ti.func
def may_meet(a: ti.i32, b: ti.i32, cloth: Integers, collides: Integers) -> ti.i32:
    """Whether elements at two vertices can touch: of different cloths always, of one if it collides with itself."""
    return ti.cast(cloth[a] != cloth[b] or collides[cloth[a]] == 1, ti.i32)


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


@fast_launch
@ti.kernel
def pair_vertices_with_triangles(
    vertex_count: ti.i32, position: Vectors, rest: Vectors, thickness: Floats, cloth: Integers, collides: Integers,
    triangles: Triples, spheres: Spheres, index: Integers, slot_start: Integers, mask: ti.i32,
    inverse_cell_size: ti.f32, radius: ti.f32, pairs: Quadruples, wanted: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """List each vertex with the triangles within `radius` [m] that it is no corner of; returns how many there are."""
    counter[0] = 0
    for v in range(vertex_count):
        x = position[v]
        cell = cell_of(ti.math.vec4(x, 0.0), inverse_cell_size)
        for row in range(9):
            dy, dz = row % 3 - 1, row // 3 - 1
            first_slot = slot_of(cell[0] - 1, cell[1] + dy, cell[2] + dz, mask)
            for part in range(2):
                # The three slots of the row, the second part of them where the table begins again.
                begin = ti.select(part == 0, first_slot, 0)
                end = ti.select(part == 0, ti.min(first_slot + 3, mask + 1), first_slot + 2 - mask)
                if end > begin:
                    for place in range(slot_start[begin], slot_start[end]):
                        sphere = spheres[place]
                        reach = sphere.w + radius
                        if (sphere.xyz - x).norm_sqr() < reach * reach:
                            other = cell_of(sphere, inverse_cell_size)
                            corners = triangles[index[place]]
                            own = ti.cast(v == corners[0] or v == corners[1] or v == corners[2], ti.i32)
                            in_row = ti.cast(other[1] == cell[1] + dy and other[2] == cell[2] + dz, ti.i32)
                            if own == 0 and in_row == 1 and may_meet(v, corners[0], cloth, collides) == 1:
                                a, b, c = position[corners[0]] - x, position[corners[1]] - x, position[corners[2]] - x
                                if distance_to_triangle(ti.math.vec3(0.0), a, b, c) < radius:
                                    slot = ti.atomic_add(counter[0], 1)
                                    if slot < capacity:
                                        at_rest = distance_to_triangle(
                                            rest[v], rest[corners[0]], rest[corners[1]], rest[corners[2]]
                                        )
                                        pairs[slot] = Four(v, corners[0], corners[1], corners[2])
                                        wanted[slot] = pair_thickness(v, corners[0], cloth, thickness, at_rest)
    return counter[0]


@ti.func
def are_surely_apart(between: ti.math.vec3, half_e: ti.math.vec3, half_f: ti.math.vec3, radius: ti.f32) -> ti.i32:
    """Whether edges are apart in their shadows on the line through their midpoints; true of most neighbours in flat
    cloth, which the spheres around them do not tell apart."""
    squared = between.norm_sqr()
    beyond = ti.max(squared - ti.abs(half_e.dot(between)) - ti.abs(half_f.dot(between)), 0.0)
    return ti.cast(beyond * beyond > radius * radius * squared, ti.i32)


@fast_launch
@ti.kernel
def gather_half_edges(position: Vectors, edges: Pairs, index: Integers, count: ti.i32, half_edges: Vectors):
    """Half the vector along each sorted edge."""
    for place in range(count):
        edge = edges[index[place]]
        half_edges[place] = 0.5 * (position[edge[1]] - position[edge[0]])


@fast_launch
@ti.kernel
def pair_edges(
    edge_count: ti.i32, position: Vectors, rest: Vectors, thickness: Floats, cloth: Integers, collides: Integers,
    edges: Pairs, half_edges: Vectors, spheres: Spheres, index: Integers, slot_start: Integers, mask: ti.i32,
    inverse_cell_size: ti.f32, radius: ti.f32, pairs: Quadruples, wanted: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """List the pairs of edges within `radius` [m] of each other that share no vertex; returns how many there are.

    Each edge looks into the cells after its own alone: of the rows that follow, and of its own row the next.
    """
    counter[0] = 0
    for place in range(edge_count):
        own = spheres[place]
        cell = cell_of(own, inverse_cell_size)
        e = edges[index[place]]
        x, half = own.xyz, half_edges[place]
        for row in range(5):
            # (0, 0), (1, 0), (-1, 1), (0, 1), (1, 1): half of the nine rows.
            dy = ti.select(row < 2, row, row - 3)
            dz = ti.select(row < 2, 0, 1)
            back = ti.select(row == 0, 0, 1)
            first_slot = slot_of(cell[0] - back, cell[1] + dy, cell[2] + dz, mask)
            last_slot = first_slot + 1 + back
            for part in range(2):
                begin = ti.select(part == 0, first_slot, 0)
                end = ti.select(part == 0, ti.min(last_slot, mask) + 1, last_slot - mask)
                if end > begin:
                    for other in range(slot_start[begin], slot_start[end]):
                        sphere = spheres[other]
                        between = sphere.xyz - x
                        if are_surely_apart(between, half, half_edges[other], radius) == 0:
                            there = cell_of(sphere, inverse_cell_size) - cell
                            is_meant = there[1] == dy and there[2] == dz and there[0] >= -back
                            if row == 0 and there[0] == 0:
                                is_meant = is_meant and other > place
                            f = edges[index[other]]
                            if is_meant and share_no_vertex(e, f) * may_meet(e[0], f[0], cloth, collides) == 1:
                                a, b = position[e[0]] - x, position[e[1]] - x
                                if distance_of_edges(a, b, position[f[0]] - x, position[f[1]] - x) < radius:
                                    slot = ti.atomic_add(counter[0], 1)
                                    if slot < capacity:
                                        at_rest = distance_of_edges(rest[e[0]], rest[e[1]], rest[f[0]], rest[f[1]])
                                        # In this order, so that rounding does not depend on the hash.
                                        pairs[slot] = Four(e[0], e[1], f[0], f[1])
                                        if f[0] < e[0]:
                                            pairs[slot] = Four(f[0], f[1], e[0], e[1])
                                        wanted[slot] = pair_thickness(e[0], f[0], cloth, thickness, at_rest)
    return counter[0]


@fast_launch
@ti.kernel
def find_near_pairs(
    pairs: Quadruples, wanted: Floats, count: ti.i32, are_edges: ti.template(),
    position: Vectors, displacement: Vectors, vertex_friction: Floats, margin: ti.f32, recovery: ti.f32,
    vertices: Quadruples, weights: Weights, normal: Vectors, floor: Floats, kind: Integers, arm: Vectors,
    friction: Floats, counter: Integers, capacity: ti.i32,
) -> ti.i32:  # fmt: skip
    """Append the pairs that are nearer than they shall be, or get there, and those that might cross.

    The displacement along the line of shortest distance counts. A pair might cross when its vertices, displaced as
    they are now and by up to `margin` [m] besides, come together: then it is watched, `INACTIVE`. Returns the number of
    contacts so far.
    """
    for p in range(count):
        v = pairs[p]
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
        if distance < ti.max(keeps, 2.0 * (motion + margin)):
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
