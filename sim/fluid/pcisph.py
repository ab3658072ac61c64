"""Predictive-corrective incompressible SPH (Solenthaler & Pajarola 2009), boundaries of Akinci et al. 2012."""

import math
from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle
from sim.core.launch import kernel
from sim.core.solver import Diagnostics
from sim.fluid.boundary import shift_behind
from sim.fluid.kernels import distance, spline
from sim.fluid.particles import Fluid, Particles
from sim.fluid.pressure import (
    IncompressibleFluid,
    PressureSystem,
    Relax,
    add_scaled,
    copy_scalars,
    momentum,
    not_negative,
    not_taken_back,
)
from sim.fluid.stepping import SolveRecord
from sim.fluid.tank import FluidStart

LEAST_ITERATIONS = 3  # in any case (Solenthaler & Pajarola 2009, algorithm 2): fewer let the pressure fluctuate
LARGEST_ERROR_GROWTH = 2.0  # a solve whose error grows beyond this multiple diverges

LARGEST_DISPLACEMENT = 0.4
"""Displacement [spacings] beyond which a predicted position means nothing: two particles may have passed each other
unseen, or one has left the neighbours that it knows and finds no compression where it is. Steps are made for 0.2; one
of 0.41 was a particle shot out of the last gap under a box, with more energy than the box had lost."""

ASTRAY = 1.0e10  # stands for the compression left of a particle that goes farther: no mean error with it is small


@bundle
class Correction(NamedTuple):
    """Numbers of the correction of the pressure by predicted positions."""

    dt: ti.f32  # the step [s]
    share: ti.f32  # of a compression from before that counts [-]
    momentum: ti.f32  # share of the last change by which the pressure goes on [-]
    filled_diagonal: ti.f32  # rho0 A_ii of a particle amid a filled lattice [1/m²]
    largest_displacement_squared: ti.f32  # of a prediction [m²]
    firm_pressure: ti.f32  # up to which all of that share is taken back [Pa]


