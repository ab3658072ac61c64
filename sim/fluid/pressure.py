"""Implicit pressure: the linear system that the solvers with one share, and its iteration.

With D the matrix of the rates of change, D rho_i/Dt = (D v)_i relative to the rest density,

    (D v)_i = sum_j V (v_i - v_j) . grad W_ij + sum_b V_b (v_i - v_b) . grad W_ib,

the forces of pressure are F = -V D^T P with P_i = p_i/(rho_i/rho0)², and what a step of dt changes by them is
-dt² A P, A = V D M^-1 D^T: symmetric and positive semi-definite, whatever the masses M.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, is_finite, reduced_tree
from sim.fluid.body_forces import Summed, sum_over_bodies
from sim.fluid.body_response import SolveError, error_left, weigh_errors
from sim.fluid.boundary import WRENCH_WIDTH, Bodies, NearParticles, to_particle
from sim.fluid.fluid import SPHFluid
from sim.fluid.kernels import (
    distance,
    evaluate_slope,
    inverse_distance,
    lattice_offsets,
    slope_over_distance,
    spline,
    spline_slope,
)
from sim.fluid.particles import Fluid
from sim.fluid.stepping import SolveRecord
from sim.fluid.tank import FluidStart
from sim.fluid.traits import CFL_NUMBER, TRAITS, stable_time_step

CORRECTED_PER_CROSSING = 0.5  # of a compression is taken back while the largest expected speed crosses a spacing
QUIET_ERROR = 0.003  # compression to aim at over the way of the fastest particle in a step in spacings [-]
LEAST_ERROR = 1.0e-5  # and the least to aim at: smaller ones move nothing that could be seen
MOST_ITERATIONS_AHEAD = 4  # most iterations from one look at the error to the next
DISORDER = 1.3  # largest eigenvalue of A over its diagonal at worst, over that of a lattice; 1.26 is measured
LEAST_DIAGONAL = 1.0e-6  # of a filled neighbourhood's A_ii: below it a particle has no neighbour and no pressure
LARGEST_ERROR = 1.0e20  # means of errors beyond it contain one of a particle that is `NOT_FINITE`
FIRM_PRESSURE = 1.0  # over rho v² of the expected speed, twice what still fluid has: full correction up to it [-]
CARE_NEAR_BODIES = 10.0  # how much smaller the error is kept near bodies: it accelerates a light one for many steps

Relax = Callable[[ti.Ndarray, float, int], None]
"""From a pressure that is tried, the step and the iteration to the compression left and the next pressure."""


@bundle
class PressureSystem(NamedTuple):
    """Linear system of a pressure solve, (capacity,) each."""

    compression: Floats  # s_i that a step without pressure leads to [-]
    inverse_diagonal: Floats  # 1/A_ii [kg/m], alpha_i of Bender & Koschier 2015 in the unit of this P
    relaxed_before: Floats  # P of the iteration before without its momentum [Pa]
    remaining: Floats  # compression that is left [-]
    relaxation: ti.f32  # omega


class IncompressibleFluid(SPHFluid):
    """A fluid whose pressure keeps particles from being compressed in a step.

    A solve looks for P >= 0 such that the compression that is left, s - dt² A P, is 0 where P > 0 and not positive
    elsewhere: a linear complementarity problem, as pressure cannot pull. An iteration computes the accelerations by P,
    lets the moving bodies respond to the same P, measures the compression that both leave, and relaxes P by it. It
    stops when the mean over all particles of the compression left is below the tolerance (its absolute value, but where
    it is negative no more than taking P_i away would change); P and the accelerations are those that left it.

    Attributes:
        system: right-hand side, diagonal and what is left.
        relaxation: omega, on the inverse diagonal [-].
        filled_diagonal: rho0 A_ii of a particle amid a filled lattice [1/m²].
        firm_pressure: up to which the full share of an existing compression is taken back [Pa].
        pressure_acceleration: by the pressure of the last iteration [m/s²], (capacity,) of 3-vectors.
        boundary_response: acceleration of each boundary sample by it [m/s²].
        next_pressure: the pressure to try next [Pa], (capacity,).
    """

    carried = ("pressure",)
    solved_for = ("density",)
    # As in WCSPH, whose speed of sound is ten times the largest expected one.
    runaway = 30.0, "the largest expected speed"
    sheets_answer = True

    def __init__(self, start: FluidStart) -> None:
        """Take particles, walls and bodies, which answer within the step."""
        super().__init__(start)
        capacity, support = self.particles.capacity, self.discretization.support_in_spacings
        self.relaxation = 1.0 / (DISORDER * largest_eigenvalue(support))
        self.filled_diagonal = filled_diagonal(self.spacing, support)
        self.pressure_acceleration = ti.Vector.ndarray(3, ti.f32, capacity)
        self.boundary_response = ti.Vector.ndarray(3, ti.f32, 1)
        self.next_pressure = ti.ndarray(ti.f32, capacity)
        self.system = PressureSystem(*(ti.ndarray(ti.f32, capacity) for _ in range(4)), self.relaxation)
        self.firm_pressure = FIRM_PRESSURE * float(self.phases.rest_densities.max()) * self.expected_speed**2
        self._least_diagonal = LEAST_DIAGONAL * self.filled_diagonal / float(self.phases.rest_densities.max())
        self._reduction = LaneReduction(maxima=0, sums=1)
        self.body_forces.let_bodies_respond(self.gravity, self.discretization)

    @property
    def pressure_term(self) -> ti.Ndarray:
        """P_i of the density solve of each particle [Pa]."""
        return self.particles.carried["pressure"]

    def compute_density(self) -> None:
        """Relative density of each particle by summation, and 1/A_ii, for its current neighbours."""
        self.tank.update_neighbors()
        fluid, inverse_diagonal = self.tank.on_device, self.system.inverse_diagonal
        compute_density_and_alpha(fluid, self._least_diagonal, inverse_diagonal)
        response = self.body_forces.response
        if response is not None and response.is_needed and not self.body_forces.are_alone:
            response.add_to_diagonal(fluid, self.relaxation, inverse_diagonal)

    def begin_sheets(self) -> None:
        """Find the fluid that touches sheets, and add their share in A to its diagonal."""
        self.forces.begin_sheets()
        if (sheets := self.body_forces.sheets) is not None and not self.body_forces.are_alone:
            fluid, inverse_diagonal = self.tank.on_device, self.system.inverse_diagonal
            sheets.add_to_diagonal(fluid, self.body_forces.near, self.relaxation, inverse_diagonal)

    def correction(self, dt: float) -> float:
        """Share of the compression a particle has that a step of dt [s] takes back.

        Taken back in one step it would drive particles apart at a speed that grows as the step shrinks. At a pressure
        above `firm_pressure` it is less, so that it takes no more work: where a closed room has more than its fill, no
        pressure makes space, and ever more of it would stir the fluid.
        """
        return min(1.0, CORRECTED_PER_CROSSING * self.expected_speed * dt / self.spacing)

    def quiet_error(self, dt: float) -> float:
        """Mean compression at which a density solve of dt [s] stops: the tolerance, or less where all is quiet.

        The compression that is left moves particles: of a fluid at rest it would be what moves it.
        """
        in_spacings = self.tank.motion.max_speed * dt / self.spacing
        return min(self.parameters.density_tolerance, max(QUIET_ERROR * in_spacings, LEAST_ERROR))

    def predict_compression(self, dt: float) -> None:
        """Compression that a step of dt [s] without pressure leads to, linear in the velocities.

        The velocities that it leads to stand in `pressure_acceleration` until the solve needs that.
        """
        predicted, compression = self.pressure_acceleration, self.system.compression
        fluid, acceleration = self.tank.on_device, self.forces.acceleration
        predict_compression(fluid, acceleration, dt, self.correction(dt), predicted, compression)

    def start_from(self, pressure: ti.Ndarray) -> None:
        """Note the first guess of a solve, from which its first change of pressure counts."""
        copy_scalars(pressure, self.particles.count, self.system.relaxed_before)

    def solve(
        self,
        record: SolveRecord,
        pressure: ti.Ndarray,
        dt: float,
        *,
        least: int,
        tolerance: float,
        aim: float | None = None,
        error_growth: float = math.inf,
        relax: Relax | None = None,
        correction: float = 0.0,
    ) -> ti.Ndarray:
        """P with an error below the tolerance; `pressure_acceleration` is what it causes.

        Args:
            record: counts the solve.
            pressure: the first guess of P [Pa]; afterwards it may hold anything.
            dt: the step [s].
            least: iterations to make in any case.
            tolerance: mean compression that may be left [-].
            aim: that at which it stops, the tolerance if omitted [-].
            error_growth: of the first error, or of ten times the tolerance, at which to give up, not converged [-].
            relax: fills `system.remaining` and `next_pressure`; as the linear system has it if omitted.
            correction: share of the compression a particle has that `system.compression` counts [-].
        """
        limit = max(self.parameters.max_iterations, least)
        aim = tolerance if aim is None else aim
        iteration, next_look, bound = 0, least, math.inf
        while True:
            self.accelerate_by(pressure)
            if relax is None:
                beta, left = momentum(iteration), (self.pressure_acceleration, self.boundary_response)
                tried = correction, self.firm_pressure, pressure, self.next_pressure
                relax_pressure(self.tank.on_device, self.system, *left, dt**2, beta, *tried)
            else:
                relax(pressure, dt, iteration)
            iteration += 1
            if iteration >= min(next_look, limit):
                error = self.mean_error(pressure, dt)
                if error <= aim or iteration >= limit or not error <= bound:
                    record.add(iteration, error, converged=error <= tolerance)
                    return pressure
                if math.isinf(bound):
                    bound = error_growth * max(error, 10.0 * tolerance)
                next_look += iterations_ahead(error, aim)
            pressure, self.next_pressure = self.next_pressure, pressure

    def accelerate_by(self, pressure: ti.Ndarray) -> None:
        """Accelerations of particles and of moving samples by a pressure that is tried [Pa]."""
        accelerate_by_pressure(self.tank.on_device, pressure, self.pressure_acceleration)
        response = self.body_forces.response
        if response is None:
            return
        self.boundary_response = response.no_acceleration
        if self.body_forces.answer:
            self.boundary_response = self.body_forces.respond(self.forces.exerted(pressure, with_friction=False))

    def mean_error(self, pressure: ti.Ndarray, dt: float, remaining: ti.Ndarray | None = None) -> float:
        """Mean error over all particles, or ten times that among those near a moving body, whichever is larger.

        Infinite where that of any particle is not finite. The error is what a pressure [Pa] leaves in a step of dt [s]:
        `remaining`, or that of the last relaxation; dt is 0 where no pressure has acted yet.
        """
        count = self.particles.count
        left = self.system.remaining if remaining is None else remaining
        error_of_each = SolveError(left, pressure, self.system.inverse_diagonal, dt**2)
        share, forces = self._reduction.over(count), self.body_forces
        if forces.response is None or not forces.response.is_needed or forces.are_alone:
            total, near_body, weight = sum_errors(error_of_each, count, share)[0], 0.0, 0.0
        else:
            fluid, bodies = self.tank.on_device, self.boundary.bodies
            found = sum_errors_near_bodies(error_of_each, count, share, forces.near, fluid, bodies, forces.summed)
            total, near_body, weight = found[:3]
        error = total / max(count, 1)
        if weight > 0.0:
            # A light body answers to the few particles around it, whose error the mean over all of them would hide.
            error = max(error, CARE_NEAR_BODIES * near_body / weight)
        return error if error < LARGEST_ERROR else math.inf

    def adapt_time_step(self) -> float:
        """Largest time step [s] for the current state.

        No particle goes farther than a share of the spacing, accelerated for the whole step by what accelerated it in
        the last one, or by gravity where that is more.
        """
        tank, cfl, traits = self.tank, self.parameters.cfl, TRAITS[self.parameters.solver]
        speed = max(tank.motion.max_speed, tank.boundary_speed)
        gravity = float(np.linalg.norm(tank.gravity))
        distance = cfl * traits.cfl_number * self.spacing
        # (v + a dt) dt = distance, solved for the speed at the end of such a step.
        fastest = 0.5 * (speed + math.sqrt(speed**2 + 4.0 * distance * max(tank.motion.max_acceleration, gravity)))
        limit = stable_time_step(
            spacing=self.spacing,
            signal_speed=fastest,
            acceleration=0.0,
            viscosity=self.limiting_viscosity,
            cohesion_rate=self.cohesion.rate,
            cfl=cfl * traits.cfl_number / CFL_NUMBER,
        )
        at_rest = traits.gravity_number * math.sqrt(self.spacing / gravity) if gravity > 0.0 else math.inf
        return min(limit, at_rest, tank.emission.longest_step(distance))


def iterations_ahead(error: float, tolerance: float) -> int:
    """Iterations until the next look at the error, for which the device waits: more the farther it is to go."""
    if not math.isfinite(error):
        return MOST_ITERATIONS_AHEAD
    return min(1 + int(3.0 * math.log2(max(error / tolerance, 1.0))), MOST_ITERATIONS_AHEAD)


def filled_diagonal(spacing: float, support_in_spacings: float) -> float:
    """rho0 A_ii of a particle amid a filled lattice: V² sum_j |grad W_ij|² [1/m²]."""
    distances = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1) * spacing
    slopes = evaluate_slope(distances[distances > 0.0], support_in_spacings * spacing)
    return float(spacing**6 * (slopes**2).sum())


def largest_eigenvalue(support_in_spacings: float) -> float:
    """Largest eigenvalue of A over its diagonal in a filled lattice without end [-].

    A plane wave of P with wave vector k is an eigenvector; its eigenvalue is |sum_j sin(k . x_j) grad W_j|² over
    sum_j |grad W_j|². The largest lies on one of the axes of symmetry of the lattice.
    """
    offsets = lattice_offsets(support_in_spacings)
    offsets = offsets[np.linalg.norm(offsets, axis=1) > 0.0]
    distances = np.linalg.norm(offsets, axis=1)
    gradients = evaluate_slope(distances, support_in_spacings)[:, None] * offsets / distances[:, None]
    waves = np.linspace(0.0, np.pi, 181)[:, None, None] * np.array([[1, 0, 0], [1, 1, 0], [1, 1, 1]])
    symbols = np.sin(waves @ offsets.T) @ gradients
    return float((symbols**2).sum(axis=-1).max() / (gradients**2).sum())


def momentum(iteration: int) -> float:
    """Share of the last change by which the pressure goes on (Nesterov 1983), (k - 1)/(k + 2).

    From k = 7 on: the first guess is near the solution, so that small shares would only cost iterations.
    """
    k = iteration + 7.0
    return (k - 1.0) / (k + 2.0)


@func
def density_rate(fluid: Fluid, i: ti.i32, velocity: Vectors, boundary_velocity: Vectors) -> ti.f32:
    """(D v)_i; `boundary_velocity` counts where there are moving samples only."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    x_i, v_i = particles.position[i], velocity[i]
    fluid_sum = 0.0
    first = near.start[i]
    for k in range(near.fluid_count[i]):
        j = near.indices[first + k * near.stride]
        x_ij = x_i - particles.position[j]
        fluid_sum += (v_i - velocity[j]).dot(x_ij) * slope_over_distance(x_ij.norm_sqr(), fluid.inverse_support)
    boundary_sum = 0.0
    first += near.fluid_count[i] * near.stride
    for k in range(near.boundary_count[i]):
        b = near.indices[first + k * near.stride]
        x_ib = to_particle(samples, b, x_i)
        v_ib = v_i
        if ti.static(samples.with_moving):
            v_ib -= boundary_velocity[b]
        boundary_sum += samples.volume[b] * v_ib.dot(x_ib) * slope_over_distance(x_ib.norm_sqr(), fluid.inverse_support)
    return fluid.sigma * fluid.inverse_support * (fluid.volume * fluid_sum + boundary_sum)


