"""Droplets of a fluid's surface: what stands for spray is drawn finer than the particles that it was computed with.

The contour gives a lone particle a ball of its whole volume. Such balls are all of one size and look like marbles,
where real water would break up into much finer drops.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.meshes import SurfaceMesh

DROPLET_PARTICLES = 8
"""A part of this many particles keeps its size: it is two particles thick, and the smoothing may round it off."""

_LARGEST_DROPLET = 3.0
"""Parts larger than this many times `DROPLET_PARTICLES` are none, whatever is in them: a wide smoothing length gives a
lone particle up to three times its volume."""


def shrink_droplets(mesh: SurfaceMesh, positions: ArrayLike, *, particle_radius: float, size: float) -> SurfaceMesh:
    """Scale the connected parts of a few particles about their middle.

    A part of one particle becomes `size` times as wide, one of `DROPLET_PARTICLES` or more stays as it is, and in
    between the factor grows evenly with the particles, so that nothing jumps far in size where drops meet or part.
    Cavities stay as they are.

    Args:
        mesh: a closed surface; it is returned as it is where `size` is 1 or there is no droplet.
        positions: of the particles [m], (n, 3), float32.
        particle_radius: [m], half the spacing of the particles at rest.
        size: of a droplet of one particle, relative to its contour [-], in (0, 1].
    """
    if size == 1.0 or len(mesh.faces) == 0:
        return mesh
    from scipy.spatial import cKDTree

    part, volumes = connected_parts(mesh)
    largest = _LARGEST_DROPLET * DROPLET_PARTICLES * (2.0 * particle_radius) ** 3
    vertices = np.flatnonzero(((volumes > 0.0) & (volumes < largest))[part])
    if len(vertices) == 0:
        return mesh
    # Every particle of so small a part lies below its surface, and so is the nearest one of some vertex.
    _, nearest = cKDTree(positions).query(mesh.vertices[vertices])
    pairs = np.unique(np.stack([part[vertices], nearest], axis=1), axis=0)
    particles = np.bincount(pairs[:, 0], minlength=len(volumes))
    share = np.clip((particles - 1) / (DROPLET_PARTICLES - 1), 0.0, 1.0)
    factors = (size + (1.0 - size) * share)[part[vertices], None]

    corners = mesh.vertices[vertices].astype(np.float64)
    counts = np.bincount(part[vertices], minlength=len(volumes))[:, None]
    sums = np.stack([np.bincount(part[vertices], column, minlength=len(volumes)) for column in corners.T], axis=1)
    middles = (sums / np.maximum(counts, 1))[part[vertices]]
    shrunk = mesh.vertices.copy()
    shrunk[vertices] = middles + factors * (corners - middles)
    return replace(mesh, vertices=shrunk)


def connected_parts(mesh: SurfaceMesh) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Which part each vertex belongs to, (n,), and the volume that each part encloses [m³], negative for a cavity."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([mesh.faces[:, :2], mesh.faces[:, 1:]])
    graph = coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(len(mesh.vertices),) * 2)
    count, labels = connected_components(graph, directed=False)
    part: NDArray[np.int32] = labels
    a, b, c = (mesh.vertices[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
    return part, np.asarray(np.bincount(part[mesh.faces[:, 0]], volumes, minlength=count), np.float64)
