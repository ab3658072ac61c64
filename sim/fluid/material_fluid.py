"""What the materials of particle fluids need beside the pass over all neighbours: stiff viscosity, surface tension."""

import math
from abc import abstractmethod
from typing import Any

import numpy as np
import taichi as ti

from sim.fluid.body_friction import BodyFriction
from sim.fluid.expected_speed import expected_speed
from sim.fluid.opening import Opening
from sim.fluid.parameters import FluidParameters
from sim.fluid.particle_fluid import ParticleFluid
from sim.fluid.phases import device_table
from sim.fluid.solve_record import SolveRecord
from sim.fluid.surface_tension import cohesion_rate, cohesion_stress
from sim.fluid.surface_tension_akinci2013 import (
    COHESION_PER_TENSION,
    RATE_PER_COHESION,
    SurfaceTensionAkinci2013,
    cohesion_stress_akinci2013,
)
from sim.fluid.viscosity import SOFTENING
from sim.fluid.viscosity_implicit import CARRIED, ImplicitViscosity, is_implicit
from sim.solver import Diagnostics

SQUEEZED = 0.2
"""Relative compression of a particle from which on a frame is counted as squeezed. The mean error of a pressure solve,
which decides whether it converged, says nothing about single particles. Corners of a filled box start at 0.06, and
gaps that close reach just under 0.2; a dam that hits a wall squeezes single particles by up to 0.5, for moments."""


