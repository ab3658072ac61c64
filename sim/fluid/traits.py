"""Traits of the fluid solvers that others know without loading them, or Taichi."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sim.fluid.time_step import CFL_NUMBER


@dataclass(frozen=True, slots=True)
class SolverTraits:
    """Traits of one solver.

    Attributes:
        skin: reach of the neighbour list beyond the support [support radii]. More means fewer searches, and more pairs
            in every step.
        cfl_number: largest displacement of a particle in a step [spacings]; where there is a speed of sound, that of
            a signal.
        gravity_number: largest step over sqrt(d/g), whatever the speed [-].
        buoyancy_error: error of the buoyancy of a thin sheet, in the mass of a layer of particles per area
            (docs/decisions/0023-cloth-and-fluid.md) [-].
        speed_ratio: speed of sound over the largest expected speed; 1 where there is none.
        particle_step_s: core time of a particle in a step at a support of two spacings (docs/guide/live.md) [s].
        step_s: time of launching a step's kernels, however few particles and however many cores there are [s].
        splash_factor: largest speed over that of a fall from the top [-]: jets are faster, and squeezed particles of
            WCSPH are stiffer.
    """

    skin: float
    cfl_number: float
    gravity_number: float
    buoyancy_error: float
    particle_step_s: float
    step_s: float
    splash_factor: float
    speed_ratio: float = 1.0

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
