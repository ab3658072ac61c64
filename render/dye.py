"""Dye of a fluid on its surface: the mean of the particles around each vertex, weighed by the kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

SUPPORT_IN_RADII = 4.0
"""Width of the kernel, as in the simulation: a vertex has half of its neighbours there, a dozen."""
_NEIGHBOURS = 24


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
