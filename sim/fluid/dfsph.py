"""Divergence-free SPH (Bender & Koschier 2015) with the boundaries of Akinci et al. 2012."""

import numpy as np
import taichi as ti

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.core.neighbors import Neighbors
from sim.core.solver import Diagnostics
from sim.fluid.boundary import Samples
from sim.fluid.discretization import Smoothing
from sim.fluid.fluid import SPHFluid
from sim.fluid.kernels import evaluate, lattice_offsets, particle_volume
from sim.fluid.particles import Particles
from sim.fluid.pressure import RUNAWAY, PressureSolver
from sim.fluid.pressure_kernels import PressureSystem, add_scaled, density_rate, not_negative
from sim.fluid.sheet_forces import DIVERGENCE
from sim.fluid.solve_record import SolveRecord
from sim.fluid.tank import FluidStart
from sim.fluid.time_step import CFL_NUMBER

NOT_SOLVED = -1.0e6
"""Relative compression of a particle that takes no part in a solve: so much room that its pressure stays 0."""

LEAST_ITERATIONS, LEAST_DIVERGENCE_ITERATIONS = 2, 1
"""Iterations of the density and the divergence solve in any case (Bender & Koschier 2015, algorithms 3 and 2)."""

AT_SURFACE = 0.8
"""A particle that lacks more than this share of what the first layer at a flat surface lacks of the rest density is at
a free surface: it has room, and no divergence. The usual criterion, fewer than 20 neighbours, is none for
walls of few samples."""


