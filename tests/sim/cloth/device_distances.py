"""A kernel that asks for distances to a body, as contacts do."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.rigid.shape_distances import CountTriples, distance_at


@ti.kernel
def measure_distances(
    points: Vectors, kind: Integers, size: Vectors, grid_values: Floats, grid_first: Integers, grid_origin: Vectors,
    grid_spacing: Floats, grid_shape: CountTriples, distances: Floats,
):  # fmt: skip
    """Distances to the first body [m] of points in the frame of its shape."""
    for i in range(points.shape[0]):
        distances[i] = distance_at(
            points[i], 0, kind, size, grid_values, grid_first, grid_origin, grid_spacing, grid_shape
        )
