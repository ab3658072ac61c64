"""Particle fluids as a job file names them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from sim.parameters import NonNegative, Parameters, Positive, Vector3
from sim.shapes.parameters import Placement


def _refuse_absent_solvers(solver: object) -> object:
    if solver in ("dfsph", "pcisph"):
        raise ValueError(f'solver "{solver}" is not in this version; use solver = "wcsph"')
    return solver


class FluidBlockParameters(Placement):
    """A volume filled with fluid at the start."""

    velocity: Vector3 = Field(default=(0.0, 0.0, 0.0), description="Initial velocity [m/s].")


class FluidParameters(Parameters):
    """A fluid: its material, its discretization and the volumes it fills at the start."""

    name: str = Field(description="Name of the fluid, unique in the job.", pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,63}$")
    solver: Annotated[Literal["wcsph"], BeforeValidator(_refuse_absent_solvers)] = Field(
        default="wcsph", description="wcsph: weakly compressible SPH (Becker & Teschner 2007)."
    )
    block: tuple[FluidBlockParameters, ...] = Field(min_length=1, description="Volumes filled at the start.")
    particle_radius: Positive = Field(
        default=0.01, description="Particle radius r [m]; lattice spacing is 2r, support radius 4r."
    )
    rest_density: Positive = Field(default=1000.0, description="Rest density [kg/m³].")
    viscosity: NonNegative = Field(default=1.0e-6, description="Kinematic viscosity nu [m²/s]; water 1e-6.")
    artificial_viscosity: NonNegative = Field(
        default=0.05,
        description="Artificial viscosity alpha (Monaghan 1992) [-]; steadies the pressure, 0 switches it off.",
    )
    surface_tension: NonNegative = Field(
        default=0.0, description="Cohesion kappa of Becker & Teschner 2007 [m³/s²]; 0 switches it off."
    )
    wall_friction: NonNegative = Field(
        default=0.0, description="Viscosity against walls and bodies, as a multiple of the fluid's own [-]."
    )
    sound_speed: Positive | None = Field(
        default=None,
        description="Numerical speed of sound [m/s]; ten times the largest expected speed if omitted.",
    )
    dt: Literal["adaptive"] | Positive = Field(
        default="adaptive",
        description='Time step [s], or "adaptive": the largest that the CFL condition allows.',
    )
    cfl: Positive = Field(default=1.0, le=2.0, description="Factor on the CFL time step [-].")