@func
def not_negative(pressure: ti.f32) -> ti.f32:
    """The pressure, or 0 where it is negative; one that is not a number stays, where a maximum would make it 0."""
    return ti.select(is_finite(pressure), ti.max(pressure, 0.0), pressure)


@kernel
def compute_density_and_alpha(fluid: Fluid, least_diagonal: ti.f32, inverse_diagonal: Floats):
    """Relative density, and 1/A_ii [kg/m], 0 where A_ii is below the least.

    A_ii = |sum_j V grad W_ij + sum_b V_b grad W_ib|²/rho0_i + sum_j V² |grad W_ij|²/rho0_j, which in one fluid is
    rho_i/alpha_i of Bender & Koschier 2015, eq. 9, in the unit of this P.
    """
    particles, near, samples, materials = ti.static((fluid.particles, fluid.near, fluid.samples, fluid.materials))
    gradient_factor, volume = fluid.sigma * fluid.inverse_support, fluid.volume
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i = particles.position[i]
        own = 0
        if ti.static(materials.several):
            own = particles.phase[i]
        inverse_rho0 = 1.0 / materials.rest_density[own]
        weight_sum = 1.0  # w(0): the particle itself
        gradient_sum = ti.math.vec3(0.0)
        square_sum = 0.0
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            r_squared = x_ij.norm_sqr()
            inverse = inverse_distance(r_squared)
            q = r_squared * inverse * fluid.inverse_support
            weight_sum += spline(q)
            slope = spline_slope(q)
            gradient_sum += slope * inverse * x_ij
            lightness = inverse_rho0
            if ti.static(materials.several):
                lightness = 1.0 / materials.rest_density[particles.phase[j]]
            square_sum += slope * slope * lightness
        boundary_sum = 0.0
        boundary_gradient = ti.math.vec3(0.0)
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            x_ib = to_particle(samples, b, x_i)
            r_squared = x_ib.norm_sqr()
            boundary_sum += samples.volume[b] * spline(distance(r_squared) * fluid.inverse_support)
            boundary_gradient += samples.volume[b] * slope_over_distance(r_squared, fluid.inverse_support) * x_ib
        particles.density[i] = fluid.sigma * (volume * weight_sum + boundary_sum)
        diagonal = (volume * gradient_sum + boundary_gradient).norm_sqr() * inverse_rho0 + volume * volume * square_sum
        diagonal *= gradient_factor * gradient_factor
        inverse_diagonal[i] = ti.select(diagonal > least_diagonal, 1.0 / ti.max(diagonal, least_diagonal), 0.0)