class PCISPHSolver(IncompressibleFluid):
    """A fluid whose pressure is corrected until the positions that it leads to have rest density.

    Each step, with v the velocities and a all accelerations but that by pressure:

    1. x*_i = x_i + dt (v_i + dt (a_i + a_i^p)), the same for samples of moving bodies, at their velocity
    2. rho*_i = V sum_j W(x*_i - x*_j) + sum_b V_b W(x*_i - x*_b), relative to the rest density
    3. P_i += delta_i (rho*_i - 1), at least 0 (eq. 9), with delta_i = 1/(lambda dt² A_i)
    4. a_i^p = -1/rho0_i [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib], and again from 1

    A_i is that of a filled lattice, which makes delta the paper's (eq. 8), or the particle's own A_ii where that is
    larger: beside the strong samples of a wall and among lighter particles the paper's constant overshoots. The paper's
    factor 1/2 is 1/lambda here, with the largest eigenvalue lambda of A over its diagonal, as P goes on with momentum.
    Three more things differ from the paper. The first guess is the pressure of the step before, not 0. A compression
    from before is taken back gradually (`IncompressibleFluid.correction`), as it turns into speed. The error is the
    mean over all particles, not the largest, which hangs on single particles that hit a corner.

    Where a body closes a gap of about one layer of particles, that does not converge: densities are those at x*, but
    forces act along gradients at x. Such a solve is given up (`LARGEST_ERROR_GROWTH`, `LARGEST_DISPLACEMENT`, or the
    iteration limit), and this step's pressure is that of the linear problem of divergence-free SPH, s - dt² A P, from
    the same first guess: it always has a solution.

    Positions are predicted, so the list of neighbours is renewed where a step as long as the last could use up what is
    left of its skin, and steps are half as long as those of divergence-free SPH. A pair may still be predicted at
    1.8 d that the list does not have, where each adds 6e-4 to the density of the other a step late.
    """

    looks_ahead = True

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies."""
        super().__init__(start)
        self._predicted = ti.Vector.ndarray(3, ti.f32, self.particles.capacity)
        self._first_guess = ti.ndarray(ti.f32, self.particles.capacity)
        self._linear_solves = 0

    def substep(self, dt: float) -> None:
        """Advance by dt [s]."""
        self.compute_density()
        self.begin_sheets()
        self.forces.compute(dt)
        self.correct_density_error(dt)
        self.advance(dt)

    def correct_density_error(self, dt: float) -> None:
        """Find the pressure of a step of dt [s], if need be the linear one, and add its acceleration."""
        particles = self.particles
        copy_scalars(particles.carried["pressure"], particles.count, self._first_guess)
        found, given_up = self._solve(dt, error_growth=LARGEST_ERROR_GROWTH, relax=self.predict_and_correct), 0
        if found.not_converged:
            given_up = found.iterations
            copy_scalars(self._first_guess, particles.count, particles.carried["pressure"])
            self.predict_compression(dt)
            found = self._solve(dt)
            self._linear_solves += 1
        self.solves["density"].add(given_up + found.iterations, found.worst_error, converged=not found.not_converged)
        self.forces.react(particles.carried["pressure"], dt)
        add_scaled(self.forces.acceleration, self.pressure_acceleration, 1.0, particles.count)

    def _solve(self, dt: float, *, error_growth: float = math.inf, relax: Relax | None = None) -> SolveRecord:
        carried, record = self.particles.carried, SolveRecord()
        self.start_from(carried["pressure"])
        pressure, least, tolerance = carried["pressure"], LEAST_ITERATIONS, self.parameters.density_tolerance
        carried["pressure"] = self.solve(
            record,
            pressure,
            dt,
            least=least,
            tolerance=tolerance,
            aim=self.quiet_error(dt),
            error_growth=error_growth,
            relax=relax,
            correction=self.correction(dt),
        )
        return record

    def predict_and_correct(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        """Predict positions and densities with a pressure [Pa] for a step of dt [s], and correct it by them."""
        fluid = self.tank.on_device
        predict_positions(fluid.particles, self.forces.acceleration, self.pressure_acceleration, dt, self._predicted)
        farthest, response = (LARGEST_DISPLACEMENT * self.spacing) ** 2, self.boundary_response
        share, beta = self.correction(dt), momentum(iteration)
        correction = Correction(dt, share, beta, self.filled_diagonal, farthest, self.firm_pressure)
        correct_pressure(fluid, self.system, self._predicted, response, correction, pressure, self.next_pressure)

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame."""
        super().begin_frame(time_s)
        self._linear_solves = 0

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the linear solves of this frame."""
        return {**super().diagnostics(), "linear_solves": float(self._linear_solves)}


@kernel
def predict_positions(
    particles: Particles, acceleration: Vectors, pressure_acceleration: Vectors, dt: ti.f32, predicted: Vectors
):
    """x*_i = x_i + dt (v_i + dt (a_i + a_i^p))."""
    for i in range(particles.count):
        predicted[i] = particles.position[i] + dt * (
            particles.velocity[i] + dt * (acceleration[i] + pressure_acceleration[i])
        )


@kernel
def correct_pressure(
    fluid: Fluid,
    system: PressureSystem,
    predicted: Vectors,
    boundary_response: Vectors,
    correction: Correction,
    pressure: Floats,
    next_pressure: Floats,
):
    """Relative density at the predicted positions, and the pressure corrected by what is above 1 of it.

    Of a compression that is there already only a share counts. What remains of a particle that would go farther than
    the largest displacement is `ASTRAY`.
    """
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    dt = correction.dt
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i = predicted[i]
        own = 0
        if ti.static(fluid.materials.several):
            own = particles.phase[i]
        fluid_sum = 1.0  # w(0): the particle itself
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            x_j = predicted[near.indices[first + k * near.stride]]
            fluid_sum += spline(distance((x_i - x_j).norm_sqr()) * fluid.inverse_support)
        boundary_sum = 0.0
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            x_ib = x_i - samples.position[b] + shift_behind(samples, b, particles.position[i])
            if ti.static(samples.with_moving):
                x_ib -= dt * (samples.velocity[b] + dt * boundary_response[b])
            boundary_sum += samples.volume[b] * spline(distance(x_ib.norm_sqr()) * fluid.inverse_support)
        excess = ti.max(particles.density[i] - 1.0, 0.0)
        density = fluid.sigma * (fluid.volume * fluid_sum + boundary_sum)
        left = density - 1.0 - (1.0 - correction.share) * excess
        left -= not_taken_back(particles.density[i], correction.share, pressure[i], correction.firm_pressure)
        stiffer = ti.min(system.inverse_diagonal[i], fluid.materials.rest_density[own] / correction.filled_diagonal)
        delta = system.relaxation / (dt * dt) * stiffer
        relaxed = not_negative(pressure[i] + delta * left)
        next_pressure[i] = not_negative(relaxed + correction.momentum * (relaxed - system.relaxed_before[i]))
        system.relaxed_before[i] = relaxed
        is_astray = (x_i - particles.position[i]).norm_sqr() > correction.largest_displacement_squared
        system.remaining[i] = ti.select(is_astray, ASTRAY, left)
