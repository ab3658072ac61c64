"""How thick the walls of a mesh are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.shapes.mesh_solid import MeshSolid
from sim.shapes.sampling import stratified_points

PROBES = 1000
"""Points of the surface below which the thickness is measured."""

TOUCHING = 0.9
"""A ball below a point of the surface fits into the solid if its middle has so much of its radius around it: facets of
round walls are nearer than their circle."""

HALVINGS = 14
"""Of the interval of radii, which starts with half the longest edge of the bounding box."""


def local_thickness(solid: MeshSolid) -> NDArray[np.float64]:
    """Diameters [m] of the largest balls in a solid that touch points of its surface, evenly spread by area, (p,).

    Between parallel walls that is their distance; beside a sharp edge it is small.
    """
    points, face = stratified_points(solid.mesh, PROBES)
    inwards = -solid.mesh.area_vectors[face]
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    low = np.zeros(len(points))
    high = np.full(len(points), 0.5 * float(np.ptp(solid.bounds, axis=0).max()))
    for _ in range(HALVINGS):
        radius = 0.5 * (low + high)
        fits = -solid.signed_distance(points + radius[:, None] * inwards) > TOUCHING * radius
        low, high = np.where(fits, radius, low), np.where(fits, high, radius)
    # Between parallel walls a distance d apart, d - r = TOUCHING * r of the largest r.
    return (1.0 + TOUCHING) * low


def wall_thickness(solid: MeshSolid, share: float) -> float:
    """Thickness [m] that all but a share [-] of a mesh's surface has at least."""
    return float(np.quantile(local_thickness(solid), share))
