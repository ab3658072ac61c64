"""Repairs of triangle meshes as files hold them: merging, orienting, capping. Pure: arrays in, arrays out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points, TriangleMesh, boundary_edges

Faces = NDArray[np.int64]

_MERGE_DISTANCE = 1.0e-6  # of vertices that are one, in bounding-box diagonals: what float32 can tell apart
_CAVITY_PROBES = 256  # about how many vertices of a closed patch are asked whether they lie inside of the rest


def merge_vertices(vertices: Points, faces: Faces) -> tuple[Points, Faces]:
    """Join vertices in the same place, and drop those that no face uses."""
    diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
    snapped = np.round((vertices - vertices.min(axis=0)) / (_MERGE_DISTANCE * diagonal)).astype(np.int64)
    _, first, merged = np.unique(snapped, axis=0, return_index=True, return_inverse=True)
    used, faces = np.unique(merged.reshape(-1)[faces], return_inverse=True)
    return vertices[first[used]], faces.reshape(-1, 3)


def drop_collapsed_and_repeated_faces(faces: Faces) -> Faces:
    """Without the faces that have a corner twice, and without second copies of a face."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    smallest_first = np.argmin(faces, axis=1)[:, None]
    canonical = np.take_along_axis(faces, (smallest_first + np.arange(3)) % 3, axis=1)
    _, first = np.unique(canonical, axis=0, return_index=True)
    return faces[np.sort(first)]


def boundary_loops(faces: Faces) -> list[list[int]]:
    """The boundary as simple loops of vertices; a boundary always closes, as it is one."""
    following: dict[int, list[int]] = {}
    for start, end in boundary_edges(faces)[::-1].tolist():
        following.setdefault(start, []).append(end)
    loops = []
    for start in list(following):
        while following[start]:
            path, place = [start], {start: 0}
            while following[path[-1]]:
                vertex = following[path[-1]].pop()
                if vertex not in place:
                    place[vertex] = len(path)
                    path.append(vertex)
                    continue
                loop = path[place[vertex] :]
                loops.append(loop)
                del path[place[vertex] + 1 :]
                for left in loop[1:]:
                    del place[left]
    return loops


def cap_holes(vertices: Points, faces: Faces, loops: list[list[int]]) -> tuple[Points, Faces]:
    """Close every loop with a fan around its centroid; returns all vertices, and the caps alone.

    A loop around a lone triangle is left open: its cap would be the triangle's own back.
    """
    own = {tuple(corners) for corners in np.sort(faces, axis=1).tolist()}
    centres: list[NDArray[np.float64]] = []
    caps: list[tuple[int, int, int]] = []
    for loop in loops:
        if len(loop) == 3:
            if tuple(sorted(loop)) not in own:
                caps.append((loop[2], loop[1], loop[0]))
            continue
        centre = len(vertices) + len(centres)
        centres.append(vertices[loop].mean(axis=0))
        caps.extend((end, start, centre) for start, end in zip(loop, [*loop[1:], loop[0]], strict=True))
    if centres:
        vertices = np.concatenate([vertices, centres])
    return vertices, np.array(caps, dtype=np.int64).reshape(-1, 3)


def orient_outward(vertices: Points, faces: Faces) -> tuple[Faces, int]:
    """Turn faces so that neighbours agree and normals point out; returns the faces and how many were turned.

    Neighbours across an edge of two faces are made to agree with the majority of their patch. Then the whole mesh is
    turned if it encloses a negative volume, and each closed patch that does so without being a cavity, which is one
    that lies inside of the rest.
    """
    import igl

    agreeing, patch = igl.bfs_orient(faces)
    turned = _orientation_sign(agreeing) != _orientation_sign(faces)
    majority_turned = np.bincount(patch, weights=turned) > 0.5 * np.bincount(patch)
    oriented = _turn(agreeing, majority_turned[patch])

    centred = vertices - vertices.mean(axis=0)
    capped_vertices, caps = cap_holes(centred, oriented, boundary_loops(oriented))
    whole = TriangleMesh(capped_vertices, np.concatenate([oriented, caps]).astype(np.int32))
    if whole.signed_volume < 0.0:
        oriented = _turn(oriented, np.ones(len(oriented), dtype=bool))
    oriented = _turn_closed_patches(centred, oriented, patch)
    return oriented, int(np.count_nonzero(_orientation_sign(oriented) != _orientation_sign(faces)))


def _turn_closed_patches(vertices: Points, faces: Faces, patch: NDArray[np.int64]) -> Faces:
    import igl

    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volume = np.bincount(patch, weights=np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    for inverted in np.flatnonzero(volume < 0.0):
        own = patch == inverted
        if len(boundary_edges(faces[own])):
            continue
        others = faces[~own]
        if len(others):
            corners = np.unique(faces[own])
            probes = vertices[corners[:: 1 + len(corners) // _CAVITY_PROBES]]
            if np.all(igl.winding_number(vertices, others, probes) > 0.5):
                continue  # a cavity
        faces = _turn(faces, own)
    return faces


def _turn(faces: Faces, which: NDArray[np.bool_]) -> Faces:
    return np.where(which[:, None], faces[:, ::-1], faces)


def _orientation_sign(faces: Faces) -> NDArray[np.bool_]:
    """Whether the corners, by index, are an even permutation of their order."""
    a, b, c = faces.T
    return (a < b) ^ (b < c) ^ (c < a)
