"""Extents of shapes by their numbers alone, without any file or mesh: how much room a shape needs, and gives."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim.shapes.parameters import (
    BoxShape,
    CapsuleShape,
    CompoundShape,
    ConeShape,
    CylinderShape,
    PieceShape,
    RevolvedShape,
    Shape,
    SphereShape,
    TorusShape,
)

DUCK_BALL, BUNNY_BALL = 0.7240, 0.6728
"""Radii of balls around the box of a duck 1 m long and of a bunny 1 m high [m]."""


def ball_around(shape: Shape) -> float | None:
    """Radius of a ball about a shape's centre that it is in [m]; None for a mesh whose size only its file tells."""
    if isinstance(shape, BoxShape):
        radius = 0.5 * _length(shape.size)
    elif isinstance(shape, SphereShape):
        radius = shape.radius
    elif isinstance(shape, CylinderShape | ConeShape):
        radius = _length((shape.radius, 0.5 * shape.height))
    elif isinstance(shape, CapsuleShape):
        radius = shape.radius + 0.5 * shape.height
    elif isinstance(shape, TorusShape):
        radius = shape.major_radius + shape.minor_radius
    elif isinstance(shape, RevolvedShape):
        heights = [height for _, height in shape.profile]
        radius = _length((max(each for each, _ in shape.profile), 0.5 * (max(heights) - min(heights))))
    elif isinstance(shape, CompoundShape):
        reaches = [(ball_around(part.shape), part.scale, _length(part.position)) for part in shape.part]
        if any(around is None for around, _, _ in reaches):
            return None
        radius = max(away + scale * (around or 0.0) for around, scale, away in reaches)
    elif isinstance(shape, PieceShape):
        return ball_around(shape.of)
    elif shape.type == "duck":
        radius = DUCK_BALL * shape.length
    elif shape.type == "bunny":
        radius = BUNNY_BALL * shape.height
    else:
        return None if shape.size is None else 0.5 * math.sqrt(3.0) * shape.size
    return radius


Room = BoxShape | SphereShape | CylinderShape | CapsuleShape | TorusShape


def box_around(shape: Room) -> tuple[float, float, float]:
    """Half the edges of the box around a shape [m]."""
    if isinstance(shape, BoxShape):
        x, y, z = shape.size
        return 0.5 * x, 0.5 * y, 0.5 * z
    if isinstance(shape, SphereShape):
        return (shape.radius,) * 3
    if isinstance(shape, CylinderShape):
        return shape.radius, shape.radius, 0.5 * shape.height
    if isinstance(shape, CapsuleShape):
        return shape.radius, shape.radius, shape.radius + 0.5 * shape.height
    across = shape.major_radius + shape.minor_radius
    return across, across, shape.minor_radius


def depth_inside(shape: Room, point: NDArray[np.float64]) -> float:
    """How far a point (3,) is inside of a shape [m], negative outside; only square roots, which all machines share."""
    x, y, z = (float(value) for value in point)
    across = math.sqrt(x * x + y * y)
    if isinstance(shape, BoxShape):
        return min(0.5 * edge - abs(value) for edge, value in zip(shape.size, (x, y, z), strict=True))
    if isinstance(shape, SphereShape):
        return shape.radius - _length((x, y, z))
    if isinstance(shape, CylinderShape):
        return min(shape.radius - across, 0.5 * shape.height - abs(z))
    if isinstance(shape, CapsuleShape):
        beyond = max(0.0, abs(z) - 0.5 * shape.height)
        return shape.radius - _length((x, y, beyond))
    return shape.minor_radius - _length((across - shape.major_radius, z))


def _length(vector: tuple[float, ...]) -> float:
    return math.sqrt(sum(value * value for value in vector))
