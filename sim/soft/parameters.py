"""Soft matter as a job file names it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.parameters import BodyName, KeyRefusedError, NonNegative, Parameters, Positive
from sim.shapes.filled_parameters import Blocks, dye_conflict
from sim.shapes.openings import InflowParameters
from sim.soft.materials import LAW_KEYS, MATERIALS, MaterialRow

PARTICLES_PER_CELL_EDGE = 2
"""Particles along the edge of a cell at rest: eight a cell, as quadratic splines need."""

WAVE_NUMBER = 0.5
"""Cells that a compression wave crosses in the largest stable step."""


class SoftEmitterParameters(InflowParameters):
    """An opening from which soft matter is poured, without stress; end_s or total_volume says how much in all."""

    @model_validator(mode="before")
    @classmethod
    def _follows_nobody(cls, data: Any) -> Any:
        if isinstance(data, dict) and "follow" in data:
            raise KeyRefusedError(
                ("follow",),
                "is for emitters of fluids: all that soft matter pours is known before the first frame; use keyframes",
            )
        return data

    @model_validator(mode="after")
    def _ends(self) -> Self:
        if self.end_s is None and self.total_volume is None:
            raise ValueError("has neither end_s nor total_volume; add one of them")
        return self


class SoftParameters(Parameters):
    """A body of soft matter: what it is made of, how finely it is computed, and where it is and comes in."""

    name: BodyName = Field(description="Name of the body, unique in the job.")
    material: Literal["sand", "wet_sand", "snow", "packed_snow", "jelly", "rubber", "clay", "dough", "cream"] = Field(
        description="What it is made of, which gives the keys below that are omitted: "
        + "; ".join(f"{name}: {row.about}" for name, row in MATERIALS.items())
        + "."
    )
    block: Blocks = Field(default=(), description="Volumes filled at the start.")
    emitter: tuple[SoftEmitterParameters, ...] = Field(default=(), description="Openings from which it is poured.")
    cell_size: Positive = Field(
        default=0.02, description="Edge of the grid's cells [m], with eight particles each; one for all soft bodies."
    )
    density: Positive | None = Field(default=None, description="Density at rest [kg/m³]; that of the material.")
    young_modulus: Positive | None = Field(
        default=None, description="Young's modulus [Pa]; steps get shorter with its root."
    )
    poisson_ratio: Annotated[float, Field(ge=0.0, le=0.49)] | None = Field(
        default=None, description="Poisson's ratio [-]."
    )
    friction_angle_deg: Annotated[float, Field(ge=1.0, le=60.0)] | None = Field(
        default=None, description="Angle of internal friction [degrees]; of sand."
    )
    cohesion: NonNegative | None = Field(
        default=None, description="Shear stress that it bears without pressure, as wet sand does [Pa]; of sand."
    )
    yield_stress: Positive | None = Field(
        default=None, description="Stress in tension from which on it flows (von Mises) [Pa]; of clay, dough and cream."
    )
    viscosity: NonNegative | None = Field(
        default=None,
        description="Viscosity beyond the yield stress [Pa s^n], n the flow_exponent; of clay, dough and cream.",
    )
    flow_exponent: Annotated[float, Field(ge=0.2, le=1.0)] | None = Field(
        default=None,
        description="Exponent n of shear rate: in shear the stress is that of yield plus viscosity times rate^n "
        "(Herschel and Bulkley); 1 is Bingham's, less thins where it flows fast, as foams do [-]; of clay, dough and "
        "cream.",
    )
    critical_compression: Annotated[float, Field(gt=0.0, lt=0.5)] | None = Field(
        default=None, description="Shortening from which on it is crushed [-]; of snow."
    )
    critical_stretch: Annotated[float, Field(gt=0.0, lt=0.5)] | None = Field(
        default=None, description="Lengthening from which on it breaks [-]; of snow."
    )
    hardening: NonNegative | None = Field(
        default=None, description="Exponent by which it gets harder where it is crushed [-]; of snow."
    )
    fracture_energy: Positive | None = Field(
        default=None,
        description="Energy that tears it apart, for the area of a crack [J/m²], whatever the cells; what is torn has "
        "no cohesion until it is crushed. Without it, it flows instead of tearing; of snow.",
    )
    friction: NonNegative = Field(
        default=0.5,
        description="Friction against walls and bodies [-], one for all soft bodies; with a body that of the pair is "
        "the root of the product.",
    )
    sticks_to: tuple[str, ...] = Field(
        default=(),
        description="Names of rigid bodies, or groups, that it is glued to where it touches them; "
        "the same for all soft bodies.",
    )
    cfl: Positive = Field(default=1.0, le=1.5, description="Factor on the largest stable step [-].")

    @model_validator(mode="after")
    def _is_somewhere(self) -> Self:
        if not self.block and not self.emitter:
            raise ValueError("has neither a block nor an emitter; add [[soft.block]] or [[soft.emitter]]")
        if conflict := dye_conflict((*self.block, *self.emitter)):
            raise ValueError(conflict)
        return self

    @model_validator(mode="after")
    def _has_keys_of_its_law(self) -> Self:
        for key, law in LAW_KEYS.items():
            if key in self.model_fields_set and law != self.row.law:
                names = " or ".join(f'"{name}"' for name, row in MATERIALS.items() if row.law == law)
                raise ValueError(f'{key} is for material = {names}; remove it, as "{self.material}" has none')
        return self

    @model_validator(mode="after")
    def _flows_with_viscosity(self) -> Self:
        if self.flow_exponent is not None and self.value("viscosity") == 0.0:
            raise ValueError("flow_exponent has no meaning without viscosity; add one, or remove it")
        return self

    @property
    def has_dye(self) -> bool:
        """Whether some of it starts, or is poured, with a dye."""
        return any(each.dye > 0.0 for each in (*self.block, *self.emitter))

    @property
    def row(self) -> MaterialRow:
        """Its material's row of the table."""
        return MATERIALS[self.material]

    def value(self, key: str) -> float:
        """A parameter of the material, or 0 where its law has none: the job's own, else that of the table."""
        own = getattr(self, key)
        return float((own if own is not None else getattr(self.row, key)) or 0.0)

    @property
    def spacing(self) -> float:
        """Distance of particles at rest [m]."""
        return self.cell_size / PARTICLES_PER_CELL_EDGE

    @property
    def lame(self) -> tuple[float, float]:
        """Lamé's mu and lambda [Pa]."""
        young, poisson = self.value("young_modulus"), self.value("poisson_ratio")
        shear = young / (2.0 * (1.0 + poisson))
        return shear, 2.0 * shear * poisson / (1.0 - 2.0 * poisson)

    @property
    def wave_speed(self) -> float:
        """Speed of compression waves at rest [m/s], sqrt((lambda + 2 mu)/rho)."""
        shear, second = self.lame
        return math.sqrt((second + 2.0 * shear) / self.value("density"))

    @property
    def longest_step(self) -> float:
        """Largest stable step of the material as it starts [s]."""
        return self.cfl * WAVE_NUMBER * self.cell_size / self.wave_speed


