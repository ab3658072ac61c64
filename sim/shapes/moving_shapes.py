"""Shapes of bodies on the device, where the bodies are, and how they move."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Matrices, Vectors
from sim.core.bundles import bundle, func
from sim.core.host_access import put
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.device_shapes import DeviceShapes, Shapes, distance_to, surface_motion

Float64Array = NDArray[np.float64]


@bundle
class Bodies(NamedTuple):
    """Bodies, (b,) each."""

    shapes: Shapes
    centre_of_mass: Vectors  # in the frame of the shape [m]
    position: Vectors  # of the centre of mass [m]
    rotation: Matrices
    velocity: Vectors  # [m/s]
    spin: Vectors  # [1/s]


class MovingShapes:
    """The shapes of some bodies on the device, where these are.

    Attributes:
        bodies: for kernels.
        shapes: of the bodies.
    """

    def __init__(self, geometries: Sequence[BodyGeometry]) -> None:
        self.shapes, room = DeviceShapes(geometries), max(len(geometries), 1)
        position, velocity, spin = (ti.Vector.ndarray(3, ti.f32, room) for _ in range(3))
        rotation = ti.Matrix.ndarray(3, 3, ti.f32, room)
        self.bodies = Bodies(self.shapes.on_device, self.shapes.centre_of_mass, position, rotation, velocity, spin)

    def put(
        self, position: Float64Array, rotation: Float64Array, velocity: Float64Array, spin: Float64Array, time_s: float
    ) -> None:
        """Place all bodies, (b, 3), (b, 3, 3), (b, 3) and (b, 3), as they are at a time [s]."""
        self.shapes.deform(time_s, 1.0)
        bodies = self.bodies
        for array, values in (
            (bodies.position, position),
            (bodies.rotation, rotation),
            (bodies.velocity, velocity),
            (bodies.spin, spin),
        ):
            put(array, values)


@func
def distance_of(x: ti.math.vec3, body: ti.i32, bodies: Bodies) -> ti.f32:
    """Distance of a point of the world from a body [m], negative inside."""
    return distance_to(in_frame(x, body, bodies), body, bodies.shapes)


@func
def in_frame(x: ti.math.vec3, body: ti.i32, bodies: Bodies) -> ti.math.vec3:
    """A point of the world in the frame of a body's shape."""
    return bodies.rotation[body].transpose() @ (x - bodies.position[body]) + bodies.centre_of_mass[body]


@func
def velocity_at(x: ti.math.vec3, body: ti.i32, bodies: Bodies) -> ti.math.vec3:
    """Velocity of a body at a point of the world [m/s], v + omega x r, and that by which it deforms there."""
    velocity = bodies.velocity[body] + bodies.spin[body].cross(x - bodies.position[body])
    if ti.static(bodies.shapes.deforms):
        velocity += bodies.rotation[body] @ surface_motion(in_frame(x, body, bodies), body, bodies.shapes)
    return velocity


@func
def direction_out(y: ti.math.vec3, shape: ti.i32, step: ti.f32, shapes: Shapes) -> ti.math.vec3:
    """Outward normal of a shape at a point, in its frame, of differences of half a width `step` [m]."""
    slope = ti.math.vec3(0.0)
    for axis in ti.static(range(3)):
        offset = ti.math.vec3(0.0)
        offset[axis] = step
        slope[axis] = distance_to(y + offset, shape, shapes) - distance_to(y - offset, shape, shapes)
    return slope / ti.max(slope.norm(), 1.0e-30)
