"""Forces as a job file names them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from sim.core.motion.parameters import RampPointParameters, require_ascending_times, strength_at
from sim.core.parameters import KeyRefusedError, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import BoxShape, CylinderShape, SphereShape

Seed = Annotated[int, Field(ge=0, le=1_000_000_000)]

MOST_FORCES = 64
"""Of a job: every particle looks at every force."""


class RegionParameters(Parameters):
    """Where a force acts: in a shape in the world."""

    shape: Annotated[BoxShape | SphereShape | CylinderShape, Field(discriminator="type")] = Field(
        description="A box, a sphere or a cylinder."
    )
    position: Vector3 = Field(default=(0.0, 0.0, 0.0), description="World position of the shape's centre [m].")
    rotation_deg: Vector3 = Field(
        default=(0.0, 0.0, 0.0), description="Rotation about x, then y, then z (world axes) [degrees]."
    )
    edge: NonNegative = Field(
        default=0.0, description="Inside this distance from the shape's surface the force fades to nothing [m]."
    )


class BaseForce(Parameters):
    """What all forces have."""

    only: tuple[str, ...] = Field(
        default=(),
        description="Names of the bodies, groups, fluids, cloths, smokes and soft bodies it acts on; all if omitted.",
    )
    within: RegionParameters | None = Field(default=None, description="Where it acts; everywhere if omitted.")
    start_s: NonNegative = Field(default=0.0, description="When it sets in [s].")
    end_s: Positive | None = Field(default=None, description="When it ends [s]; never if omitted.")
    ramp: tuple[RampPointParameters, ...] = Field(
        default=(),
        description="Its strength over time: linear between these points, and constant before and after them; "
        "1 if omitted.",
    )

    @model_validator(mode="after")
    def _has_a_time(self) -> Self:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise KeyRefusedError(("end_s",), f"must be after start_s = {self.start_s:g} s, got {self.end_s:g} s")
        require_ascending_times(self.ramp, "ramp")
        return self

    def strength(self, time_s: float) -> float:
        """By its times and its ramp at a simulated time [s], from 0 to 1."""
        if time_s < self.start_s or (self.end_s is not None and time_s >= self.end_s):
            return 0.0
        return strength_at(self.ramp, time_s)


class GravityForce(BaseForce):
    """An acceleration that is the same everywhere, on top of the job's gravity; smoke feels it as that."""

    type: Literal["gravity"]
    acceleration: Vector3 = Field(description="What is added to the job's gravity [m/s²].")


class AttractorForce(BaseForce):
    """An acceleration towards a point, or towards a line through it: a (r/R)^-p beyond R, a r/R closer."""

    type: Literal["attractor"]
    position: Vector3 = Field(description="The point, in the world [m].")
    direction: Vector3 | None = Field(
        default=None, description="Direction of a line through the point, which attracts in its place."
    )
    acceleration: float = Field(description="At the radius [m/s²]; negative pushes away.")
    radius: Positive = Field(description="Distance R at which it is strongest [m].")
    falloff: Annotated[float, Field(ge=0.0, le=8.0)] = Field(
        default=2.0, description="Power p by which it falls beyond the radius [-]; 0: not at all."
    )

    @model_validator(mode="after")
    def _has_a_direction(self) -> Self:
        _require_direction(self.direction)
        return self


class DragForce(BaseForce):
    """A brake: everything loses its velocity, and bodies their spin, at a rate."""

    type: Literal["drag"]
    rate: Positive = Field(description="Part of the velocity that is lost in a second, at first [1/s].")


class AirForce(BaseForce):
    """Air that moves, whatever moves it.

    Cloth feels it by its `drag`, rigid bodies by their `air_drag`, fluids by their `air_density`; the air of a smoke
    takes on the sum of the winds.
    """

    response_s: Positive = Field(
        default=0.5, description="Time in which the air of a smoke takes on most of it [s]; of no meaning to others."
    )


class WindForce(AirForce):
    """An even wind, and gusts, which travel with it; still air if no velocity is given."""

    type: Literal["wind"]
    velocity: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Mean velocity [m/s].")
    gusts: Annotated[float, Field(ge=0.0, le=1.0)] = Field(
        default=0.0, description="Largest part by which its speed rises above the mean and falls below it [-]."
    )
    gust_s: Positive = Field(default=1.0, description="Time from one gust to the next [s].")
    seed: Seed = Field(default=0, description="Of the random numbers of the gusts.")

    @model_validator(mode="after")
    def _has_wind_to_gust(self) -> Self:
        if self.gusts and not any(self.velocity):
            raise KeyRefusedError(("gusts",), "have no meaning without a velocity; give one, or remove gusts")
        given = self.model_fields_set & {"gust_s", "seed"}
        if given and not self.gusts:
            raise KeyRefusedError((min(given),), "has no meaning without gusts; remove it or give gusts")
        return self


class VortexForce(AirForce):
    """A vortex around a line (Rankine): as a solid inside its radius, its speed as 1/r outside."""

    type: Literal["vortex"]
    position: Vector3 = Field(description="A point of its axis, in the world [m].")
    direction: Vector3 = Field(default=(0.0, 0.0, 1.0), description="Of its axis; it turns counterclockwise about it.")
    speed: float = Field(description="Of the air at the radius [m/s]; negative turns the other way.")
    radius: Positive = Field(description="Where it is fastest [m].")

    @model_validator(mode="after")
    def _has_a_direction(self) -> Self:
        _require_direction(self.direction)
        return self


class TurbulenceForce(AirForce):
    """Random eddies of many sizes, without divergence (Kraichnan 1970; Fung, Hunt, Malik & Perkins 1992)."""

    type: Literal["turbulence"]
    speed: Positive = Field(description="Root mean square of the velocity [m/s].")
    size: Positive = Field(description="Of the largest eddies [m]; the smallest have a sixth.")
    rate: NonNegative = Field(default=1.0, description="How often the largest change [1/s]; 0: never.")
    seed: Seed = Field(default=0, description="Of their random numbers.")


Force = Annotated[
    GravityForce | AttractorForce | DragForce | WindForce | VortexForce | TurbulenceForce,
    Field(discriminator="type"),
]


def unknown_targets(forces: Iterable[BaseForce], names: Iterable[str]) -> list[tuple[int, int, str]]:
    """Number of the force, that of its entry in `only`, and the name, for each name that nothing has."""
    known = set(names)
    return [
        (number, entry, name)
        for number, force in enumerate(forces)
        for entry, name in enumerate(force.only)
        if name not in known
    ]


def _require_direction(direction: Vector3 | None) -> None:
    if direction is not None and not any(direction):
        raise KeyRefusedError(("direction",), "has no length; name an axis such as [0, 0, 1]")