COARSEST = 1.25
"""Distance of particles of soft matter over that of a fluid's beyond which fluid gets in between."""


def coarse_for_fluid(soft: SoftParameters, spacing: float) -> str | None:
    """Why a fluid of particles at a spacing [m] would get into a soft body, in words that follow its cell_size."""
    if soft.spacing <= COARSEST * spacing:
        return None
    most = PARTICLES_PER_CELL_EDGE * COARSEST * spacing
    return (
        f"of {soft.cell_size:g} m would let fluid through, whose particles are {spacing:g} m apart; "
        f"use {most:.3g} m or less"
    )


LIVE_KEYS = ("young_modulus", "friction_angle_deg", "cohesion", "yield_stress", "viscosity", "hardening")
"""Keys that can change while it is simulated, where its material has them."""


SHARED_KEYS = ("cell_size", "friction", "sticks_to", "cfl")
"""Keys that all soft bodies of a job share, as they share a grid and its steps."""


def shared_conflicts(bodies: Sequence[SoftParameters]) -> list[tuple[int, str, str]]:
    """Reasons for which soft bodies cannot share a grid: number of the body, its key, and a sentence."""
    return [
        (
            number,
            key,
            f'is {_shown(getattr(body, key))}, but {_shown(getattr(bodies[0], key))} in soft[0] "{bodies[0].name}"; '
            "all soft bodies share it",
        )
        for number, body in enumerate(bodies[1:], start=1)
        for key in SHARED_KEYS
        if getattr(body, key) != getattr(bodies[0], key)
    ]


def _shown(value: float | tuple[str, ...]) -> str:
    return f"[{', '.join(value)}]" if isinstance(value, tuple) else f"{value:g}"
