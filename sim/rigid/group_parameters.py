"""How many rigid bodies of one table lie: what is beside `count` in a job file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sim.core.parameters import NonNegative, Parameters, Vector3
from sim.shapes.parameters import BoxShape, CapsuleShape, CylinderShape, SphereShape, TorusShape

NonNegativeVector3 = tuple[NonNegative, NonNegative, NonNegative]

Room = Annotated[
    BoxShape | SphereShape | CylinderShape | CapsuleShape | TorusShape,
    Field(discriminator="type"),
]


class JitterParameters(Parameters):
    """How much the bodies of a group are out of line: each by a random part of it, to either side."""

    position: NonNegativeVector3 = Field(default=(0.0, 0.0, 0.0), description="Most along the world's x, y, z [m].")
    rotation_deg: NonNegativeVector3 = Field(
        default=(0.0, 0.0, 0.0), description="Most about the body's own x, then y, then z [degrees]."
    )


class ScatterParameters(Parameters):
    """A shape that bodies are scattered in, where no two of them touch; its centre and turn are the table's."""

    shape: Room = Field(
        description="The shape: a box, sphere, cylinder, capsule or torus. Each body gets a ball of room in it."
    )
    gap: NonNegative = Field(default=0.0, description="Least distance between the balls around two bodies [m].")
    turned: bool = Field(default=True, description="Whether each body is turned in a random direction.")


class CurveParameters(Parameters):
    """A smooth curve through points that the centres of bodies lie on, equally far apart."""

    points: Annotated[tuple[Vector3, ...], Field(min_length=2, max_length=400)] = Field(
        description="Points that it goes through, from the table's position [m]."
    )
    closed: bool = Field(default=False, description="Whether it returns to its first point.")
    turned: bool = Field(
        default=True, description="Whether each body is turned about z, so that its own x axis points along the curve."
    )
