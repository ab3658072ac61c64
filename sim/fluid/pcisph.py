"""Predictive-corrective incompressible SPH (Solenthaler & Pajarola 2009), boundaries of Akinci et al. 2012."""

from typing import Any

import taichi as ti

from sim.cells import Floats, Integers, Vectors
from sim.fluid.implicit_fluid import ImplicitFluid, momentum
from sim.fluid.kernels import spline
from sim.fluid.pressure_kernels import add_scaled
from sim.fluid.time_step import CFL_NUMBER
from sim.launch import fast_launch

LEAST_ITERATIONS = 3
"""Iterations in any case (Solenthaler & Pajarola 2009, algorithm 2): fewer let the pressure fluctuate."""


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

    Positions are predicted, so two particles may not come near each other unseen: steps are half as long as those of
    divergence-free SPH, and the list of neighbours is renewed before the next step can go beyond its reach.
    """

    carried = ("pressure",)
    cfl_number = 0.5 * CFL_NUMBER
    # At 0.1 the first solve of a column of 20 layers does not converge.
    gravity_number = 0.05

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        self._predicted = ti.Vector.ndarray(3, ti.f32, self.capacity)

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        particles = self._particles
        self._compute_density()
        self._compute_acceleration(None)
        self._react_on_bodies(None, dt)
        self._apply_implicit_viscosity(self._acceleration, dt)
        self._start_from(particles.carried["pressure"])
        particles.carried["pressure"] = self._solve(
            self._density_solves, particles.carried["pressure"], dt,
            least=LEAST_ITERATIONS, tolerance=self.parameters.density_tolerance,
        )  # fmt: skip
        self._react_on_bodies(particles.carried["pressure"], dt, with_friction=False)
        add_scaled(self._acceleration, self._pressure_acceleration, 1.0, particles.count)
        self._advance_particles(self._acceleration, dt)

    @property
    def _pressure_term(self) -> ti.Ndarray:
        return self._particles.carried["pressure"]

    def _update_neighbors(self) -> None:
        # The next step looks at positions as far ahead as this one went.
        ahead = self._travelled + self._motion.max_displacement
        if ahead + max(ahead, self._boundary_travelled) > self._search_radius - self.support_radius:
            self._find_neighbors()
        else:
            super()._update_neighbors()

    def _relax(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        particles, boundary, phases = self._particles, self.boundary, self.phases
        predict_positions(
            particles.position, particles.velocity, self._acceleration, self._pressure_acceleration, particles.count,
            dt, self._predicted,
        )  # fmt: skip
        correct_pressure(
            self._predicted, particles.phase, self._density, self._inverse_diagonal, particles.count, *self._list,
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
    predicted: Vectors, phase: Integers, density: Floats, inverse_diagonal: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_response: Vectors, boundary_volume: Floats,
    with_moving: ti.template(), rest_density: Floats, several: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, filled_diagonal: ti.f32, dt: ti.f32, correction: ti.f32,
    relaxation: ti.f32, momentum: ti.f32, pressure: Floats, relaxed_before: Floats,
    next_pressure: Floats, remaining: Floats,
):  # fmt: skip
    """Relative density at the predicted positions, and the pressure corrected by what is above 1 of it.

    Of a compression that is there already only the share `correction` counts.
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
            fluid_sum += spline((x_i - predicted[neighbors[first + k * stride]]).norm() * inverse_support)
        boundary_sum = 0.0
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            x_b = boundary_position[b]
            if ti.static(with_moving):
                x_b += dt * (boundary_velocity[b] + dt * boundary_response[b])
            boundary_sum += boundary_volume[b] * spline((x_i - x_b).norm() * inverse_support)
        left = sigma * (volume * fluid_sum + boundary_sum) - 1.0 - (1.0 - correction) * ti.max(density[i] - 1.0, 0.0)
        delta = relaxation / (dt * dt) * ti.min(inverse_diagonal[i], rest_density[own] / filled_diagonal)
        relaxed = ti.max(pressure[i] + delta * left, 0.0)
        next_pressure[i] = ti.max(relaxed + momentum * (relaxed - relaxed_before[i]), 0.0)
        relaxed_before[i] = relaxed
        remaining[i] = left
