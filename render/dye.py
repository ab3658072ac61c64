"""Dye of a fluid as its surface shows it: the mean of the particles around each vertex, and the dye behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.meshes import SurfaceMesh

SUPPORT_IN_RADII = 4.0
"""Width of the kernel, as in the simulation: a vertex has half of its neighbours there, a dozen."""
_NEIGHBOURS = 24

_MOST_CELLS = 2**25
"""Of the grid that dye is looked up in; a frame that needs more has wider ones than a spacing."""
_STEP_IN_CELLS = 0.5
_LEAST_FILLED = 0.3  # of a cell, of what is liquid; behind what is not the dye is another surface's
_SKIN_IN_CELLS = 1.5  # so deep below the surface cells are only partly filled


def dye_of(
    surface: SurfaceMesh, positions: ArrayLike, dye: ArrayLike | None, *, particle_radius: float
) -> dict[str, NDArray[np.float32]]:
    """What `write_ply` writes of the dye of particles beside their surface, by its names; nothing where they have none.

    Arguments are those of `dye_at`.
    """
    if dye is None:
        return {}
    assert surface.normals is not None
    at = dye_at(surface.vertices, positions, dye, particle_radius=particle_radius)
    behind = dye_behind(surface.vertices, surface.normals, positions, dye, particle_radius=particle_radius)
    return {"dye": at, "dye_behind": behind}


def dye_at(vertices: ArrayLike, positions: ArrayLike, dye: ArrayLike, *, particle_radius: float) -> NDArray[np.float32]:
    """Concentration of dye at vertices [-], (n, 1): sum_j c_j W_j / sum_j W_j, never beyond those of the particles.

    Args:
        vertices: (n, 3) [m]; one farther than the kernel from all particles has that of the nearest.
        positions: of the particles [m], (m, 3).
        dye: their concentrations [-], (m,).
        particle_radius: [m], half the spacing of the particles at rest.
    """
    from scipy.spatial import cKDTree

    places, concentrations = np.asarray(vertices), np.asarray(dye, dtype=np.float64)
    if len(places) == 0:
        return np.empty((0, 1), np.float32)
    count = min(_NEIGHBOURS, len(concentrations))
    distance, nearest = (
        each.reshape(len(places), count) for each in cKDTree(np.asarray(positions)).query(places, k=count)
    )
    outer = np.maximum(1.0 - distance / (SUPPORT_IN_RADII * particle_radius), 0.0)
    inner = np.maximum(0.5 - distance / (SUPPORT_IN_RADII * particle_radius), 0.0)
    weights = 2.0 * outer**3 - 8.0 * inner**3
    weights[:, 0] += np.where(weights.sum(axis=1) == 0.0, 1.0, 0.0)
    mean = (weights * concentrations[nearest]).sum(axis=1) / weights.sum(axis=1)
    found: NDArray[np.float32] = mean[:, None].astype(np.float32)
    return found


def dye_behind(
    vertices: ArrayLike, normals: ArrayLike, positions: ArrayLike, dye: ArrayLike, *, particle_radius: float
) -> NDArray[np.float32]:
    """Depth of dye of concentration 1 behind vertices [m], (n, 1): the integral of c along the normal, inwards.

    It ends where the liquid does. What light loses on its way through follows from it by the law of Beer and Lambert.

    Args:
        vertices: (n, 3) [m].
        normals: unit vectors that point out of the liquid, (n, 3).
        positions: of the particles [m], (m, 3).
        dye: their concentrations [-], (m,).
        particle_radius: [m], half the spacing of the particles at rest.
    """
    from scipy.ndimage import map_coordinates

    places, inwards = np.asarray(vertices, np.float64), -np.asarray(normals, np.float64)
    depth = np.zeros(len(places))
    if len(places) == 0 or not np.any(dye):
        return depth[:, None].astype(np.float32)
    grid = _Grid.of(np.asarray(positions, np.float64), np.asarray(dye, np.float64), 2.0 * particle_radius)
    step, skin = _STEP_IN_CELLS * grid.cell, _SKIN_IN_CELLS * grid.cell
    alive, way = np.arange(len(places)), 0.5 * step
    # No straight way through the grid is longer than its diagonal.
    while len(alive) and way < grid.diagonal:
        at = ((places[alive] + way * inwards[alive] - grid.origin) / grid.cell).T
        filled, dyed = (map_coordinates(each, at, order=1, prefilter=False) for each in (grid.filled, grid.dyed))
        is_inside = (filled >= _LEAST_FILLED) | (way < skin)
        depth[alive] += step * dyed * is_inside
        alive, way = alive[is_inside], way + step
    return depth[:, None].astype(np.float32)


@dataclass(frozen=True)
class _Grid:
    """Particles on a grid, each shared out among the eight points around it."""

    origin: NDArray[np.float64]
    cell: float
    filled: NDArray[np.float32]  # share of a cell that is liquid [-]
    dyed: NDArray[np.float32]  # the same times its concentration of dye [-]

    @classmethod
    def of(cls, positions: NDArray[np.float64], dye: NDArray[np.float64], spacing: float) -> _Grid:
        """The grid of particles of a spacing [m], with an empty point around it."""
        low, high = positions.min(axis=0), positions.max(axis=0)
        cell = max(spacing, float(np.prod(high - low + 4.0 * spacing) / _MOST_CELLS) ** (1.0 / 3.0))
        origin = low - 2.0 * cell
        counts = np.ceil((high - origin) / cell).astype(int) + 3
        at = (positions - origin) / cell
        base = np.floor(at).astype(int)
        beyond = at - base
        filled, dyed = (np.zeros(int(counts.prod())) for _ in range(2))
        volume = (spacing / cell) ** 3
        for corner in np.ndindex(2, 2, 2):
            weight = volume * np.prod(np.where(corner, beyond, 1.0 - beyond), axis=1)
            index = np.ravel_multi_index(tuple((base + corner).T), tuple(counts))
            filled += np.bincount(index, weight, len(filled))
            dyed += np.bincount(index, weight * dye, len(dyed))
        shaped = (each.reshape(counts).astype(np.float32) for each in (filled, dyed))
        return cls(origin, cell, *shaped)

    @property
    def diagonal(self) -> float:
        """From one corner to the opposite one [m]."""
        return float(self.cell * np.linalg.norm(self.filled.shape))
