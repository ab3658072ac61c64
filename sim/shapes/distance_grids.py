"""Grids of a body's distances, as cloth and smoke read them on the device, as fine as its walls need."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.level_set import LevelSet
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.placement import PlacedSolid
from sim.shapes.revolved import Revolved
from sim.shapes.sampling import stratified_points
from sim.shapes.solid import RestShape

CELLS = 96  # along the longest edge of a mesh: 1 cm of a body of 1 m, as coarse as cloth. More where walls are thin.
CELLS_PER_WALL = 2.0  # one cell has one layer of nodes inside, whose distances may be next to nothing
THIN_SHARE = 0.1  # share of a mesh's surface that may be thinner: what is beside its sharp edges always is
MOST_NODES = 2**24  # of one mesh: 64 MiB. That is 256 cells along each edge of a cube, and more of what is flat.
GRID_PADDING = 3.0  # how far the grid reaches past the mesh, in cells: distances beyond are upper bounds
EXACT_NODES = 2**21  # a larger grid, as thin walls need it, is exact near the surface only
EXACT_WITHIN = 2.0  # distance from the surface, in cells, up to which that one is exact
PROBES = 1000  # points of the surface below which the thickness is measured
TOUCHING = 0.9  # share of its radius that a ball must have around its middle: facets are nearer than their circle
HALVINGS = 14  # of the interval of radii, which starts with half the longest edge of the bounding box


def sampled_distances(solid: PlacedSolid, cell: float | None = None) -> LevelSet:
    """The grid of a mesh of cells with an edge [m], or fine enough for its walls."""
    cell = grid_spacing(solid, thin_wall(solid)) if cell is None else cell
    is_exact = _node_count(np.ptp(solid.bounds, axis=0), cell) <= EXACT_NODES
    within = np.inf if is_exact else EXACT_WITHIN * cell
    return LevelSet.sample(solid, cell, padding=GRID_PADDING * cell, exact_within=within)


def thin_wall(solid: PlacedSolid) -> float:
    """Thickness [m] that all of a body has but for `THIN_SHARE` of its surface; infinite for what is known by a formula
    on the device."""
    if not isinstance(solid.shape, MeshSolid | Revolved):
        return np.inf
    return solid.scale * wall_thickness(solid.shape, THIN_SHARE)


def grid_spacing(solid: PlacedSolid, wall: float, cells: int | None = None) -> float:
    """Edge of a cell [m] with which walls so thick [m] are felt, or as fine as `MOST_NODES` allow.

    The longest edge has so many cells at least, `CELLS` if not told.
    """
    extent = np.ptp(solid.bounds, axis=0)
    return max(min(float(extent.max()) / (cells or CELLS), wall / CELLS_PER_WALL), _finest_spacing(extent))


def _finest_spacing(extent: NDArray[np.float64]) -> float:
    """Edge of a cell [m] of the finest grid about a box with these edges [m], (3,), by bisection."""
    low, high = 0.0, float(extent.max())
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _node_count(extent, middle) > MOST_NODES else (low, middle)
    return high


def _node_count(extent: NDArray[np.float64], spacing: float) -> float:
    """Nodes of a grid about a box with these edges [m], (3,)."""
    return float(np.prod(np.ceil(extent / spacing + 2.0 * GRID_PADDING) + 1.0))


def local_thickness(solid: RestShape) -> NDArray[np.float64]:
    """Diameters [m] of the largest balls in a solid that touch points of its surface, evenly spread by area, (p,).

    Between parallel walls that is their distance; beside a sharp edge it is small.
    """
    mesh = solid.surface_mesh(None)
    points, face = stratified_points(mesh, PROBES)
    inwards = -mesh.area_vectors[face]
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    low = np.zeros(len(points))
    high = np.full(len(points), 0.5 * float(np.ptp(mesh.bounds, axis=0).max()))
    for _ in range(HALVINGS):
        radius = 0.5 * (low + high)
        fits = -solid.signed_distance(points + radius[:, None] * inwards) > TOUCHING * radius
        low, high = np.where(fits, radius, low), np.where(fits, high, radius)
    # Between parallel walls a distance d apart, d - r = TOUCHING * r of the largest r.
    return (1.0 + TOUCHING) * low


def wall_thickness(solid: RestShape, share: float) -> float:
    """Thickness [m] that all but a share [-] of a shape's surface has at least."""
    return float(np.quantile(local_thickness(solid), share))