class DFSPHSolver(SPHFluid):
    """A fluid without divergence and without compression, by two pressure solves a step.

    With rho_i relative to the rest density and (D v)_i its rate of change (`sim.fluid.pressure`):

    1. rho_i = V sum_j W_ij + sum_b V_b W_ib, and 1/A_ii, the factor alpha_i/rho_i of the paper (eq. 9)
    2. divergence solve: P with dt (D v)_i <= 0 for v + dt a^p(P) (algorithm 2), not at the free surface
    3. a_i = gravity, viscosity, cohesion
    4. density solve: P with rho_i + dt (D v)_i <= 1 for v + dt (a + a^p(P)) (algorithm 3)
    5. v_i += dt (a_i + a_i^p), x_i += dt v_i

    kappa of the paper is P_i/rho_i here, and dt² A_ii P_i what that pressure takes away of the compression. Three
    things differ from the paper; docs/decisions/0016-implicit-pressure.md has the measurements. The pressures are
    iterated themselves, at least 0, so that a solve is one linear complementarity problem, and that of the density
    solve is what one would measure; it starts from that of the step before. Relaxation has momentum
    (`sim.fluid.pressure.momentum`). And of a compression that a particle has already, from walls or the error of
    linearization, a step takes back a part only (`PressureSolver.correction`), as it turns into speed.

    Momentum of fluid pairs is conserved to rounding. `pressures` and `boundary_forces` are those of the density solve;
    the divergence solve adds impulses that are small but where fluid hits something.

    Attributes:
        cfl_number: largest displacement of a particle in a step [spacings].
        gravity_number: largest step over sqrt(d/g), whatever the speed.
        pressure: the solves.
        least_density: below which a particle has no divergence [-].
    """

    carried = ("pressure",)
    runaway = RUNAWAY
    sheets_answer = True
    cfl_number = CFL_NUMBER
    # A column of 20 layers is stable up to 0.13, and not at 0.18.
    gravity_number = 0.1

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies."""
        super().__init__(start)
        self.pressure = PressureSolver(self.tank, self.forces, self.phases, self.expected_speed)
        self._divergence_pressure = ti.ndarray(ti.f32, self.particles.capacity)
        self.least_density = 1.0 - AT_SURFACE * (1.0 - surface_density(self.discretization.support_in_spacings))
        self._density_solves, self._divergence_solves = SolveRecord(), SolveRecord()

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self.compute_density()
        self.pressure.begin_sheets()
        self.correct_divergence_error(dt)
        self.forces.compute(dt)
        self.pressure.predict_compression(dt)
        self.correct_density_error(dt)
        self.advance(dt)

    def compute_density(self) -> None:
        """Relative density of each particle by summation, and the diagonal of the pressure's matrix."""
        self.pressure.compute_density_and_alpha()

    def correct_divergence_error(self, dt: float) -> None:
        """Make the velocities free of divergence, for a step of dt [s]."""
        particles, system, pressure = self.particles, self.pressure.system, self._divergence_pressure
        self.forces.recoil_sheets(DIVERGENCE, dt)
        compute_divergence(
            particles.arrays,
            particles.near,
            self.boundary.samples,
            self.discretization.smoothing,
            system,
            dt,
            self.least_density,
            pressure,
        )
        tolerance = self.parameters.divergence_tolerance
        error = self.pressure.mean_error(pressure, 0.0, system.compression)
        if error <= tolerance:
            # One relaxation leaves less than there was. To measure how much less would take as long as to make it.
            self.pressure.accelerate_by(pressure)
            self._divergence_solves.add(LEAST_DIVERGENCE_ITERATIONS, error, converged=True)
        else:
            pressure = self.pressure.solve(
                self._divergence_solves, pressure, dt, least=LEAST_DIVERGENCE_ITERATIONS, tolerance=tolerance
            )
        self._divergence_pressure = pressure
        self.forces.react(pressure, dt)
        add_scaled(particles.velocity, self.pressure.acceleration, dt, particles.count)

    def correct_density_error(self, dt: float) -> None:
        """Add the acceleration by the pressure that leaves no compression after a step of dt [s]."""
        carried = self.particles.carried
        self.pressure.start_from(carried["pressure"])
        carried["pressure"] = self.pressure.solve(
            self._density_solves,
            carried["pressure"],
            dt,
            least=LEAST_ITERATIONS,
            tolerance=self.parameters.density_tolerance,
        )
        self.forces.react(carried["pressure"], dt)
        add_scaled(self.forces.acceleration, self.pressure.acceleration, 1.0, self.particles.count)

    def adapt_time_step(self) -> float:
        """Largest time step [s] for the current state."""
        return self.pressure.adapt_time_step(
            cfl=self.parameters.cfl,
            cfl_number=self.cfl_number,
            gravity_number=self.gravity_number,
            viscosity=self.limiting_viscosity,
            cohesion_rate=self.cohesion_rate,
        )

    @property
    def pressure_term(self) -> ti.Ndarray:
        """P_i of the density solve of each particle [Pa]."""
        return self.particles.carried["pressure"]

    @property
    def solves(self) -> dict[str, SolveRecord]:
        """The solves of this frame, by what they are for."""
        return {**super().solves, "density": self._density_solves, "divergence": self._divergence_solves}

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame."""
        super().begin_frame(time_s)
        self._density_solves, self._divergence_solves = SolveRecord(), SolveRecord()

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the iterations and errors of the solves of this frame."""
        return {
            **super().diagnostics(),
            "iterations": self._density_solves.mean_iterations,
            "density_error": self._density_solves.worst_error,
            "divergence_iterations": self._divergence_solves.mean_iterations,
            "divergence_error": self._divergence_solves.worst_error,
        }


def surface_density(support_in_spacings: float) -> float:
    """Relative density of the first layer of a lattice with a flat surface [-]."""
    offsets = lattice_offsets(support_in_spacings)
    distances = np.linalg.norm(offsets[offsets[:, 2] <= 0.0], axis=1)
    return particle_volume(1.0, support_in_spacings) * float(evaluate(distances, support_in_spacings).sum())


@kernel
def compute_divergence(
    particles: Particles,
    near: Neighbors,
    samples: Samples,
    smoothing: Smoothing,
    system: PressureSystem,
    dt: ti.f32,
    least_density: ti.f32,
    pressure: Floats,
):
    """Relative compression s_i = dt (D v)_i, and the first relaxation of it from P = 0.

    Below the least density a particle is `NOT_SOLVED`.
    """
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        rate = density_rate(i, particles.velocity, samples.velocity, particles, near, samples, smoothing)
        s_i = dt * rate
        if particles.density[i] < least_density:
            s_i = NOT_SOLVED
        p_i = not_negative(system.relaxation / (dt * dt) * system.inverse_diagonal[i] * s_i)
        system.compression[i] = s_i
        pressure[i] = p_i
        system.relaxed_before[i] = p_i
