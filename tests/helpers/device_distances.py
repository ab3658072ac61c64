"""A kernel that asks for distances to a body, as contacts do."""

from sim.core.arrays import Floats, Vectors
from sim.core.launch import kernel
from sim.shapes.device_shapes import Shapes, distance_to


@kernel
def measure_distances(points: Vectors, shapes: Shapes, distances: Floats):
    """Distances to the first body [m] of points in the frame of its shape."""
    for i in range(points.shape[0]):
        distances[i] = distance_to(points[i], 0, shapes)
