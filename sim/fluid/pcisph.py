"""Predictive-corrective incompressible SPH (Solenthaler & Pajarola 2009), boundaries of Akinci et al. 2012."""

import math
from typing import Any

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.implicit_fluid import ImplicitFluid, momentum
from sim.fluid.kernels import distance, spline
from sim.fluid.pressure_kernels import add_scaled, copy_scalars, not_negative
from sim.fluid.solve_record import SolveRecord
from sim.fluid.time_step import CFL_NUMBER
from sim.launch import fast_launch
from sim.solver import Diagnostics

LEAST_ITERATIONS = 3
"""Iterations in any case (Solenthaler & Pajarola 2009, algorithm 2): fewer let the pressure fluctuate."""

LARGEST_ERROR_GROWTH = 2.0
"""A solve whose error grows beyond this multiple diverges: from there on it goes to 1, not down again."""

LARGEST_WAY = 0.5
"""Way [spacings] beyond which a predicted position means nothing: two particles may have passed each other unseen, or
one has left the neighbours that it knows and finds no compression where it is. Steps are made for 0.2."""

ASTRAY = 1.0e10
"""Stands for the compression left of a particle that goes farther; no solve with one of them has a small mean error."""


class PCISPHSolver(ImplicitFluid):
    """A fluid whose pressure is corrected until the positions that it leads to have rest density.

    Each step, with v the velocities and a all accelerations but that by pressure:

    1. x*_i = x_i + dt (v_i + dt (a_i + a_i^p)), the same for samples of moving bodies, at their velocity
    2. rho*_i = V sum_j W(x*_i - x*_j) + sum_b V_b W(x*_i - x*_b), relative to the rest density
    3. P_i += delta_i (rho*_i - 1), at least 0 (eq. 9), with delta_i = 1/(lambda dt² A_i)
    4. a_i^p = -1/rho0_i [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib], and again from 1

    A_i is that of a filled lattice, which makes delta the paper's (eq. 8), or the particle's own A_ii where that is
    larger: beside the strong samples of a wall and among lighter particles the paper's constant overshoots. The paper's
    factor 1/2 is 1/lambda here, with the largest eigenvalue lambda of A over its diagonal, as P goes on with momentum.
    Two more things differ from the paper. The first guess is the pressure of the step before, not 0, so that a deep
    tank need not be pressurized from nothing in every step. And a compression from before is taken back gradually
    (`_correction`), as it turns into speed. The error is the mean over all particles, not the largest: that one hangs
    on single particles that hit a corner, and their number does not shrink with the spacing.

    Where a body closes a gap of about one layer of particles, that does not converge: densities are those at x*, but
    forces act along gradients at x, and a particle squeezed out of the gap is pushed farther the denser it gets. Such a
    solve is given up (`LARGEST_ERROR_GROWTH`, `LARGEST_WAY`, or the iteration limit), and this step's pressure is that
    of the linear problem of divergence-free SPH, s - dt² A P, from the same first guess: it always has a solution.

    Positions are predicted, so the list of neighbours is renewed where a step as long as the last could use up what is
    left of its skin, and steps are half as long as those of divergence-free SPH. That is no guarantee: the skin is
    0.2 d between two particles at the usual support, and a step may bring them 0.4 d closer. A pair that the list does
    not have, farther than 2.2 d apart, may so be predicted at 1.8 d, where each adds 6e-4 to the density of the other;
    that much is seen a step late. From a support of 4 spacings on the skin is 0.4 d, and nothing is.
    """

    carried = ("pressure",)
    cfl_number = 0.5 * CFL_NUMBER
    # At 0.1 the first solve of a column of 20 layers does not converge.
    gravity_number = 0.05

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        self._predicted = ti.Vector.ndarray(3, ti.f32, self.capacity)
        self._first_guess = ti.ndarray(ti.f32, self.capacity)
        self._is_linear = False

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame."""
        super().begin_frame(time_s)
        self._linear_solves = 0

    def diagnostics(self) -> Diagnostics:
        """As for every implicit fluid, with the number of steps whose density was corrected linearly."""
        return {**super().diagnostics(), "linear_solves": float(self._linear_solves)}

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self._compute_density()
        self._begin_sheets()
        self._compute_acceleration(None)
        self._react_on_bodies(None, dt)
        self._apply_implicit_viscosity(self._acceleration, dt)
        self._correct_density(dt)
        self._advance_particles(self._acceleration, dt)

    @property
    def _pressure_term(self) -> ti.Ndarray:
        return self._particles.carried["pressure"]

    def _correct_density(self, dt: float) -> None:
        """Find the pressure of a step of dt [s], if need be the linear one, and add its acceleration."""
        particles, record = self._particles, SolveRecord()
        copy_scalars(particles.carried["pressure"], particles.count, self._first_guess)
        self._solve_density(record, dt, error_growth=LARGEST_ERROR_GROWTH)
        if record.not_converged:
            record = SolveRecord(iterations=record.iterations)
            copy_scalars(self._first_guess, particles.count, particles.carried["pressure"])
            self._predict_compression(dt)
            self._is_linear = True
            self._solve_density(record, dt)
            self._is_linear = False
            self._linear_solves += 1
        self._density_solves.merge(record)
        self._react_on_bodies(particles.carried["pressure"], dt, with_friction=False)
        add_scaled(self._acceleration, self._pressure_acceleration, 1.0, particles.count)

    def _solve_density(self, record: SolveRecord, dt: float, *, error_growth: float = math.inf) -> None:
        carried = self._particles.carried
        self._start_from(carried["pressure"])
        carried["pressure"] = self._solve(
            record, carried["pressure"], dt,
            least=LEAST_ITERATIONS, tolerance=self.parameters.density_tolerance, error_growth=error_growth,
        )  # fmt: skip

    def _update_neighbors(self) -> None:
        # The next step looks at positions as far ahead as this one went.
        ahead = self._travelled + self._motion.max_displacement
        if ahead + max(ahead, self._boundary_travelled) > self._search_radius - self.support_radius:
            self._find_neighbors()
        else:
            super()._update_neighbors()

    def _relax(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        if self._is_linear:
            self._relax_linearly(pressure, dt, iteration)
            return
        particles, boundary, phases = self._particles, self.boundary, self.phases
        predict_positions(
            particles.position, particles.velocity, self._acceleration, self._pressure_acceleration, particles.count,
            dt, self._predicted,
        )  # fmt: skip
        correct_pressure(
            particles.position, (LARGEST_WAY * self.spacing) ** 2, self._predicted, particles.phase, self._density,
            self._inverse_diagonal, particles.count, *self._list,
            boundary.position, boundary.velocity, self._boundary_response, boundary.volume, boundary.moving_count > 0,
            phases.rest_density, len(phases) > 1, self.particle_volume, self._sigma, 1.0 / self.support_radius,
            self._filled_diagonal, dt, self._correction(dt), self._relaxation, momentum(iteration),
            pressure, self._relaxed_before, self._next_pressure, self._remaining,
        )  # fmt: skip


@fast_launch
@ti.kernel
def predict_positions(
    position: Vectors, velocity: Vectors, acceleration: Vectors, pressure_acceleration: Vectors, count: ti.i32,
    dt: ti.f32, predicted: Vectors,
):  # fmt: skip
    """x*_i = x_i + dt (v_i + dt (a_i + a_i^p))."""
    for i in range(count):
        predicted[i] = position[i] + dt * (velocity[i] + dt * (acceleration[i] + pressure_acceleration[i]))


@fast_launch
@ti.kernel
def correct_pressure(
    position: Vectors, largest_way_squared: ti.f32, predicted: Vectors, phase: Integers, density: Floats,
    inverse_diagonal: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_response: Vectors, boundary_volume: Floats,
    with_moving: ti.template(), rest_density: Floats, several: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, filled_diagonal: ti.f32, dt: ti.f32, correction: ti.f32,
    relaxation: ti.f32, momentum: ti.f32, pressure: Floats, relaxed_before: Floats,
    next_pressure: Floats, remaining: Floats,
):  # fmt: skip
    """Relative density at the predicted positions, and the pressure corrected by what is above 1 of it.

    Of a compression that is there already only the share `correction` counts. What remains of a particle that would go
    farther than the largest way is `ASTRAY`.
    """
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = predicted[i]
        own = 0
        if ti.static(several):
            own = phase[i]
        fluid_sum = 1.0  # w(0): the particle itself
        first = start[i]
        for k in range(fluid_count[i]):
            fluid_sum += spline(distance((x_i - predicted[neighbors[first + k * stride]]).norm_sqr()) * inverse_support)
        boundary_sum = 0.0
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            x_b = boundary_position[b]
            if ti.static(with_moving):
                x_b += dt * (boundary_velocity[b] + dt * boundary_response[b])
            boundary_sum += boundary_volume[b] * spline(distance((x_i - x_b).norm_sqr()) * inverse_support)
        left = sigma * (volume * fluid_sum + boundary_sum) - 1.0 - (1.0 - correction) * ti.max(density[i] - 1.0, 0.0)
        delta = relaxation / (dt * dt) * ti.min(inverse_diagonal[i], rest_density[own] / filled_diagonal)
        relaxed = not_negative(pressure[i] + delta * left)
        next_pressure[i] = not_negative(relaxed + momentum * (relaxed - relaxed_before[i]))
        relaxed_before[i] = relaxed
        is_astray = (x_i - position[i]).norm_sqr() > largest_way_squared
        remaining[i] = ti.select(is_astray, ASTRAY, left)
