"""Traits of the fluid solvers, and the steps they can take, as others know them without loading them, or Taichi."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

CFL_NUMBER = 0.4  # fraction of the particle spacing that a signal may cross in a step (Monaghan 1992)
FORCE_NUMBER = 0.25  # fraction of sqrt(d / |a|) (Monaghan 1992, section 10.3)
VISCOUS_NUMBER = 0.125  # fraction of d² / nu (Morris, Fox & Zhu 1997, eq. 20)
PRESSURE_NUMBER = 1.0  # fraction of the inverse frequency against others' pressure; symplectic Euler is stable up to 2
COHESION_NUMBER = 0.25  # fraction of the inverse frequency of a particle on the spring that its neighbours' cohesion is
CAPILLARY_NUMBER = 0.5  # fraction of sqrt(rho d³/(2 pi sigma)) (Brackbill, Kothe & Zemach 1992, eq. 61)


@dataclass(frozen=True, slots=True)
class SolverTraits:
    """Traits of one solver."""

    skin: float  # reach of the neighbour list beyond the support [support radii]; more: fewer searches, more pairs
    cfl_number: float  # largest displacement of a particle, or of a signal at a speed of sound, in a step [spacings]
    gravity_number: float  # largest step over sqrt(d/g), whatever the speed [-]
    buoyancy_error: float  # of a thin sheet, in the mass of a layer of particles per area (docs/decisions/0023) [-]
    particle_step_s: float  # core time of a particle in a step at a support of two spacings (docs/guide/live.md) [s]
    step_s: float  # time of launching a step's kernels, however few particles and however many cores there are [s]
    splash_factor: float  # largest speed over that of a fall from the top [-]: jets are faster; WCSPH squeezes harder
    speed_ratio: float = 1.0  # speed of sound over the largest expected speed; 1 where there is none

    @property
    def has_sound_speed(self) -> bool:
        """Whether pressure follows the density, at a numerical speed of sound."""
        return self.speed_ratio > 1.0


TRAITS: Mapping[str, SolverTraits] = {
    "wcsph": SolverTraits(
        skin=0.1,
        cfl_number=CFL_NUMBER,
        gravity_number=math.inf,
        buoyancy_error=0.5,
        particle_step_s=0.45e-6,
        step_s=0.25e-3,
        splash_factor=1.6,
        speed_ratio=10.0,  # keeps compression near 1 % (Monaghan 1994)
    ),
    "dfsph": SolverTraits(
        # It takes steps in which particles use any skin up, and passes over the pairs many times in each.
        skin=0.0,
        cfl_number=CFL_NUMBER,
        gravity_number=0.1,  # a column of 20 layers is stable up to 0.13, and not at 0.18
        buoyancy_error=0.06,
        particle_step_s=2.3e-6,
        step_s=1.7e-3,
        splash_factor=1.8,
    ),
    "pcisph": SolverTraits(
        # It looks at the pairs where they will be.
        skin=0.1,
        cfl_number=0.5 * CFL_NUMBER,
        gravity_number=0.05,  # at 0.1 the first solve of a column of 20 layers does not converge
        buoyancy_error=0.06,
        particle_step_s=1.7e-6,
        step_s=1.7e-3,
        splash_factor=1.8,
    ),
}
"""Traits by the name of the solver; the solvers themselves are in `sim.fluid.solvers`."""


def stable_time_step(
    *,
    spacing: float,
    signal_speed: float,
    acceleration: float,
    viscosity: float,
    cohesion_rate: float,
    cfl: float,
    pressure_frequency: float = 0.0,
) -> float:
    """Largest stable step [s]: the smallest of the limits by signals, forces, viscosity, cohesion and pressure.

    Signals have the speed of sound plus the largest speed, or that alone where pressure is implicit. Viscosity is the
    kinematic one with the artificial one; rate and frequency are of springs by cohesion [1/s²] and by pressure [1/s].
    """
    limits = [math.inf]
    if signal_speed > 0.0:
        limits.append(cfl * CFL_NUMBER * spacing / signal_speed)
    if acceleration > 0.0:
        limits.append(FORCE_NUMBER * math.sqrt(spacing / acceleration))
    if viscosity > 0.0:
        limits.append(VISCOUS_NUMBER * spacing * spacing / viscosity)
    if cohesion_rate > 0.0:
        limits.append(COHESION_NUMBER / math.sqrt(cohesion_rate))
    if pressure_frequency > 0.0:
        limits.append(PRESSURE_NUMBER / pressure_frequency)
    return min(limits)
