"""Divergence-free SPH (Bender & Koschier 2015) with the boundaries of Akinci et al. 2012."""

from typing import Any

import numpy as np
import taichi as ti

from sim.fluid.implicit_fluid import ImplicitFluid
from sim.fluid.kernels import evaluate, lattice_offsets, particle_volume
from sim.fluid.pressure_kernels import add_scaled, measure_divergence
from sim.fluid.sheet_forces import DIVERGENCE
from sim.fluid.solve_record import SolveRecord
from sim.solver import Diagnostics

LEAST_ITERATIONS, LEAST_DIVERGENCE_ITERATIONS = 2, 1
"""Iterations of the density and the divergence solve in any case (Bender & Koschier 2015, algorithms 3 and 2)."""

AT_SURFACE = 0.8
"""A particle that lacks more than this share of what the first layer at a flat surface lacks of the rest density is at
a free surface: it has room, and no divergence. Among the particles of a dam break at the usual support these are as
many as have fewer than 20 neighbours, which is the usual criterion, and one that walls of few samples do not meet."""


class DFSPHSolver(ImplicitFluid):
    """A fluid without divergence and without compression, by two pressure solves a step.

    With rho_i relative to the rest density and (D v)_i its rate of change (`sim.fluid.pressure_kernels`):

    1. rho_i = V sum_j W_ij + sum_b V_b W_ib, and 1/A_ii, the factor alpha_i/rho_i of the paper (eq. 9)
    2. divergence solve: P with dt (D v)_i <= 0 for v + dt a^p(P) (algorithm 2), not at the free surface
    3. a_i = gravity, viscosity, cohesion
    4. density solve: P with rho_i + dt (D v)_i <= 1 for v + dt (a + a^p(P)) (algorithm 3)
    5. v_i += dt (a_i + a_i^p), x_i += dt v_i

    kappa of the paper is P_i/rho_i here, and dt² A_ii P_i what that pressure takes away of the compression. Three
    things differ from the paper; docs/decisions/0016-implicit-pressure.md has the measurements. The pressures are
    iterated themselves, at least 0, so that a solve is one linear complementarity problem, and that of the density
    solve is what one would measure; it starts from that of the step before. Relaxation has momentum (`momentum`). And
    of a compression that a particle has already, from walls or the error of linearization, a step takes back a part
    only (`_correction`), as it turns into speed.

    Momentum of fluid pairs is conserved to rounding. `pressures` and `boundary_forces` are those of the density solve;
    the divergence solve adds impulses that are small but where fluid hits something.
    """

    carried = ("pressure",)

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        self._divergence_pressure = ti.ndarray(ti.f32, self.capacity)
        self._least_density = 1.0 - AT_SURFACE * (1.0 - surface_density(self.parameters.support_in_spacings))

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame."""
        super().begin_frame(time_s)
        self._divergence_solves = SolveRecord()

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._compute_density()
        self._begin_sheets()
        self._correct_divergence(dt)
        self._compute_acceleration(None)
        self._react_on_bodies(None, dt)
        self._apply_implicit_viscosity(self._acceleration, dt)
        self._correct_density(dt)
        self._advance_particles(self._acceleration, dt)

    def diagnostics(self) -> Diagnostics:
        """As for every implicit fluid, with the iterations and errors of the divergence solves."""
        common, record = super().diagnostics(), self._divergence_solves
        return {
            **common,
            "divergence_iterations": record.mean_iterations,
            "divergence_error": record.worst_error,
        }

    @property
    def _solves(self) -> dict[str, SolveRecord]:
        return {**super()._solves, "divergence": self._divergence_solves}

    @property
    def _pressure_term(self) -> ti.Ndarray:
        return self._particles.carried["pressure"]

    def _correct_divergence(self, dt: float) -> None:
        particles, boundary = self._particles, self.boundary
        self._recoil_sheets(DIVERGENCE, dt)
        measure_divergence(
            particles.position, particles.velocity, self._density, self._inverse_diagonal, particles.count, *self._list,
            boundary.position, boundary.velocity, boundary.volume, boundary.moving_count > 0,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, dt, self._least_density, self._relaxation,
            self._compression, self._divergence_pressure, self._relaxed_before,
        )  # fmt: skip
        tolerance = self.parameters.divergence_tolerance
        error = self._mean_error(self._compression, self._divergence_pressure, 0.0)
        if error <= tolerance:
            # One relaxation leaves less than there was. To measure how much less would take as long as to make it.
            self._accelerate_by_pressure(self._divergence_pressure)
            self._bodies_respond(self._divergence_pressure)
            self._divergence_solves.add(LEAST_DIVERGENCE_ITERATIONS, error, converged=True)
        else:
            self._divergence_pressure = self._solve(
                self._divergence_solves, self._divergence_pressure, dt,
                least=LEAST_DIVERGENCE_ITERATIONS, tolerance=tolerance,
            )  # fmt: skip
        self._react_on_bodies(self._divergence_pressure, dt, with_friction=False)
        add_scaled(particles.velocity, self._pressure_acceleration, dt, particles.count)

    def _correct_density(self, dt: float) -> None:
        particles = self._particles
        self._predict_compression(dt)
        self._start_from(particles.carried["pressure"])
        particles.carried["pressure"] = self._solve(
            self._density_solves, particles.carried["pressure"], dt,
            least=LEAST_ITERATIONS, tolerance=self.parameters.density_tolerance,
        )  # fmt: skip
        self._react_on_bodies(particles.carried["pressure"], dt, with_friction=False)
        add_scaled(self._acceleration, self._pressure_acceleration, 1.0, particles.count)

    def _relax(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        self._relax_linearly(pressure, dt, iteration)


def surface_density(support_in_spacings: float) -> float:
    """Relative density of the first layer of a lattice with a flat surface [-]."""
    offsets = lattice_offsets(support_in_spacings)
    distances = np.linalg.norm(offsets[offsets[:, 2] <= 0.0], axis=1)
    return particle_volume(1.0, support_in_spacings) * float(evaluate(distances, support_in_spacings).sum())
