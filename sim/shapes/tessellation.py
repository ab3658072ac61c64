"""Closed, outward-oriented triangle meshes of boxes, spheres and bodies of revolution."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points, TriangleMesh

SMOOTH_SUBDIVISIONS = 5  # subdivisions of an icosahedron that look round: 10 242 vertices, off by 0.03 % of the radius


def subdivide_polyline(points: Sequence[tuple[float, float]] | NDArray[np.float64], max_edge: float) -> Points:
    """A polyline (n, 2) with its segments cut evenly until none is longer than `max_edge`."""
    corners = np.asarray(points, dtype=np.float64)
    pieces = [corners[:1]]
    for start, end in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(end - start) / max_edge - 1.0e-9)))
        fraction = np.arange(1, count + 1)[:, None] / count
        pieces.append(start + fraction * (end - start))
    return np.concatenate(pieces)


def _quads_as_triangles(a: NDArray, b: NDArray, c: NDArray, d: NDArray) -> NDArray[np.int32]:
    """Two triangles for each quad with corners a, b, c, d counter-clockwise seen from outside."""
    return np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]).astype(
        np.int32
    )


def revolve(profile: Points, segments: int) -> TriangleMesh:
    """A profile (n, 2) of radius and z, from the axis at the bottom to the axis at the top, turned around z."""
    rings = profile[1:-1]
    ring_vertices = _turned_around_z(rings, segments)
    bottom, top = len(ring_vertices), len(ring_vertices) + 1
    vertices = np.concatenate([ring_vertices, [(0.0, 0.0, profile[0, 1]), (0.0, 0.0, profile[-1, 1])]])

    index = np.arange(len(rings) * segments).reshape(len(rings), segments)
    following = np.roll(index, -1, axis=1)
    sides = _quads_as_triangles(index[:-1], following[:-1], following[1:], index[1:])
    floor = np.stack([np.full(segments, bottom), following[0], index[0]], axis=1)
    ceiling = np.stack([np.full(segments, top), index[-1], following[-1]], axis=1)
    return TriangleMesh(vertices, np.concatenate([sides, floor, ceiling]).astype(np.int32))


def revolve_ring(profile: Points, segments: int) -> TriangleMesh:
    """A closed counter-clockwise profile (n, 2) of radius > 0 and z, turned around z."""
    vertices = _turned_around_z(profile, segments)
    index = np.arange(len(vertices)).reshape(len(profile), segments)
    following, above = np.roll(index, -1, axis=1), np.roll(index, -1, axis=0)
    return TriangleMesh(vertices, _quads_as_triangles(index, following, np.roll(following, -1, axis=0), above))


def _turned_around_z(profile: Points, segments: int) -> Points:
    """Vertices (n segments, 3) of rings through a profile (n, 2) of radius and z."""
    angle = np.arange(segments) * (2.0 * np.pi / segments)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heights = np.broadcast_to(profile[:, None, 1:], (len(profile), segments, 1))
    return np.concatenate([profile[:, None, :1] * around, heights], axis=2).reshape(-1, 3)


def icosphere(radius: float, max_edge: float) -> TriangleMesh:
    """A subdivided icosahedron with all vertices at `radius`."""
    import trimesh

    # An edge of the icosahedron is 1.0515 radii; each subdivision halves it, projection stretches it by < 1.2.
    needed = np.log2(1.0515 * 1.2 * radius / max_edge) if np.isfinite(max_edge) else 0.0
    mesh = trimesh.creation.icosphere(subdivisions=max(SMOOTH_SUBDIVISIONS, int(np.ceil(needed))), radius=radius)
    return TriangleMesh(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int32))


def grid_box(size: Sequence[float], max_edge: float) -> TriangleMesh:
    """A box centred on the origin, every face a grid of rectangles with edges of at most `max_edge`."""
    size = np.asarray(size, dtype=np.float64)
    cells = np.maximum(1, np.ceil(size / max_edge - 1.0e-9)).astype(int)
    ticks = [np.linspace(-0.5 * extent, 0.5 * extent, count + 1) for extent, count in zip(size, cells, strict=True)]
    lattice_index = np.arange(np.prod(cells + 1)).reshape(cells + 1)

    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        index = lattice_index.transpose(axis, u, v)  # u x v points along +axis
        for side, outward in ((index[0], False), (index[-1], True)):
            a, b, c, d = side[:-1, :-1], side[1:, :-1], side[1:, 1:], side[:-1, 1:]
            faces.append(_quads_as_triangles(a, b, c, d) if outward else _quads_as_triangles(a, d, c, b))

    used, compact = np.unique(np.concatenate(faces), return_inverse=True)
    i, j, k = np.unravel_index(used, cells + 1)
    vertices = np.stack([ticks[0][i], ticks[1][j], ticks[2][k]], axis=1)
    return TriangleMesh(vertices, compact.reshape(-1, 3).astype(np.int32))


def longest_edge(mesh: TriangleMesh) -> float:
    """Length of the longest edge [m]."""
    corners = mesh.corners
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())


def halve_long_edges(mesh: TriangleMesh, max_edge: float) -> TriangleMesh:
    """The same surface with edges longer than `max_edge` cut at their midpoints, in both triangles; parts are kept.

    A triangle becomes two, three or four. Of three, the shorter diagonal parts the two beside the shortest edge: no new
    edge is longer than sqrt(3)/2 of the triangle's longest, so that rounds of this come to an end.
    """
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique_edges, edge = np.unique(edges, axis=0, return_inverse=True)
    is_long = np.linalg.norm(np.diff(mesh.vertices[unique_edges], axis=1)[:, 0], axis=1) > max_edge
    vertices = np.concatenate([mesh.vertices, mesh.vertices[unique_edges[is_long]].mean(axis=1)])
    middle = (len(mesh.vertices) - 1 + np.cumsum(is_long))[edge].reshape(-1, 3)
    cut = is_long[edge].reshape(-1, 3)
    count = cut.sum(axis=1)

    # Turned so that a lone cut edge comes first, and a lone whole one.
    first = np.argmax(np.where((count == 1)[:, None], cut, ~cut), axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(mesh.faces, order, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, order, axis=1).T
    from_a = np.linalg.norm(vertices[a] - vertices[bc], axis=1)
    from_b = np.linalg.norm(vertices[b] - vertices[ca], axis=1)
    two, a_to_bc = count == 2, from_a <= from_b
    pieces = [
        (count == 0, [(a, b, c)]),
        (count == 1, [(a, ab, c), (ab, b, c)]),
        (two & a_to_bc, [(c, ca, bc), (a, b, bc), (a, bc, ca)]),
        (two & ~a_to_bc, [(c, ca, bc), (a, b, ca), (b, bc, ca)]),
        (count == 3, [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]),
    ]
    made = [(np.stack(corners, axis=1)[which], which) for which, each in pieces for corners in each]
    faces = np.concatenate([corners for corners, _ in made]).astype(np.int32)
    part = None if mesh.part is None else np.concatenate([mesh.part[which] for _, which in made])
    return TriangleMesh(vertices, faces, part, mesh.part_names)


def cut_along(mesh: TriangleMesh, values: NDArray[np.float64]) -> TriangleMesh:
    """Cut the triangles of a closed mesh where a function, given at its vertices, is zero; parts are dropped.

    Vertices beside the cut, within a fifth of an edge, move onto it, so that no slivers remain.
    """
    vertices, values = mesh.vertices.copy(), values.copy()
    edges = np.unique(np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    start, end = edges[np.prod(values[edges], axis=1) < 0.0].T
    fraction = values[start] / (values[start] - values[end])
    crossing = vertices[start] + fraction[:, None] * (vertices[end] - vertices[start])
    for near, vertex in ((fraction < 0.2, start), (fraction > 0.8, end)):
        vertices[vertex[near]] = crossing[near]
        values[vertex[near]] = 0.0

    edges = edges[np.prod(values[edges], axis=1) < 0.0]
    start, end = edges.T
    fraction = (values[start] / (values[start] - values[end]))[:, None]
    inserted = vertices[start] + fraction * (vertices[end] - vertices[start])
    edge_key = start * len(vertices) + end

    def on_edge(tail: NDArray, head: NDArray) -> NDArray:
        key = np.minimum(tail, head).astype(np.int64) * len(vertices) + np.maximum(tail, head)
        return len(vertices) + np.searchsorted(edge_key, key)

    sign = np.sign(values).astype(int)[mesh.faces]
    cut_edges = np.sum(sign * np.roll(sign, -1, axis=1) < 0, axis=1)
    pieces = [mesh.faces[cut_edges == 0]]

    # One edge cut, the opposite corner on the cut: turn the face so that this corner comes first.
    face = _turned_to_first(mesh.faces[cut_edges == 1], sign[cut_edges == 1] == 0)
    a, b, c = face.T
    pieces += [np.stack([a, b, on_edge(b, c)], axis=1), np.stack([a, on_edge(b, c), c], axis=1)]

    # Two edges cut: turn the face so that the corner alone on its side comes first.
    of_face = sign[cut_edges == 2]
    face = _turned_to_first(mesh.faces[cut_edges == 2], of_face == -of_face.sum(axis=1, keepdims=True))
    a, b, c = face.T
    ab, ca = on_edge(a, b), on_edge(c, a)
    pieces += [np.stack([a, ab, ca], axis=1), np.stack([ab, b, c], axis=1), np.stack([ab, c, ca], axis=1)]
    return TriangleMesh(np.concatenate([vertices, inserted]), np.concatenate(pieces).astype(np.int32))


def _turned_to_first(faces: NDArray, chosen: NDArray[np.bool_]) -> NDArray:
    """Faces with their corners rotated so that the one chosen corner (m, 3) comes first."""
    return np.take_along_axis(faces, (np.argmax(chosen, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