@kernel
def predict_compression(
    fluid: Fluid, acceleration: Vectors, dt: ti.f32, correction: ti.f32, predicted: Vectors, compression: Floats
):
    """Relative compression s_i = dt (D v*)_i + (rho_i - 1) that a step without pressure leads to; v* = v + dt a.

    Where rho_i > 1 already, only the share `correction` of that counts. `predicted` becomes v*.
    """
    for i in range(fluid.particles.count):
        predicted[i] = fluid.particles.velocity[i] + dt * acceleration[i]
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        rate = density_rate(fluid, i, predicted, fluid.samples.velocity)
        excess = fluid.particles.density[i] - 1.0
        compression[i] = dt * rate + ti.min(excess, 0.0) + correction * ti.max(excess, 0.0)


@kernel
def accelerate_by_pressure(fluid: Fluid, pressure: Floats, acceleration: Vectors):
    """a_i = -1/rho0_i [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib]; boundary samples have no own P."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, pressure_i = particles.position[i], pressure[i]
        own = 0
        if ti.static(fluid.materials.several):
            own = particles.phase[i]
        fluid_sum = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            fluid_sum += (pressure_i + pressure[j]) * slope_over_distance(x_ij.norm_sqr(), fluid.inverse_support) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        if pressure_i > 0.0:
            first += near.fluid_count[i] * near.stride
            for k in range(near.boundary_count[i]):
                b = near.indices[first + k * near.stride]
                x_ib = to_particle(samples, b, x_i)
                boundary_sum += samples.volume[b] * slope_over_distance(x_ib.norm_sqr(), fluid.inverse_support) * x_ib
        acceleration[i] = (
            -fluid.sigma
            * fluid.inverse_support
            / fluid.materials.rest_density[own]
            * (fluid.volume * fluid_sum + pressure_i * boundary_sum)
        )


@func
def not_taken_back(density: ti.f32, correction: ti.f32, pressure: ti.f32, firm_pressure: ti.f32) -> ti.f32:
    """Of the share `correction` of an existing compression what a step leaves, as it would take too much work."""
    return correction * ti.max(density - 1.0, 0.0) * (1.0 - firm_pressure / ti.max(pressure, firm_pressure))


@kernel
def relax_pressure(
    fluid: Fluid,
    system: PressureSystem,
    acceleration: Vectors,
    boundary_response: Vectors,
    dt_squared: ti.f32,
    momentum: ti.f32,
    correction: ti.f32,
    firm_pressure: ti.f32,
    pressure: Floats,
    next_pressure: Floats,
):
    """The compression that the accelerations by P leave, and the pressure to try next.

    remaining = s + dt² D a, without what is `not_taken_back`; relaxed = max(P + omega/(dt² A_ii) remaining, 0), next =
    relaxed + momentum (relaxed - relaxed before), at least 0.
    """
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        rate = density_rate(fluid, i, acceleration, boundary_response)
        left = system.compression[i] + dt_squared * rate
        left -= not_taken_back(fluid.particles.density[i], correction, pressure[i], firm_pressure)
        relaxed = not_negative(pressure[i] + system.relaxation / dt_squared * system.inverse_diagonal[i] * left)
        next_pressure[i] = not_negative(relaxed + momentum * (relaxed - system.relaxed_before[i]))
        system.relaxed_before[i] = relaxed
        system.remaining[i] = left


@kernel
def copy_scalars(source: Floats, count: ti.i32, target: Floats):
    """target_i = source_i."""
    for i in range(count):
        target[i] = source[i]


@kernel
def add_scaled(vector: Vectors, other: Vectors, factor: ti.f32, count: ti.i32):
    """vector_i += factor other_i."""
    for i in range(count):
        vector[i] += factor * other[i]


@func
def error_of_lanes(error: SolveError, count: ti.i32, share: Share):
    """The lanes' sums of the errors of all particles that can have a pressure."""
    for lane in range(share.tree.lanes):
        total = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count and error.inverse_diagonal[i] > 0.0:
                total += error_left(error, i)
        share.tree.partial[lane] = total


@kernel
def sum_errors(error: SolveError, count: ti.i32, share: Share) -> Results:
    """Sum of the errors of all particles that can have a pressure."""
    error_of_lanes(error, count, share)
    return reduced_tree(share.tree)


@kernel
def sum_errors_near_bodies(
    error: SolveError,
    count: ti.i32,
    share: Share,
    near: NearParticles,
    fluid: Fluid,
    bodies: Bodies,
    summed: Summed,
) -> Results:
    """As `sum_errors`; then the sum of the weighed errors near the body that has the largest mean, and of weights."""
    error_of_lanes(error, count, share)
    weigh_errors(near, fluid, error, summed.force)
    sum_over_bodies(fluid.samples, bodies, summed)
    results = reduced_tree(share.tree)
    worst, its_weight = 0.0, 0.0
    ti.loop_config(serialize=True)
    for body in range(bodies.count):
        of_body, weight = summed.wrench[body * WRENCH_WIDTH], summed.wrench[body * WRENCH_WIDTH + 1]
        if weight > 0.0 and of_body * its_weight >= worst * weight:
            worst, its_weight = of_body, weight
    results[1], results[2] = worst, its_weight
    return results
