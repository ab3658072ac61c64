"""Shapes as a job file names them. Lengths in metres; every shape is centred as its docstring says."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from sim.core.parameters import KeyRefusedError, NonNegative, Parameters, Positive, Vector3

PositiveVector3 = tuple[Positive, Positive, Positive]

ALEMBIC, USD = "abc", ("usd", "usda", "usdc", "usdz")
"""Endings of files of animated meshes."""


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


class FileShape(Parameters):
    """A shape that is read from a file."""

    file: str = Field(min_length=1, description="Path of the mesh, relative to the job file.")


class MeshShape(FileShape):
    """A triangle mesh from a file (OBJ, PLY, STL, GLB), its bounding box centred on the origin.

    Holes are allowed: the inside comes from the generalized winding number (Jacobson et al. 2013).
    """

    type: Literal["mesh"]
    up: Literal["y", "z"] = Field(
        default="z", description='Which axis of the file points up; "y" rotates the mesh upright at loading.'
    )
    size: Positive | None = Field(
        default=None,
        description="Longest edge of the bounding box after loading [m]; as in the file if omitted.",
    )


class AnimationShape(FileShape):
    """A closed mesh that an Alembic or a USD file moves and deforms, where the file has it; its faces stay the same.

    Only a kinematic body of `[[rigid]]` has such a shape. Alembic files are y-up and become z-up; USD files say so, and
    their unit, themselves.
    """

    type: Literal["animation"]
    file: str = Field(
        min_length=1, description="Path of the .abc, .usd, .usda, .usdc or .usdz file, relative to the job file."
    )
    object: str | None = Field(
        default=None, min_length=1, description="Name of the mesh that is meant; all meshes of the file if omitted."
    )
    fps: Annotated[float, Field(ge=1.0, le=1000.0)] | None = Field(
        default=None,
        description="Samples a second of an Alembic file, which does not say [1/s]; 24 if omitted. A USD file does.",
    )
    start_s: NonNegative = Field(
        default=0.0,
        description="When its first sample is there [s]; the body is held still before it and after the last.",
    )
    interpolation: Literal["cubic", "linear"] = Field(
        default="cubic",
        description="Between samples. cubic: velocities are continuous; linear: they are constant and jump.",
    )

    @model_validator(mode="after")
    def _has_a_file_that_is_known(self) -> Self:
        suffix = self.file.lower().rpartition(".")[2]
        if suffix not in (ALEMBIC, *USD):
            raise KeyRefusedError(
                ("file",), f'must be an Alembic (.abc) or USD file, got "{self.file}"; a still mesh has type "mesh"'
            )
        if self.fps is not None and suffix != ALEMBIC:
            raise KeyRefusedError(("fps",), "is that of the USD file, which says so itself; remove it")
        return self


MOST_PIECES = 500


class CompoundShape(Parameters):
    """Several shapes that are one body, such as a hammer of a box and a cylinder; about the origin of its parts.

    Parts keep their own exact distances in contacts. Where they overlap, their masses add up.
    """

    type: Literal["compound"]
    part: Annotated[tuple[PartParameters, ...], Field(min_length=1, max_length=MOST_PIECES)] = Field(
        description="Its parts."
    )

    @model_validator(mode="after")
    def _has_a_first_part_of_the_body_itself(self) -> Self:
        names = [part.name for part in self.part if part.name is not None]
        if self.part[0].name is not None:
            raise KeyRefusedError(("part", 0, "name"), "of the first part is that of the body; remove it")
        if "body" in names or "inside" in names:
            raise KeyRefusedError(("part",), 'names of parts cannot be "body" or "inside", which have a meaning')
        return self


class PieceShape(Parameters):
    """One of the pieces that a shape is cut into, where it is in the shape; `[rigid.breaks]` makes them."""

    type: Literal["piece"]
    of: Shape = Field(description="The whole shape.")
    pieces: Annotated[int, Field(ge=2, le=MOST_PIECES)] | None = Field(
        default=None, description="How many there are [-]; the parts of a compound if omitted."
    )
    seed: Annotated[int, Field(ge=0)] = Field(default=0, description="Of the random points that they lie around.")
    number: Annotated[int, Field(ge=1, le=MOST_PIECES)] = Field(description="Which of them this is, from 1 [-].")


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
    | MeshShape
    | AnimationShape
    | CompoundShape
    | PieceShape,
    Field(discriminator="type"),
]


class Placement(Parameters):
    """A shape in the world: scaled, then rotated, then moved."""

    may_be_animated: ClassVar[bool] = False
    shape: Shape = Field(description="What it looks like.")
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="World position of the shape's centre [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Rotation about x, then y, then z (world axes) [degrees]."
    )
    scale: Positive = Field(default=1.0, description="Uniform scale factor [-].")

    @model_validator(mode="after")
    def _has_a_shape_that_it_may_have(self) -> Self:
        if isinstance(self.shape, AnimationShape) and not self.may_be_animated:
            raise KeyRefusedError(("shape", "type"), "is for bodies of [[rigid]] alone; take a mesh of one moment")
        return self


class PartParameters(Placement):
    """A part of a compound: a shape, where it is in the body, and what it is made of."""

    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Of the shape's centre, in the body's axes [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Rotation about the body's x, then y, then z axis [degrees]."
    )
    density: Annotated[float, Field(ge=1e-3, le=1e6)] | None = Field(
        default=None, description="Mass per volume [kg/m³]; the body's if omitted."
    )
    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")] | None = Field(
        default=None,
        description='Name of the part, by which it has a material of its own, as [material."hammer.handle"]; '
        "the first is the body itself.",
    )


for _model in (CompoundShape, PieceShape, Placement, PartParameters):
    _model.model_rebuild()


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
