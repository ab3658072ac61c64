"""Grids of a mesh's distances, as cloth that touches it and smoke that flows around it read them on the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.level_set import LevelSet
from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.placement import PlacedSolid
from sim.shapes.thickness import wall_thickness

CELLS = 96
"""Along the longest edge of a mesh: 1 cm of a body of 1 m, as coarse as cloth. More where walls are thin."""

CELLS_PER_WALL = 2.0
"""A wall of one cell has one layer of nodes inside, whose distances may be next to nothing; one of two is felt."""

THIN_SHARE = 0.1
"""Share of a mesh's surface that may be thinner: what is beside its sharp edges always is."""

MOST_NODES = 2**24
"""Of one mesh: 64 MiB. That is 256 cells along each edge of a cube, and more of what is flat."""

GRID_PADDING = 3.0
"""How far the grid reaches past the mesh, in cells: distances beyond are upper bounds."""

EXACT_NODES = 2**21
"""A grid of more nodes than this, as thin walls need it, is exact near the surface only; one of `CELLS` has fewer."""

EXACT_WITHIN = 2.0
"""Distance from the surface, in cells, up to which it is. Farther off distances only say that nothing touches, or where
out is."""


def sampled_distances(solid: PlacedSolid) -> LevelSet:
    """The grid of a mesh, fine enough for its walls."""
    cell = grid_spacing(solid, thin_wall(solid))
    is_exact = _node_count(np.ptp(solid.bounds, axis=0), cell) <= EXACT_NODES
    within = np.inf if is_exact else EXACT_WITHIN * cell
    return LevelSet.sample(solid, cell, padding=GRID_PADDING * cell, exact_within=within)


def thin_wall(solid: PlacedSolid) -> float:
    """Thickness [m] that all of a mesh has but for `THIN_SHARE` of its surface; infinite for primitives."""
    if not isinstance(solid.shape, MeshSolid):
        return np.inf
    return solid.scale * wall_thickness(solid.shape, THIN_SHARE)


def grid_spacing(solid: PlacedSolid, wall: float) -> float:
    """Edge of a cell [m] with which walls so thick [m] are felt, or as fine as `MOST_NODES` allow."""
    extent = np.ptp(solid.bounds, axis=0)
    return max(min(float(extent.max()) / CELLS, wall / CELLS_PER_WALL), _finest_spacing(extent))


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
