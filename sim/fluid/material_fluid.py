"""What the materials of particle fluids need beside the pass over all neighbours: stiff viscosity, surface tension."""

from typing import Any

import numpy as np
import taichi as ti

from sim.fluid.expected_speed import expected_speed
from sim.fluid.opening import Opening
from sim.fluid.parameters import FluidParameters
from sim.fluid.particle_fluid import ParticleFluid
from sim.fluid.phases import device_table
from sim.fluid.surface_tension_akinci2013 import (
    COHESION_PER_TENSION,
    RATE_PER_COHESION,
    STRESS_PER_COHESION,
    SurfaceTensionAkinci2013,
)
from sim.fluid.viscosity import SOFTENING
from sim.fluid.viscosity_implicit import CARRIED, ImplicitViscosity, is_implicit
from sim.solver import Diagnostics

STRESS_PER_KAPPA = 0.15
"""Stress of Becker & Teschner's cohesion in a filled lattice over rho kappa/d [-]."""


class MaterialFluid(ParticleFluid):
    """A particle fluid whose viscosity may be implicit, and whose surface tension may be that of Akinci et al. 2013.

    Attributes:
        speed_ratio: speed of the signals that limit the time step over the largest expected speed [-].
    """

    speed_ratio = 1.0

    def __init__(self, *args: Any, body_speed: float = 0.0, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does, and the largest speed of moving bodies [m/s]."""
        given = args[0] if args else keywords["parameters"]
        fluids = (given,) if isinstance(given, FluidParameters) else tuple(given)
        spacing = 2.0 * fluids[0].particle_radius
        self._with_akinci2013 = fluids[0].surface_tension_model == "akinci2013" and any(
            fluid.surface_tension > 0.0 for fluid in fluids
        )
        support = fluids[0].support_in_spacings * spacing
        cohesion = np.array([COHESION_PER_TENSION * f.surface_tension / (f.rest_density * support**2) for f in fluids])
        kappa = max(fluid.surface_tension for fluid in fluids)
        if self._with_akinci2013:
            # The kappa with the same stress, as the speed to expect follows from that.
            kappa = STRESS_PER_COHESION / STRESS_PER_KAPPA * float(cohesion.max()) * support * spacing
        self._expected_speed = _expected_speed(fluids, spacing, kappa, body_speed, keywords)

        self._stiffest = max(fluid.viscosity for fluid in fluids) * max(1.0, fluids[0].wall_friction)
        implicit = is_implicit(
            fluids[0].viscosity_solver,
            viscosity=self._stiffest,
            spacing=spacing,
            speed=fluids[0].sound_speed or self.speed_ratio * self._expected_speed,
            dt=fluids[0].dt,
            cfl=fluids[0].cfl,
        )
        self._implicit_viscosity: ImplicitViscosity | None = None
        if implicit:
            self.carried = (*self.carried, *CARRIED)
        super().__init__(*args, **keywords)

        self._explicit_viscosity = self.phases.dynamic_viscosity
        if implicit:
            self._implicit_viscosity = ImplicitViscosity(self.capacity)
            self._explicit_viscosity = device_table(np.zeros(len(fluids)))
        if self._with_akinci2013:
            self._akinci2013 = SurfaceTensionAkinci2013(self.capacity)
            self._cohesion, self._largest_cohesion = device_table(cohesion), float(cohesion.max())
            self._adhesion = device_table(np.array([fluid.adhesion for fluid in fluids]))

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame, and its largest speed at the present one."""
        super().begin_frame(time_s)
        if self._implicit_viscosity is not None:
            self._implicit_viscosity.begin_frame()

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the iterations of implicit viscosity, the mean of this frame's solves."""
        common = super().diagnostics()
        solves = self._implicit_viscosity
        if solves is None:
            return common
        return {
            **common,
            "viscosity_iterations": solves.iterations / max(solves.solves, 1),
            "not_converged": float(solves.not_converged),
        }

    @property
    def _limiting_viscosity(self) -> float:
        """Viscosity that limits the time step [m²/s]: 0 where it is implicit; without the artificial one."""
        return self._stiffest if self._implicit_viscosity is None else 0.0

    @property
    def _with_kappa(self) -> bool:
        """Whether the pass over all neighbours adds the cohesion of Becker & Teschner 2007."""
        return not self._with_akinci2013 and any(fluid.surface_tension > 0.0 for fluid in self.phases.parameters)

    @property
    def _cohesion_rate(self) -> float:
        """Square of the frequency of a particle on the spring that its neighbours' cohesion is [1/s²]."""
        if self._with_akinci2013:
            return RATE_PER_COHESION * self._largest_cohesion / self.support_radius
        return max(fluid.surface_tension for fluid in self.phases.parameters) * self._sigma

    def _add_surface_tension(self, acceleration: ti.Ndarray) -> None:
        """Add the surface tension of Akinci et al. 2013 where the fluid has it."""
        if not self._with_akinci2013:
            return
        particles, boundary = self._particles, self.boundary
        self._akinci2013.add_acceleration(
            position=particles.position,
            phase=particles.phase,
            density=self._density,
            count=particles.count,
            neighbor_list=self._list,
            boundary=(boundary.position, boundary.volume),
            cohesion=self._cohesion,
            adhesion=self._adhesion,
            sigma=self._sigma,
            volume=self.particle_volume,
            support_radius=self.support_radius,
            with_adhesion=any(fluid.adhesion > 0.0 for fluid in self.phases.parameters),
            acceleration=acceleration,
        )

    def _apply_implicit_viscosity(self, acceleration: ti.Ndarray, dt: float) -> None:
        """Add the acceleration of a step by viscosity to all others that act before it, where it is implicit.

        Its friction on moving bodies is counted as impulses on these.

        Args:
            acceleration: by all other forces [m/s²].
            dt: the step [s].
        """
        solver = self._implicit_viscosity
        if solver is None:
            return
        particles, boundary, phases = self._particles, self.boundary, self.phases
        gradient_factor = self._sigma / self.support_radius
        solver.add_acceleration(
            position=particles.position,
            velocity=particles.velocity,
            phase=particles.phase,
            density=self._density,
            count=particles.count,
            neighbor_list=self._list,
            boundary=(boundary.position, boundary.velocity, boundary.volume),
            materials=(phases.rest_density, phases.dynamic_viscosity),
            gradient_factor=gradient_factor,
            volume=self.particle_volume,
            support_radius=self.support_radius,
            wall_friction=self.parameters.wall_friction,
            carried=particles.carried,
            acceleration=acceleration,
            dt=dt,
        )
        if boundary.moving_count and self.parameters.wall_friction > 0.0:
            self.body_forces.gather(
                particles.position, solver.velocity, particles.phase, self._density, self._density,
                phases.rest_density, phases.dynamic_viscosity,
                self.particle_volume * gradient_factor, 1.0 / self.support_radius,
                SOFTENING * self.support_radius**2, 0.0, self.parameters.wall_friction, False, True, dt=dt,
            )  # fmt: skip


def _expected_speed(
    fluids: tuple[FluidParameters, ...], spacing: float, kappa: float, body_speed: float, keywords: dict[str, Any]
) -> float:
    """Largest speed to expect [m/s] of the particles at the start, of those that will flow in, and of bodies."""
    openings = [
        Opening.of(each, spacing, spacing**3, fluid.support_in_spacings) for fluid in fluids for each in fluid.emitter
    ]
    points = [keywords["positions"], *(opening.points for opening in openings)]
    velocities = [
        keywords["velocities"],
        *(np.broadcast_to(opening.velocity, opening.points.shape) for opening in openings),
    ]
    return expected_speed(
        np.concatenate(points),
        np.concatenate(velocities),
        keywords["domain"],
        keywords["gravity"],
        surface_tension=kappa,
        spacing=spacing,
        body_speed=body_speed,
    )
