"""Modelling with signed distances: rounded building blocks, smooth unions, and the mesh of the result.

Blocks and blends follow I. Quilez, "Distance functions" and "Smooth minimum" (2013-2024). Points are (n, 3), distances
(n,), negative inside. Those of ellipsoids and blends are approximate away from the surface, which is all that meshing
asks for; what the mesh encloses gets exact distances from `MeshSolid`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, reduce

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.solid import Points, TriangleMesh
from sim.shapes.tessellation import cut_along

Distances = NDArray[np.float64]
DistanceFunction = Callable[[Points], Distances]
Corner = tuple[float, float, float]

_CELL = 0.026  # edge of a cell of the duck and the bunny, in units of their models

_CELLS_PER_BLOCK = 4
_RELAXATION_ROUNDS = 3


def mirrored(points: Points) -> Points:
    """Points folded to y >= 0: what is modelled there appears on both sides."""
    return points * [1.0, 0.0, 1.0] + np.abs(points) * [0.0, 1.0, 0.0]


def ellipsoid(points: Points, centre: Corner, radii: Corner, rotation_deg: Corner = (0.0, 0.0, 0.0)) -> Distances:
    """An ellipsoid turned about x, then y, then z around its centre."""
    local = points - np.asarray(centre)
    if any(rotation_deg):
        local = local @ Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    scaled = np.linalg.norm(local / radii, axis=1)
    gradient = np.linalg.norm(local / np.square(radii), axis=1)
    return scaled * (scaled - 1.0) / np.maximum(gradient, 1.0e-9)


def round_cone(points: Points, start: Corner, end: Corner, start_radius: float, end_radius: float) -> Distances:
    """The hull of two balls."""
    axis = np.subtract(end, start)
    squared_length = axis @ axis
    radius_drop = start_radius - end_radius
    slant = squared_length - radius_drop**2
    from_start = points - np.asarray(start)
    along = from_start @ axis
    beyond = along - squared_length
    across = np.sum(np.square(from_start * squared_length - along[:, None] * axis), axis=1)
    k = np.sign(radius_drop) * radius_drop**2 * across
    at_end = np.sign(beyond) * slant * beyond**2 * squared_length > k
    at_start = np.sign(along) * slant * along**2 * squared_length < k
    side = (np.sqrt(across * slant / squared_length) + along * radius_drop) / squared_length - start_radius
    to_end = np.sqrt(across + beyond**2 * squared_length) / squared_length - end_radius
    to_start = np.sqrt(across + along**2 * squared_length) / squared_length - start_radius
    return np.where(at_end, to_end, np.where(at_start, to_start, side))


def smooth_union(a: Distances, b: Distances, blend: float) -> Distances:
    """Union whose seam is filled over a width of `blend`."""
    overlap = np.maximum(blend - np.abs(a - b), 0.0) / blend
    return np.minimum(a, b) - 0.25 * blend * overlap**2


def smooth_intersection(a: Distances, b: Distances, blend: float) -> Distances:
    """Intersection whose edge is rounded over a width of `blend`."""
    return -smooth_union(-a, -b, blend)


def smooth_difference(a: Distances, b: Distances, blend: float) -> Distances:
    """What of a is not in b, its edge rounded over a width of `blend`."""
    return smooth_intersection(a, -b, blend)


def mesh_parts(
    parts: Callable[[Points], Mapping[str, Distances]], lower: Sequence[float], upper: Sequence[float], cell: float
) -> TriangleMesh:
    """Closed mesh of the union of named parts, cut along their seams: no triangle belongs to two parts.

    Marching cubes, then a few rounds in which vertices move towards the mean of their neighbours and back onto the
    surface, which evens out the triangles. Seams are filleted over a cell: smooth shading finds no crease there. The
    box around the surface has a cell of margin.
    """

    def union(points: Points) -> Distances:
        return reduce(lambda a, b: smooth_union(a, b, cell), parts(points).values())

    mesh = _march(union, np.asarray(lower), np.asarray(upper), cell)
    mesh = TriangleMesh(_relax(mesh, union, cell), mesh.faces)
    names = tuple(parts(mesh.vertices[:1]))
    for name in names if len(names) > 1 else ():
        distances = dict(parts(mesh.vertices))
        own = distances.pop(name)
        mesh = cut_along(mesh, own - np.min(list(distances.values()), axis=0))
    nearest = np.argmin(list(parts(mesh.corners.mean(axis=1)).values()), axis=0)
    return TriangleMesh(mesh.vertices, mesh.faces, nearest.astype(np.int32), names)


def procedural_solid(
    parts: Callable[[Points], Mapping[str, Distances]], lower: Sequence[float], upper: Sequence[float], axis: int
) -> Callable[[float], MeshSolid]:
    """Builder of the solid that `mesh_parts` models, by its extent along an axis [m], its bounding box centred."""

    @cache
    def unit_mesh() -> TriangleMesh:
        mesh = mesh_parts(parts, lower, upper, _CELL)
        low, high = mesh.bounds
        extent = (high - low)[axis]
        return mesh.transformed(1.0 / extent, np.eye(3), -0.5 * (low + high) / extent)

    return lambda extent: MeshSolid(unit_mesh().transformed(extent, np.eye(3), np.zeros(3)))


def _march(function: DistanceFunction, lower: Points, upper: Points, cell: float) -> TriangleMesh:
    """Marching cubes that evaluates the function only in blocks of cells near the surface."""
    import igl

    block_edge = _CELLS_PER_BLOCK * cell
    blocks = np.ceil((upper - lower) / block_edge).astype(int)
    centres = lower + block_edge * (np.indices(blocks).reshape(3, -1).T + 0.5)
    at_centres = function(centres)
    # Twice the block's half diagonal: blended distances are off by less than that factor.
    near = np.abs(at_centres) < np.sqrt(3.0) * block_edge
    offsets = cell * (np.indices((_CELLS_PER_BLOCK,) * 3).reshape(3, -1).T - 0.5 * (_CELLS_PER_BLOCK - 1))
    values = np.repeat(at_centres[:, None], len(offsets), axis=1)
    values[near] = function((centres[near][:, None] + offsets).reshape(-1, 3)).reshape(-1, len(offsets))

    nodes = blocks * _CELLS_PER_BLOCK
    grid = values.reshape(*blocks, *(_CELLS_PER_BLOCK,) * 3).transpose(0, 3, 1, 4, 2, 5).reshape(nodes)
    positions = lower + cell * (np.indices(nodes).transpose(3, 2, 1, 0).reshape(-1, 3) + 0.5)  # x runs fastest
    vertices, faces, _ = igl.marching_cubes(np.ravel(grid, order="F"), positions, *map(int, nodes), 0.0)
    mesh = TriangleMesh(vertices, faces.astype(np.int32))
    return mesh if mesh.signed_volume > 0.0 else TriangleMesh(vertices, mesh.faces[:, ::-1])


def _relax(mesh: TriangleMesh, union: DistanceFunction, cell: float) -> Points:
    vertices, count = mesh.vertices, len(mesh.vertices)
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    adjacency = csr_array((np.ones(len(edges)), edges.T), shape=(count, count))  # closed: every edge both ways
    neighbours = adjacency.sum(axis=1)[:, None]
    for _ in range(_RELAXATION_ROUNDS):
        # Two steps of averaging for one of projection: evaluating the model is what takes the time.
        averaged = adjacency @ vertices / neighbours
        averaged = 0.5 * (averaged + adjacency @ averaged / neighbours)
        vertices = _project(averaged, union, cell)
    return vertices


def _project(points: Points, function: DistanceFunction, cell: float) -> Points:
    """One Newton step onto the zero level, of at most a cell."""
    step = 0.01 * cell
    value = function(points)
    gradient = np.stack([(function(points + offset) - value) / step for offset in step * np.eye(3)], axis=1)
    length = value / np.maximum(np.sum(gradient**2, axis=1), 0.05)
    return points - np.clip(length, -cell, cell)[:, None] * gradient
