"""Particle fluids as a job file names them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from sim.core.parameters import BodyName, NonNegative, Parameters, Positive, Vector3
from sim.core.water import CAPILLARY_LENGTH, TENSION_OF_WATER
from sim.fluid.traits import CAPILLARY_NUMBER, CFL_NUMBER, COHESION_NUMBER, TRAITS, VISCOUS_NUMBER
from sim.shapes.filled_parameters import Blocks, dye_conflict
from sim.shapes.openings import InflowParameters

WITH_SOUND_SPEED = " or ".join(f'"{name}"' for name, traits in TRAITS.items() if traits.has_sound_speed)

SLIPPERY_ANGLE_DEG = 45.0  # contact angle below which a drop that spreads on a smooth wall tears [degrees]
SPREADING_FRICTION = 5.0  # of walls, with which it does not [-]


class EmitterParameters(InflowParameters):
    """An opening from which fluid flows into the domain, free as soon as it has passed it."""

    follow: str | None = Field(
        default=None,
        description="Name of the rigid body that it is fixed to: position, direction and rotation_deg are then along "
        "the body's own axes, from its shape's centre. What flows out has the body's motion on top, and does not push "
        "it back.",
    )

    @model_validator(mode="after")
    def _is_led_by_one(self) -> Self:
        if self.keyframe and self.follow is not None:
            raise ValueError(f'it follows "{self.follow}" and has keyframes; remove one of them')
        return self

    @property
    def moves(self) -> bool:
        """Whether it may be elsewhere later."""
        return bool(self.keyframe) or self.follow is not None


class FluidParameters(Parameters):
    """A fluid: its material, its discretization, the volumes it fills at the start and where more flows in."""

    name: BodyName = Field(description="Name of the fluid, unique in the job.")
    solver: Literal["wcsph", "dfsph", "pcisph"] = Field(
        default="wcsph",
        description="wcsph: weakly compressible SPH (Becker & Teschner 2007); dfsph: divergence-free SPH (Bender & "
        "Koschier 2015); pcisph: predictive-corrective incompressible SPH (Solenthaler & Pajarola 2009).",
    )
    block: Blocks = Field(default=(), description="Volumes filled at the start.")
    emitter: tuple[EmitterParameters, ...] = Field(default=(), description="Openings from which fluid flows in.")
    max_particles: Annotated[int, Field(ge=1, le=2**31 - 1)] | None = Field(
        default=None,
        description="Most particles of this fluid [-]; its emitters stop there. What the domain holds if omitted.",
    )
    particle_radius: Positive = Field(
        default=0.01, description="Particle radius r [m]; lattice spacing is 2r, support radius 4r."
    )
    support_in_spacings: Annotated[float, Field(ge=2.0, le=4.0)] = Field(
        default=2.0,
        description="Support radius h of the kernel over the lattice spacing 2r [-]: 2 gives 32 neighbours, 4 gives "
        "250 and smoother fields, at eight times the cost; from 3 on particles at rest gather in clumps.",
    )
    dye_diffusivity: NonNegative = Field(
        default=5.0e-10,
        description="Diffusivity of the dye between its particles [m²/s]: of dyes in water 3e-10 to 1e-9, so that they "
        "mix by flow alone; more stands for swirls that are finer than the particles. Between those of two fluids it "
        "is the harmonic mean of both; 0 keeps dye where it is.",
    )
    rest_density: Positive = Field(default=1000.0, description="Rest density [kg/m³].")
    viscosity: NonNegative = Field(default=1.0e-6, description="Kinematic viscosity nu [m²/s]; water 1e-6.")
    artificial_viscosity: NonNegative = Field(
        default=0.05,
        description="Artificial viscosity alpha (Monaghan 1992) [-]; steadies the pressure, 0 switches it off. Its "
        "speed is that of sound in wcsph, and the largest expected one, a tenth of it, in dfsph and pcisph.",
    )
    viscosity_solver: Literal["auto", "explicit", "implicit"] = Field(
        default="auto",
        description="explicit: forces of the step before, short steps where the fluid is stiff; implicit: a linear "
        "system in every step (Weiler et al. 2018); auto: implicit where viscosity would limit the time step.",
    )
    surface_tension_model: Literal["becker_teschner2007", "csf"] = Field(
        default="becker_teschner2007",
        description="becker_teschner2007: cohesion of particles, without a unit of the surface; csf: a continuum "
        "surface force (Brackbill et al. 1992), by the curvature of the surface and its contact angle with walls. "
        f"With neither this nor a strength given, csf with that of water where the lattice spacing is at most "
        f"{1e3 * CAPILLARY_LENGTH:.2g} mm, its capillary length, and the support two spacings.",
    )
    surface_tension: NonNegative = Field(
        default=0.0,
        description="Strength; 0 switches it off. becker_teschner2007: cohesion kappa [m³/s²]; "
        "csf: surface tension sigma [N/m], 0.072 for water.",
    )
    contact_angle_deg: Annotated[float, Field(ge=30.0, le=120.0)] = Field(
        default=90.0,
        description="Angle in the fluid between its surface and walls or bodies that it meets [degrees]: of water 50 "
        f"on glass that is not new, 70 to 80 on acrylic, 105 on wax. Below {SLIPPERY_ANGLE_DEG:g} it needs a "
        f"wall_friction of {SPREADING_FRICTION:g} or more. csf only.",
    )
    air_density: NonNegative = Field(
        default=0.0,
        description="Density of the air that slows drops and sheets down [kg/m³], 1.2 at 20 degrees C; 0: none "
        "(Gissler et al. 2017).",
    )
    wind: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Velocity of that air [m/s].")
    wall_friction: NonNegative = Field(
        default=0.0, description="Viscosity against walls and bodies, as a multiple of the fluid's own [-]."
    )
    sound_speed: Positive | None = Field(
        default=None,
        description="Numerical speed of sound of wcsph [m/s]; ten times the largest expected speed if omitted.",
    )
    density_tolerance: Positive = Field(
        default=1.0e-4,
        le=0.1,
        description="Mean error of the density, relative to the rest density, at which the pressure solves of dfsph "
        "and pcisph stop [-].",
    )
    divergence_tolerance: Positive = Field(
        default=1.0e-3,
        le=0.1,
        description="Mean relative compression in a step at which the divergence solve of dfsph stops [-].",
    )
    max_iterations: Annotated[int, Field(ge=3, le=100_000)] = Field(
        default=100,
        description="Most iterations of a pressure solve of dfsph and pcisph [-]; a solve that reaches it is counted.",
    )
    dt: Literal["adaptive"] | Positive = Field(
        default="adaptive",
        description='Time step [s], or "adaptive": the largest that the CFL condition allows.',
    )
    cfl: Positive = Field(default=1.0, le=2.0, description="Factor on the CFL time step [-].")

    @model_validator(mode="before")
    @classmethod
    def _without_what_was(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("surface_tension_model") == "akinci2013":
            raise ValueError('surface_tension_model "akinci2013" is now "csf", with the same surface_tension [N/m]')
        if isinstance(data, dict) and "adhesion" in data:
            raise ValueError('adhesion is now contact_angle_deg, with surface_tension_model = "csf": 90 for none')
        return data

    @model_validator(mode="before")
    @classmethod
    def _has_tension_where_it_is_seen(cls, data: Any) -> Any:
        """At the scale of a glass, surface tension unless the job says otherwise."""
        if not isinstance(data, dict) or not {"surface_tension_model", "surface_tension"}.isdisjoint(data):
            return data
        radius, support = (
            data.get(key, cls.model_fields[key].default) for key in ("particle_radius", "support_in_spacings")
        )
        # What is no number is refused later, by its own key.
        if not isinstance(radius, int | float) or 2.0 * radius > CAPILLARY_LENGTH or support != 2.0:
            return data
        return {**data, "surface_tension_model": "csf", "surface_tension": TENSION_OF_WATER}

    @property
    def spacing(self) -> float:
        """Lattice spacing d = 2r [m]."""
        return 2.0 * self.particle_radius

    @property
    def lattice_volume(self) -> float:
        """Volume that a particle takes of a block, d³ [m³]."""
        return self.spacing**3

    @property
    def has_dye(self) -> bool:
        """Whether some of it starts, or flows in, with a dye."""
        return any(each.dye > 0.0 for each in (*self.block, *self.emitter))

    @property
    def most_volume(self) -> float:
        """Volume that `max_particles` take [m³]; infinite without that key."""
        return math.inf if self.max_particles is None else self.max_particles * self.lattice_volume

    @property
    def skin(self) -> float:
        """Reach of the neighbour list beyond the support [support radii]."""
        return TRAITS[self.solver].skin

    @property
    def tension_step(self) -> float:
        """Largest step that its surface tension allows [s]; infinite without any.

        With `csf` that of the shortest capillary waves, a fraction of sqrt(rho d³/(2 pi sigma)). With the cohesion of
        Becker & Teschner 2007 a particle swings on its neighbours' at a squared frequency of kappa/d³ at most.
        """
        if self.surface_tension == 0.0:
            return math.inf
        rate = self.surface_tension / self.lattice_volume
        if self.surface_tension_model == "csf":
            return CAPILLARY_NUMBER / math.sqrt(2.0 * math.pi * rate / self.rest_density)
        return COHESION_NUMBER / math.sqrt(rate)

    @model_validator(mode="after")
    def _comes_from_somewhere(self) -> Self:
        if not self.block and not self.emitter:
            raise ValueError("has neither a block nor an emitter; add [[fluid.block]] or [[fluid.emitter]]")
        if self.sound_speed is not None and not TRAITS[self.solver].has_sound_speed:
            raise ValueError(f'sound_speed is for solver = {WITH_SOUND_SPEED}; remove it, as "{self.solver}" has none')
        if any(self.wind) and not self.air_density:
            raise ValueError("wind moves nothing without air; set air_density, 1.2 kg/m³ for air, or remove wind")
        if "contact_angle_deg" in self.model_fields_set and self.surface_tension_model != "csf":
            raise ValueError('contact_angle_deg needs surface_tension_model = "csf"; remove it or name that model')
        if self.contact_angle_deg < SLIPPERY_ANGLE_DEG and not self.artificial_viscosity:
            raise ValueError(
                f"contact_angle_deg = {self.contact_angle_deg:g} is below {SLIPPERY_ANGLE_DEG:g} and needs friction of "
                "walls, which artificial_viscosity = 0 leaves nearly none of; remove that"
            )
        if self.contact_angle_deg < SLIPPERY_ANGLE_DEG and self.wall_friction < SPREADING_FRICTION:
            raise ValueError(
                f"contact_angle_deg = {self.contact_angle_deg:g} is below {SLIPPERY_ANGLE_DEG:g} and needs "
                f"wall_friction = {SPREADING_FRICTION:g} or more, not {self.wall_friction:g}: a drop that spreads on a "
                "smooth wall overshoots, and its rim tears"
            )
        if self.surface_tension_model == "csf" and self.support_in_spacings != 2.0:
            raise ValueError(
                f'surface_tension_model = "csf" needs support_in_spacings = 2, at which it is calibrated, not '
                f"{self.support_in_spacings:g}"
            )
        return self


OWN_KEYS = frozenset(
    (
        *("name", "block", "emitter", "max_particles", "rest_density", "viscosity", "surface_tension"),
        *("dye_diffusivity", "contact_angle_deg"),
    )
)
"""Keys that each fluid of a tank has of its own; all else is shared, as they share particles, steps and walls."""

LARGEST_DENSITY_CONTRAST = 10.0
"""Largest rest density over the smallest in one tank. At 10 a light fluid stays at rest on a heavy one, and a heavy
one sinks through a light one; water and air (1000) would need another formulation."""


def shared_conflicts(fluids: Sequence[FluidParameters]) -> list[tuple[int, str, str]]:
    """Reasons for which fluids cannot share a tank: number of the fluid, its key, and a sentence."""
    conflicts = []
    for number, fluid in enumerate(fluids[1:], start=1):
        for key in FluidParameters.model_fields:
            own, first = getattr(fluid, key), getattr(fluids[0], key)
            if key not in OWN_KEYS and own != first:
                reason = f'is {_written(own)}, but {_written(first)} in fluid[0] "{fluids[0].name}"'
                conflicts.append((number, key, f"{reason}; all fluids of a tank share it"))
        lightest, heaviest = sorted((fluid.rest_density, fluids[0].rest_density))
        if heaviest > LARGEST_DENSITY_CONTRAST * lightest:
            reason = (
                f"is {fluid.rest_density:g} kg/m³, and {fluids[0].rest_density:g} kg/m³ in fluid[0] "
                f'"{fluids[0].name}"; densities in a tank may differ by a factor of '
                f"{LARGEST_DENSITY_CONTRAST:g} at most"
            )
            conflicts.append((number, "rest_density", reason))
    return conflicts


def tank_dye_conflict(fluids: Sequence[FluidParameters]) -> tuple[int, str] | None:
    """The first fluid of a tank whose dye can do nothing, and why."""
    reason = dye_conflict(each for fluid in fluids for each in (*fluid.block, *fluid.emitter))
    is_dyed = any(fluid.has_dye for fluid in fluids)
    for number, fluid in enumerate(fluids):
        if reason and fluid.has_dye:
            return number, reason
        if not is_dyed and "dye_diffusivity" in fluid.model_fields_set:
            return number, "dye_diffusivity has no meaning without dye; remove it or give a block or emitter a dye"
    return None


def _written(value: object) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(map(_written, value))})"
    return f'"{value}"' if isinstance(value, str) else "omitted" if value is None else f"{value:g}"


def is_implicit(parameters: FluidParameters, viscosity: float, speed: float) -> bool:
    """Whether viscosity is solved for: as the parameters say, or for "auto" where it would limit the time step.

    `viscosity` is that of the stiffest fluid, against walls too [m²/s], and `speed` that of signals [m/s].
    """
    if parameters.viscosity_solver != "auto" or viscosity == 0.0:
        return parameters.viscosity_solver == "implicit" and viscosity > 0.0
    dt, spacing = parameters.dt, parameters.spacing
    other = float(dt) if dt != "adaptive" else parameters.cfl * CFL_NUMBER * spacing / speed
    return VISCOUS_NUMBER * spacing**2 / viscosity < other
