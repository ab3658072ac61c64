"""Smoke as a job file names it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal, Self

from pydantic import Field, model_validator

from sim.parameters import Fraction, NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import Placement

if TYPE_CHECKING:
    from sim.scene import DomainParameters

WHOLE = 1.0e-6
"""Part of a cell by which a box may be longer than its cells: 1 m / 0.02 m are 50, not 50.00000000000001."""

Face = Literal["x-", "x+", "y-", "y+", "z-", "z+"]


class SmokeSourceParameters(Placement):
    """A region that emits: inside it, each step brings the fields at least to these values, from the air's."""

    density: Fraction = Field(default=1.0, description="Smoke density inside the source [-].")
    temperature: Positive = Field(default=450.0, description="Temperature inside the source [K].")
    fluctuation: Fraction = Field(
        default=0.2,
        description="How far its heat falls short of that, at random in space and time [-]; "
        "0 makes a plume as symmetric as its source.",
    )
    velocity: Vector3 | None = Field(
        default=None, description="Velocity inside the source [m/s]; left to the flow if omitted."
    )
    start_s: NonNegative = Field(default=0.0, description="When it starts to emit [s].")
    end_s: Positive | None = Field(default=None, description="When it stops [s]; never if omitted.")

    @model_validator(mode="after")
    def _ends_after_start(self) -> Self:
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ValueError(f"end_s must be after start_s = {self.start_s:g} s, got {self.end_s:g} s")
        return self

    def emits_during(self, begin_s: float, end_s: float) -> bool:
        """Whether it emits in some part of a span of time [s]: no short source falls between two steps."""
        return self.start_s < end_s and (self.end_s is None or begin_s < self.end_s)


class SmokeParameters(Parameters):
    """Hot smoke in a box of cells: its sources, its physics and its numerics."""

    name: str = Field(description="Name of the smoke, unique in the job.", pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")
    source: tuple[SmokeSourceParameters, ...] = Field(min_length=1, description="Where the smoke comes from.")
    min: Vector3 | None = Field(default=None, description="Lower corner of its grid [m]; the domain's if omitted.")
    max: Vector3 | None = Field(default=None, description="Upper corner of its grid [m]; the domain's if omitted.")
    cell_size: Positive = Field(default=0.02, description="Edge of a cubic cell [m].")
    open_faces: tuple[Face, ...] = Field(
        default=("x-", "x+", "y-", "y+", "z+"), description="Sides through which air and smoke may pass."
    )
    ambient_temperature: Positive = Field(default=293.0, description="Temperature of the air [K].")
    buoyancy_density: NonNegative = Field(
        default=0.1, description="Weight alpha of the smoke: downward acceleration per density [m/s²]."
    )
    buoyancy_temperature: NonNegative = Field(
        default=9.81 / 293.0,
        description="Lift beta of heat: upward acceleration per kelvin [m/(s² K)]; g/T of an ideal gas by default.",
    )
    vorticity_confinement: NonNegative = Field(
        default=0.3, description="Strength epsilon of the vorticity confinement [-]; 0 switches it off."
    )
    density_dissipation: NonNegative = Field(default=0.0, description="Rate at which smoke thins out [1/s].")
    cooling: NonNegative = Field(default=0.2, description="Rate at which it cools to the air's temperature [1/s].")
    advection: Literal["maccormack", "semi_lagrangian"] = Field(
        default="maccormack",
        description="maccormack: second order, clamped (Selle et al. 2008); or semi_lagrangian.",
    )
    projection_tolerance: Positive = Field(
        default=1.0e-5, description="Largest divergence after the projection: max|div u| dx / max|u| [-]."
    )
    projection_max_iterations: int = Field(default=100, ge=1, description="Most iterations of the projection [-].")
    cfl: Positive = Field(default=2.0, le=10.0, description="Most cells that smoke may cross in a substep [-].")

    def corners(self, domain: DomainParameters) -> tuple[Vector3, Vector3]:
        """Lower and upper corner of its box [m]: its own, or the domain's where it names none.

        A box that is no whole number of cells long is rounded up, keeping its lower corner.
        """
        low, high = self.min or domain.min, self.max or domain.max
        ends = [a + n * self.cell_size for a, n in zip(low, self.cell_counts(domain), strict=True)]
        # What is whole but for rounding ends where it is said to, so that boxes side by side do not overlap.
        x, y, z = (b if end - b < WHOLE * self.cell_size else end for b, end in zip(high, ends, strict=True))
        return low, (x, y, z)

    def cell_counts(self, domain: DomainParameters) -> tuple[int, int, int]:
        """How many cells its box has along x, y, z; 1 where it has no length."""
        low, high = self.min or domain.min, self.max or domain.max
        x, y, z = (max(1, math.ceil((b - a) / self.cell_size - WHOLE)) for a, b in zip(low, high, strict=True))
        return x, y, z


def boxes_overlap(a: tuple[Vector3, Vector3], b: tuple[Vector3, Vector3]) -> bool:
    """Whether two boxes, given by their corners [m], have a volume in common."""
    (a_low, a_high), (b_low, b_high) = a, b
    return all(max(p, q) < min(r, s) for p, q, r, s in zip(a_low, b_low, a_high, b_high, strict=True))
