"""Whitewater as a job file names it."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from sim.core.parameters import NonNegative, Parameters, Positive

LARGEST_CLOUD = 20_000_000

_RANGES = (
    ("min_speed", "max_speed", " m/s"),
    ("min_trapped_air", "max_trapped_air", " m/s"),
    ("min_wave_crest", "max_wave_crest", ""),
)


class WhitewaterParameters(Parameters):
    """Spray, foam and air bubbles that a fluid throws up: particles of their own, made from the cached frames.

    The simulation does not know of them: a change here repeats the whitewater and the pictures, not the simulation.
    """

    trapped_air_rate: NonNegative = Field(
        default=800.0, description="Particles that one fluid particle makes at most where air is trapped [1/s]."
    )
    wave_crest_rate: NonNegative = Field(
        default=1600.0, description="Particles that one fluid particle makes at most on the crest of a wave [1/s]."
    )
    min_speed: NonNegative = Field(default=0.6, description="Fluid slower than this makes no whitewater [m/s].")
    max_speed: Positive = Field(default=3.0, description="Fluid faster than this makes the most [m/s].")
    min_trapped_air: NonNegative = Field(
        default=0.15, description="Mean speed at which neighbours close in on each other where air gets trapped [m/s]."
    )
    max_trapped_air: Positive = Field(default=0.75, description="The same, where the most air gets trapped [m/s].")
    min_wave_crest: NonNegative = Field(
        default=0.04, description="Mean of 1 - cos of the angle between a crest's normals, where spray begins [-]."
    )
    max_wave_crest: Positive = Field(default=0.4, description="The same, where most spray comes off [-].")
    spread: NonNegative = Field(
        default=0.1, description="Sideways speed of new particles, as a share of the fluid's speed [-]."
    )
    lifetime_min: Positive = Field(default=0.5, description="Shortest life of a particle as foam [s].")
    lifetime_max: Positive = Field(default=2.5, description="Longest life of a particle as foam [s].")
    radius_min_in_radii: Positive = Field(
        default=0.12, description="Smallest radius drawn [radii of the fluid's particles]."
    )
    radius_max_in_radii: Positive = Field(
        default=0.4, description="Largest radius drawn [radii of the fluid's particles]."
    )
    spray_neighbors: Annotated[int, Field(ge=1)] = Field(
        default=6,
        description="With fewer fluid particles around it than this, out of some 33, a particle is spray [-].",
    )
    bubble_neighbors: Annotated[int, Field(ge=1)] = Field(
        default=20, description="With more fluid particles around it than this, out of some 33, it is a bubble [-]."
    )
    air_density: NonNegative = Field(
        default=1.2,
        description="Density of the still air that slows spray down, fine drops the most [kg/m³]; 0 for a vacuum.",
    )
    bubble_buoyancy: NonNegative = Field(
        default=2.0, description="Upward acceleration of a bubble, as a multiple of gravity [-]."
    )
    bubble_rise_speed: Positive = Field(
        default=0.25, description="Speed at which bubbles rise through still fluid [m/s]; centimetre bubbles in water."
    )
    max_particles: Annotated[int, Field(ge=1, le=LARGEST_CLOUD)] = Field(
        default=1_000_000, description="Most particles at a time; further ones are not made [-]."
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed of the random numbers.")

    @model_validator(mode="after")
    def _ranges_have_an_extent(self) -> Self:
        for low, high, unit in _RANGES:
            least, most = getattr(self, low), getattr(self, high)
            if most <= least:
                raise ValueError(f"{high} must be above {low} = {least:g}{unit}, got {most:g}{unit}")
        for low, high in (("lifetime_min", "lifetime_max"), ("radius_min_in_radii", "radius_max_in_radii")):
            least, most = getattr(self, low), getattr(self, high)
            if most < least:
                raise ValueError(f"{high} must not be below {low} = {least:g}, got {most:g}")
        if self.bubble_neighbors < self.spray_neighbors:
            raise ValueError(
                f"bubble_neighbors must not be below spray_neighbors = {self.spray_neighbors}, "
                f"got {self.bubble_neighbors}"
            )
        return self