LARGEST_CFL = 2.0
"""As in a job file."""


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
        stress = cohesion_stress(fluids[0].support_in_spacings) * max(f.surface_tension for f in fluids) / spacing
        if self._with_akinci2013:
            stress = cohesion_stress_akinci2013(fluids[0].support_in_spacings) * float(cohesion.max()) * support
        self._expected_speed = _expected_speed(fluids, spacing, stress, body_speed, keywords)

        self._stiffest = max(fluid.viscosity for fluid in fluids) * max(1.0, fluids[0].wall_friction)
        implicit = self._asks_for_implicit_viscosity(fluids[0], self._stiffest)
        self._implicit_viscosity: ImplicitViscosity | None = None
        if implicit:
            self.carried = (*self.carried, *CARRIED)
        super().__init__(*args, **keywords)

        self._explicit_viscosity = self.phases.dynamic_viscosity
        if implicit:
            self.body_forces.let_bodies_respond(self.gravity, self.spacing)
            bodies = BodyFriction(self.boundary, self.body_forces.response)
            self._implicit_viscosity = ImplicitViscosity(self.capacity, bodies)
            self._explicit_viscosity = device_table(np.zeros(len(fluids)))
        if self._with_akinci2013:
            self._akinci2013 = SurfaceTensionAkinci2013(self.capacity)
            self._cohesion, self._largest_cohesion = device_table(cohesion), float(cohesion.max())
            self._adhesion = device_table(np.array([fluid.adhesion for fluid in fluids]))

    def set_viscosity(self, name: str, viscosity: float) -> None:
        """Change the kinematic viscosity of a fluid [m²/s] between frames; no checkpoint knows of it.

        Raises:
            ValueError: there is no such fluid, or built with that it would be solved in the other way.
        """
        phases = self.phases
        if name not in phases.names or not 0.0 <= viscosity < math.inf:
            raise ValueError(f'fluid "{name}": its viscosity cannot become {viscosity:g} m²/s')
        viscosities = phases.viscosities.copy()
        viscosities[phases.names.index(name)] = viscosity
        stiffest = float(viscosities.max()) * max(1.0, self.parameters.wall_friction)
        self._require_same_viscosity_solver(f"viscosity = {viscosity:g}", self.parameters, stiffest)
        phases.set_viscosities(viscosities)
        self._stiffest = stiffest

    def set_cfl(self, cfl: float) -> None:
        """Change the factor on the CFL time step [-] between frames; no checkpoint knows of it.

        Raises:
            ValueError: it is out of range, or with that viscosity would be solved in the other way.
        """
        if not 0.0 < cfl <= LARGEST_CFL:
            raise ValueError(f"cfl must lie above 0 and be {LARGEST_CFL:g} at most, got {cfl:g}")
        parameters = self.parameters.model_copy(update={"cfl": cfl})
        self._require_same_viscosity_solver(f"cfl = {cfl:g}", parameters, self._stiffest)
        self.parameters = parameters

    def _require_same_viscosity_solver(self, change: str, parameters: FluidParameters, stiffest: float) -> None:
        implicit = self._implicit_viscosity is not None
        if self._asks_for_implicit_viscosity(parameters, stiffest) != implicit:
            raise ValueError(
                f"with {change} viscosity would be {'explicit' if implicit else 'implicit'}, which is decided at the "
                f"start; set it in the job, or viscosity_solver there"
            )

    def _asks_for_implicit_viscosity(self, parameters: FluidParameters, stiffest: float) -> bool:
        """Whether these parameters, with this largest viscosity, against walls too [m²/s], have it solved for."""
        return is_implicit(
            parameters.viscosity_solver,
            viscosity=stiffest,
            spacing=2.0 * parameters.particle_radius,
            speed=parameters.sound_speed or self.speed_ratio * self._expected_speed,
            dt=parameters.dt,
            cfl=parameters.cfl,
        )

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame, and its largest speed at the present one."""
        super().begin_frame(time_s)
        if self._implicit_viscosity is not None:
            self._implicit_viscosity.begin_frame()

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the iterations and errors of implicit viscosity in this frame.

        `squeezed` is 1 where a particle is compressed by more than `SQUEEZED` at its end, else 0.
        """
        numbers = dict(super().diagnostics())
        numbers["squeezed"] = float(numbers["max_compression"] > SQUEEZED)
        if self._solves:
            numbers["not_converged"] = float(sum(record.not_converged for record in self._solves.values()))
        if self._implicit_viscosity is not None:
            record = self._implicit_viscosity.record
            numbers |= {"viscosity_iterations": record.mean_iterations, "viscosity_error": record.worst_error}
        return numbers

    @property
    def _solves(self) -> dict[str, SolveRecord]:
        """The solves of this frame, by what they are for."""
        return {} if self._implicit_viscosity is None else {"viscosity": self._implicit_viscosity.record}

    @property
    @abstractmethod
    def _runaway(self) -> tuple[float, str, float]:
        """Multiple of a speed beyond which speeds are numerical, what that speed is, and its value [m/s]."""

    def _bad_motion(self) -> str | None:
        if self._motion.non_finite:
            return f"{self._motion.non_finite} particles with a position or velocity that is not finite"
        if not math.isfinite(self._boundary_speed):
            return f"speed of a moving body {self._boundary_speed} m/s"
        for kind, record in self._solves.items():
            if not math.isfinite(record.worst_error):
                return f"error of a {kind} solve that is not finite"
        ratio, name, speed = self._runaway
        if self._motion.max_speed > ratio * speed:
            return f"speed {self._motion.max_speed:.4g} m/s, beyond {ratio:g} times {name} {speed:.4g} m/s"
        return None

    @property
    def _boundary_speed(self) -> float:
        """Largest speed of a boundary sample [m/s]."""
        return float(np.maximum(self._body_speed, self._sheet_speed))  # which is NaN where either is

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
        kappa = max(fluid.surface_tension for fluid in self.phases.parameters)
        return cohesion_rate(self.parameters.support_in_spacings) * kappa / self.spacing**3

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
        wall_friction = self.parameters.wall_friction

        def friction_terms(velocity: ti.Ndarray) -> tuple[Any, ...]:
            """What friction on bodies is made of (`gather_sample_forces`), at these velocities of the particles."""
            return (
                particles.position, velocity, particles.phase, self._density, self._density,
                phases.rest_density, phases.dynamic_viscosity,
                self.particle_volume * self._sigma / self.support_radius, 1.0 / self.support_radius,
                SOFTENING * self.support_radius**2, 0.0, wall_friction, False, True,
            )  # fmt: skip

        solver.add_acceleration(
            position=particles.position,
            velocity=particles.velocity,
            phase=particles.phase,
            density=self._density,
            count=particles.count,
            neighbor_list=self._list,
            boundary=(boundary.position, boundary.velocity, boundary.friction_volume),
            materials=(phases.rest_density, phases.dynamic_viscosity),
            friction=lambda fluid, samples: self.body_forces.measure(samples, *friction_terms(fluid)),
            gradient_factor=self._sigma / self.support_radius,
            volume=self.particle_volume,
            support_radius=self.support_radius,
            wall_friction=wall_friction,
            rest_density=float(phases.rest_densities.max()),
            carried=particles.carried,
            acceleration=acceleration,
            dt=dt,
        )
        if wall_friction > 0.0:
            self.body_forces.gather(
                *friction_terms(solver.velocity), dt=dt, sample_velocity=solver.bodies.found_velocity()
            )


def _expected_speed(
    fluids: tuple[FluidParameters, ...], spacing: float, stress: float, body_speed: float, keywords: dict[str, Any]
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
        cohesion_stress=stress,
        body_speed=body_speed,
    )
