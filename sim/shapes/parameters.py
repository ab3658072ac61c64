"""Shapes as a job file names them. Lengths in metres; every shape is centred as its docstring says."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sim.core.parameters import NonNegative, Parameters, Positive, Vector3

PositiveVector3 = tuple[Positive, Positive, Positive]


class BoxShape(Parameters):
    """An axis-aligned box, centred on the origin."""

    type: Literal["box"]
    size: PositiveVector3 = Field(description="Edge lengths along x, y, z [m].")


class SphereShape(Parameters):
    """A ball, centred on the origin."""

    type: Literal["sphere"]
    radius: Positive = Field(description="Radius [m].")


class CylinderShape(Parameters):
    """A solid cylinder along z, centred on the origin."""

    type: Literal["cylinder"]
    radius: Positive = Field(description="Radius [m].")
    height: Positive = Field(description="Height along z [m].")


class CapsuleShape(Parameters):
    """A cylinder along z with half-ball caps, centred on the origin."""

    type: Literal["capsule"]
    radius: Positive = Field(description="Radius [m].")
    height: Positive = Field(description="Length of the cylindrical part along z, caps excluded [m].")


class TorusShape(Parameters):
    """A ring around z, centred on the origin."""

    type: Literal["torus"]
    major_radius: Positive = Field(description="From the centre to the middle of the tube [m].")
    minor_radius: Positive = Field(description="Radius of the tube [m].")


class ConeShape(Parameters):
    """A solid cone along z, base down, its bounding box centred on the origin."""

    type: Literal["cone"]
    radius: Positive = Field(description="Radius of the base [m].")
    height: Positive = Field(description="Height along z [m].")


class RevolvedShape(Parameters):
    """A profile turned around z: a glass, a bowl, a vase, a ring; its bounding box centred on the origin.

    The points go once around the wall. Both ends on the axis (radius 0) make a body that reaches the axis; both off it
    make a ring, closed from the last point to the first.
    """

    type: Literal["revolved"]
    profile: Annotated[tuple[tuple[NonNegative, float], ...], Field(min_length=3, max_length=400)] = Field(
        description="Corners of the outline, radius and height each [m], in either direction."
    )


class DuckShape(Parameters):
    """The procedural rubber duck: swims along +x, its bounding box centred on the origin."""

    type: Literal["duck"]
    length: Positive = Field(default=0.2, description="Length from bill to tail along x [m].")


class BunnyShape(Parameters):
    """The procedural bunny: sits on its base, looks along +x, its bounding box centred on the origin."""

    type: Literal["bunny"]
    height: Positive = Field(default=0.2, description="Height from base to the tips of the ears along z [m].")


class MeshShape(Parameters):
    """A triangle mesh from a file (OBJ, PLY, STL, GLB), its bounding box centred on the origin.

    Holes are allowed: the inside comes from the generalized winding number (Jacobson et al. 2013).
    """

    type: Literal["mesh"]
    file: str = Field(min_length=1, description="Path of the mesh, relative to the job file.")
    up: Literal["y", "z"] = Field(
        default="z", description='Which axis of the file points up; "y" rotates the mesh upright at loading.'
    )
    size: Positive | None = Field(
        default=None,
        description="Longest edge of the bounding box after loading [m]; as in the file if omitted.",
    )


Shape = Annotated[
    BoxShape
    | SphereShape
    | CylinderShape
    | CapsuleShape
    | TorusShape
    | ConeShape
    | RevolvedShape
    | DuckShape
    | BunnyShape
    | MeshShape,
    Field(discriminator="type"),
]


class Placement(Parameters):
    """A shape in the world: scaled, then rotated, then moved."""

    shape: Shape = Field(description="What it looks like.")
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="World position of the shape's centre [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Rotation about x, then y, then z (world axes) [degrees]."
    )
    scale: Positive = Field(default=1.0, description="Uniform scale factor [-].")


class BallastParameters(Parameters):
    """A small heavy piece fixed in a dynamic body, such as the weight that keeps a toy duck upright."""

    mass: Positive = Field(description="Mass [kg], on top of that of the density.")
    position: Vector3 = Field(description="Where it sits, from the shape's centre, before the body is turned [m].")


class WeightedPlacement(Placement):
    """A shape in the world that may have a mass."""

    density: Annotated[float, Field(ge=1e-3, le=1e6)] | None = Field(
        default=None,
        description="Mass per volume [kg/m³]; dynamic bodies need one. Within some 10 % of a fluid's, a body that "
        "starts deep below its surface rises or sinks slowly.",
    )
    ballast: tuple[BallastParameters, ...] = Field(
        default=(),
        description="Point masses fixed in a dynamic body: they shift its centre of mass and add to its inertia, and "
        "displace nothing.",
    )
