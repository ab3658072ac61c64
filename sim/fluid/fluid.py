"""A particle fluid as the world drives it: what its solvers share besides the parts they are made of."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import taichi as ti

from sim.core.host_access import add, viewed
from sim.core.snapshots import Snapshot
from sim.core.solver import Remedies
from sim.fluid.dye import DYE, Dye
from sim.fluid.exchange import HELD, Exchange
from sim.fluid.expected_speed import expected_speed
from sim.fluid.forces import Forces
from sim.fluid.kernels import Discretization
from sim.fluid.mechanical_pressure import MechanicalPressure
from sim.fluid.opening import openings_of
from sim.fluid.parameters import is_implicit
from sim.fluid.particles import Phases
from sim.fluid.stepping import SolveRecord
from sim.fluid.surface_tension import Cohesion
from sim.fluid.tank import FluidStart, ParticleTank
from sim.fluid.viscosity import CARRIED, LAPLACIAN_FACTOR

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.core.solver import Arrays, Diagnostics
    from sim.fluid.parameters import FluidParameters

SQUEEZED = 0.2
"""Relative compression of a particle from which on a frame is counted as squeezed. A pressure solve converges by its
mean error, which says nothing about single particles; those in corners of a filled box start at 0.06."""

LARGEST_CFL = 2.0  # as in a job file


class SPHFluid(ABC):
    """One fluid, or several in one tank, all of whose forces but pressure are those of `Forces`.

    Densities are relative: rho_i/rho0_i = V sum_j W_ij + sum_b V_b W_ib, with the same volume V for all particles. At
    the interface of two fluids each keeps its own rest density then (Solenthaler & Pajarola 2008, for particles of
    equal volume); in one fluid it is the usual density, divided by rho0.

    Attributes:
        carried: scalars per particle that the solver keeps from step to step, by name.
        solved_for: what it solves for in a step, by name.
        speed_ratio: speed of the signals that limit the time step over the largest expected speed [-].
        runaway: multiple of the speed of signals beyond which speeds are numerical [-], and the name of that speed.
        sheets_answer: whether sheets answer to pressures that are tried within a step.
        looks_ahead: whether a step looks at particles where they will be.
        parameters: of the first fluid, for what all fluids of a tank have in common.
        expected_speed: largest speed to expect [m/s].
        signal_speed: speed of the signals that limit the time step [m/s].
        tank: the particles, and what is around them: `particles`, `boundary` and `body_forces`.
        dye: its diffusion; None where no fluid has some.
        exchange: of places; None where all fluids are as heavy.
        cohesion: surface tension, and what it asks of speeds and steps.
        forces: all but those of pressure.
        solves: the iterative solves of this frame, by what they are for.
    """

    carried: ClassVar[tuple[str, ...]] = ()
    solved_for: ClassVar[tuple[str, ...]] = ()
    speed_ratio: ClassVar[float] = 1.0
    runaway: ClassVar[tuple[float, str]]
    sheets_answer: ClassVar[bool] = False
    looks_ahead: ClassVar[bool] = False

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies.

        Raises:
            ValueError: arrays of the wrong shape, not finite, or with particles outside the domain.
        """
        self.phases = Phases(start.fluids)
        self.parameters = self.phases.shared
        self.name = "+".join(self.phases.names)
        self.discretization = Discretization(self.parameters.spacing, self.parameters.support_in_spacings)
        self.cohesion = Cohesion.of(start.fluids, self.discretization)
        self.expected_speed = _expected_speed(start, self.cohesion.stress)
        self.signal_speed = self.parameters.sound_speed or self.speed_ratio * self.expected_speed
        self._stiffest = float(self.phases.viscosities.max()) * max(1.0, self.parameters.wall_friction)
        self._with_dye = any(fluid.has_dye for fluid in start.fluids)
        with_implicit = is_implicit(self.parameters, self._stiffest, self.signal_speed)
        with_exchange = self.phases.density_contrast > 1.0 and any(start.gravity)
        added = {CARRIED: with_implicit, (DYE,): self._with_dye, (HELD,): with_exchange}
        self.tank = ParticleTank(
            start,
            self.phases,
            self.discretization,
            skin=self.parameters.skin,
            carried=(*self.carried, *(name for names, is_there in added.items() if is_there for name in names)),
            sheets_answer=self.sheets_answer,
            looks_ahead=self.looks_ahead,
        )
        self.particles, self.boundary = self.tank.particles, self.tank.boundary
        self.body_forces = self.tank.body_forces
        self.dye = Dye(start.fluids, self.discretization, self.particles.capacity) if self._with_dye else None
        self.exchange: Exchange | None = None
        if with_exchange:
            first_of_sheets = self.boundary.sheets.first
            self.exchange = Exchange(
                self.particles.capacity, start.gravity, self.discretization.spacing, first_of_sheets
            )
        self.gravity, self.spacing = start.gravity, self.discretization.spacing
        self.particle_volume = self.discretization.particle_volume
        self.forces = Forces(
            self.tank,
            self.phases,
            self.cohesion,
            signal_speed=self.signal_speed,
            speed_ratio=self.speed_ratio,
            with_implicit=with_implicit,
        )
        self._mechanical_pressure = MechanicalPressure(self.particles, self.discretization)
        self.solves = {name: SolveRecord() for name in self.solved_for}
        if self.forces.implicit_viscosity is not None:
            self.solves = {"viscosity": self.forces.implicit_viscosity.record} | self.solves
        self._first_bad: str | None = None

    @property
    def particle_count(self) -> int:
        """Particles that are still in the domain."""
        return self.particles.count

    @abstractmethod
    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""

    @abstractmethod
    def compute_density(self) -> None:
        """Relative density of each particle for its current neighbours, which are found anew where they must be."""

    @abstractmethod
    def adapt_time_step(self) -> float:
        """Largest time step [s] for the current state."""

    @property
    @abstractmethod
    def pressure_term(self) -> ti.Ndarray:
        """P_i = p_i/(rho_i/rho0)² of each particle [Pa]."""

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state, or the fixed one that the parameters name."""
        dt = self.parameters.dt
        return self.adapt_time_step() if dt == "adaptive" else float(dt)

    def begin_frame(self, time_s: float) -> None:  # noqa: ARG002  a fluid's counters do not depend on the time
        """Restart the counters of the frame, and its largest speed at the present one."""
        self.tank.begin_frame()
        if self.forces.air is not None:
            self.forces.air.begin_frame()
        for record in self.solves.values():
            record.clear()

    def advance(self, dt: float, frequency_squared: ti.Ndarray | None = None) -> None:
        """Let dye diffuse, let those held change places, and move all by their acceleration, for a step of dt [s]."""
        if self.dye is not None:
            self.dye.diffuse(self.particles, self.tank.on_device, dt)
        if self.exchange is not None and self.exchange.step(
            self.particles, self.tank.on_device, self.forces.acceleration, dt
        ):
            self.tank.forget_neighbors()
        self.tank.advance(self.forces.acceleration, dt, frequency_squared)
        self._first_bad = self._first_bad or self._bad_motion()

    @property
    def limiting_viscosity(self) -> float:
        """Viscosity that limits the time step [m²/s], the artificial one included; not that which is solved for."""
        physical = self._stiffest if self.forces.implicit_viscosity is None else 0.0
        return physical + self.forces.artificial_viscosity / LAPLACIAN_FACTOR * max(1.0, self.parameters.wall_friction)

    def snapshots(self) -> dict[str, Snapshot]:
        """Positions, velocities, densities, pressures and dye of the particles of each fluid, sorted by particle id."""
        self.compute_density()
        particles = self.particles
        order = particles.order_by_id()
        phase = particles.host(particles.arrays.phase)[order]
        arrays = {
            "position": particles.host(particles.position)[order],
            "velocity": particles.host(particles.velocity)[order],
            "density": particles.host(particles.density)[order],
            "pressure": self._mechanical_pressure.of(self.tank.on_device, self.pressure_term)[order],
            "particle_id": particles.host(particles.arrays.particle_id)[order],
        }
        if self.dye is not None:
            arrays[DYE] = particles.host(particles.carried[DYE])[order]
        snapshots = {}
        for number, fluid in enumerate(self.phases.parameters):
            own = {name: array[phase == number] for name, array in arrays.items()}
            own["density"] = own["density"] * np.float32(fluid.rest_density)
            attributes = {"particle_radius": fluid.particle_radius, "rest_density": fluid.rest_density}
            snapshots[fluid.name] = Snapshot(kind="fluid", arrays=own, attributes=attributes)
        return snapshots

    def view(self, body: str) -> dict[str, NDArray[np.generic]]:
        """Positions [m], velocities [m/s] and ids of a fluid's particles, sorted as the solver has them.

        A fluid that is alone in its tank is seen in the solver's memory on a CPU; of several each gets copies.
        """
        rows, arrays = self._rows_of(body), self.particles.arrays
        return {name: viewed(getattr(arrays, name))[rows] for name in ("position", "velocity", "particle_id")}

    def push(self, body: str, change: NDArray[np.floating]) -> None:
        """Change the velocities of a fluid's particles by (n, 3) in the order of `view`, or (3,) [m/s]."""
        add(self.particles.velocity, self._rows_of(body), change)

    def _rows_of(self, body: str) -> slice | NDArray[np.int64]:
        number = self.phases.names.index(body)
        if len(self.phases) == 1:
            return slice(self.particle_count)
        return np.flatnonzero(viewed(self.particles.arrays.phase)[: self.particle_count] == number)

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """The state of the tank, of which the solver's own part is the carried scalars."""
        return self.tank.checkpoint()

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint bit for bit.

        Raises:
            ValueError: the arrays are not a checkpoint of this fluid.
        """
        self.tank.restore(arrays, self.name)
        self._first_bad = None

    def diagnostics(self) -> Diagnostics:
        """Mass, momentum and energies, summed in float64 by particle id, and the numbers of this frame's steps."""
        self.compute_density()
        particles = self.particles
        order = particles.order_by_id()
        position = particles.host(particles.position)[order].astype(np.float64)
        velocity = particles.host(particles.velocity)[order].astype(np.float64)
        phase = particles.host(particles.arrays.phase)
        mass = (self.particle_volume * self.phases.rest_densities[phase])[order]
        momentum = mass @ velocity
        compression = float(particles.host(particles.density).max(initial=0.0)) - 1.0
        numbers = {
            "mass": float(mass.sum()),
            "momentum_x": float(momentum[0]),
            "momentum_y": float(momentum[1]),
            "momentum_z": float(momentum[2]),
            "kinetic_energy": 0.5 * float(mass @ (velocity**2).sum(axis=1)),
            "potential_energy": -float(mass @ (position @ np.array(self.gravity))),
            "max_speed": self.tank.peak_speed,
            "max_compression": compression,
            "particle_count": float(self.particle_count),
        }
        if len(self.phases) > 1:
            counts = np.bincount(phase, minlength=len(self.phases))
            of_fluids = zip(self.phases.names, counts, strict=True)
            numbers |= {f"particle_count_{name}": float(count) for name, count in of_fluids}
        if self.forces.air is not None:
            numbers |= {f"air_impulse_{a}": float(each) for a, each in zip("xyz", self.forces.air.impulse, strict=True)}
        numbers |= self.tank.counters()
        numbers["squeezed"] = float(compression > SQUEEZED)
        if self.solves:
            numbers["not_converged"] = float(sum(record.not_converged for record in self.solves.values()))
        for kind, record in self.solves.items():
            iterations = "iterations" if kind == "density" else f"{kind}_iterations"
            numbers |= {iterations: record.mean_iterations, f"{kind}_error": record.worst_error}
        return numbers

    def remedies(self) -> Remedies:
        """Smaller steps against pressures that overshoot; larger particles, or slower ones, cross less in a step."""
        return Remedies(
            runaway='use dt = "adaptive", or a smaller dt or cfl',
            short_steps="lower its initial speeds, or give it a larger particle_radius",
        )

    def first_bad_quantity(self) -> str | None:
        """The first non-finite or runaway quantity of any step since the start or `restore`, in words."""
        return self._first_bad

    def set_viscosity(self, name: str, viscosity: float) -> None:
        """Change the kinematic viscosity of a fluid [m²/s] between frames; no checkpoint knows of it.

        Raises:
            ValueError: there is no such fluid, or built with that another solver would be chosen for it.
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
            ValueError: it is out of range, or with that another solver would be chosen for viscosity.
        """
        if not 0.0 < cfl <= LARGEST_CFL:
            raise ValueError(f"cfl must lie above 0 and be {LARGEST_CFL:g} at most, got {cfl:g}")
        parameters = self.parameters.model_copy(update={"cfl": cfl})
        self._require_same_viscosity_solver(f"cfl = {cfl:g}", parameters, self._stiffest)
        self.parameters = parameters

    def _require_same_viscosity_solver(self, change: str, parameters: FluidParameters, stiffest: float) -> None:
        implicit = self.forces.implicit_viscosity is not None
        if is_implicit(parameters, stiffest, self.signal_speed) != implicit:
            raise ValueError(
                f"with {change} viscosity would be {'explicit' if implicit else 'implicit'}, which is decided at the "
                f"start; set it in the job, or viscosity_solver there"
            )

    def _bad_motion(self) -> str | None:
        """Quantity of the last step that is not finite or ran away, in words, or None."""
        tank = self.tank
        if tank.motion.non_finite:
            return f"{tank.motion.non_finite} particles with a position or velocity that is not finite"
        if not math.isfinite(tank.boundary_speed):
            return f"speed of a moving body {tank.boundary_speed} m/s"
        for kind, record in self.solves.items():
            if not math.isfinite(record.worst_error):
                return f"error of a {kind} solve that is not finite"
        ratio, name = self.runaway
        if tank.last_speed > ratio * self.signal_speed:
            return f"speed {tank.last_speed:.4g} m/s, beyond {ratio:g} times {name} {self.signal_speed:.4g} m/s"
        return None


def _expected_speed(start: FluidStart, stress: float) -> float:
    """Largest speed to expect [m/s] of the particles at the start, of those that will flow in, and of bodies."""
    openings = [opening for _, opening in openings_of(start.fluids, bodies=start.followed)]
    points, velocities = zip(
        (start.positions, start.velocities), *(opening.outflow(start.body_speed) for opening in openings), strict=True
    )
    return expected_speed(
        np.concatenate(points),
        np.concatenate(velocities),
        start.domain,
        start.gravity,
        cohesion_stress=stress,
        body_speed=start.body_speed,
        outer_acceleration=start.outer_forces.largest_acceleration,
    )
