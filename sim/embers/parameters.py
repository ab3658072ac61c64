"""Embers as a job file names them."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field

from sim.core.parameters import BodyName, NonNegative, Parameters, Positive, Vector3
from sim.forces.parameters import Seed
from sim.shapes.parameters import Placement

LEAST_SHARE, MOST_SHARE = 0.5, 1.5
"""Sizes and lives of single embers over the mean, drawn evenly from in between [-]."""

COLD_K = 800.0
"""At the end of its life an ember has this temperature, and no glow that a picture shows [K]."""


class EmberSourceParameters(Placement):
    """A region that embers come from, each from a place of its own in it."""

    rate: Positive = Field(default=50.0, le=1.0e5, description="Embers a second [1/s].")
    velocity: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Mean velocity at the start [m/s].")
    spread: NonNegative = Field(
        default=0.3, description="Standard deviation of each component of the velocity at the start [m/s]."
    )
    start_s: NonNegative = Field(default=0.0, description="When the first comes [s].")
    end_s: Positive | None = Field(default=None, description="When no more come [s]; never if omitted.")


class EmberParameters(Parameters):
    """Embers of one fire: bits of char, which fall through the air as spheres do."""

    name: BodyName = Field(description="Name of the embers, unique in the job.")
    smoke: str = Field(description="Name of the smoke whose air carries them; outside of its box air is at rest.")
    source: tuple[EmberSourceParameters, ...] = Field(min_length=1, description="Where they come from.")
    diameter: Positive = Field(default=0.0015, le=0.05, description="Mean diameter [m]; from half to one and a half.")
    density: Positive = Field(default=50.0, description="Density of the porous char [kg/m³].")
    temperature: Annotated[float, Field(gt=COLD_K, le=2500.0)] = Field(
        default=1550.0,
        description="Temperature at the start [K]; it sinks to 800 K, where nothing glows, slowly at first.",
    )
    lifetime: Positive = Field(
        default=1.5, le=60.0, description="Mean time until then [s]; from half to one and a half."
    )
    seed: Seed = Field(default=0, description="Of the random numbers.")

    @property
    def most(self) -> int:
        """Embers that can glow at one time."""
        longest = MOST_SHARE * self.lifetime
        return sum(math.ceil(source.rate * longest) + 1 for source in self.source)

    @property
    def fall_speed(self) -> float:
        """Speed at which an ember of the mean size falls through still air [m/s]."""
        from sim.core.drag import AIR_DENSITY, AIR_VISCOSITY, TURBULENT_DRAG, drag_coefficients

        weight = 4.0 / 3.0 * self.density * self.diameter * 9.81 / AIR_DENSITY
        speed = math.sqrt(weight / TURBULENT_DRAG)
        for _ in range(100):
            reynolds = AIR_DENSITY * speed * self.diameter / AIR_VISCOSITY
            speed = math.sqrt(weight / float(drag_coefficients(reynolds)))  # type: ignore[arg-type]
        return speed
