"""Implicit pressure: the linear system that the solvers with one share, and its iteration.

With D the matrix of the rates of change, D rho_i/Dt = (D v)_i relative to the rest density,

    (D v)_i = sum_j V (v_i - v_j) . grad W_ij + sum_b V_b (v_i - v_b) . grad W_ib,

the forces of pressure are F = -V D^T P with P_i = p_i/(rho_i/rho0)², and what a step of dt changes by them is
-dt² A P, A = V D M^-1 D^T: symmetric and positive semi-definite, whatever the masses M.
"""

import math
from collections.abc import Callable

import numpy as np
import taichi as ti

from sim.core.reductions import LaneReduction
from sim.fluid.body_response import SolveError
from sim.fluid.fluid import SPHFluid
from sim.fluid.kernels import evaluate_slope, lattice_offsets
from sim.fluid.pressure_kernels import (
    PressureSystem,
    accelerate_by_pressure,
    compute_density_and_alpha,
    copy_scalars,
    predict_compression,
    relax_pressure,
    sum_errors,
)
from sim.fluid.solve_record import SolveRecord
from sim.fluid.tank import FluidStart
from sim.fluid.time_step import CFL_NUMBER, stable_time_step
from sim.fluid.traits import TRAITS

# Share of a particle's compression that is taken back while the largest expected speed crosses a spacing.
CORRECTED_PER_CROSSING = 0.5

# Most iterations from one look at the error to the next.
MOST_ITERATIONS_AHEAD = 4

# Largest eigenvalue of A over its diagonal in disorder and at walls, over that of a lattice; 1.26 is measured.
DISORDER = 1.3

# Share of a filled neighbourhood's A_ii below which a particle can have no pressure: it has no neighbour.
LEAST_DIAGONAL = 1.0e-6

# Means of errors beyond it contain one of a particle that is `NOT_FINITE`.
LARGEST_ERROR = 1.0e20

# How much smaller the error is kept near moving bodies: a light one is accelerated by it for many steps.
CARE_NEAR_BODIES = 10.0

Relax = Callable[[ti.Ndarray, int], None]
"""From a pressure that is tried, and the number of the iteration, to the compression left and the next pressure."""


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
        if response is not None and response.is_needed:
            response.add_to_diagonal(fluid, self.relaxation, inverse_diagonal)

    def begin_sheets(self) -> None:
        """Find the fluid that touches sheets, and add their share in A to its diagonal."""
        self.forces.begin_sheets()
        sheets = self.body_forces.sheets
        if sheets is not None:
            sheets.add_to_diagonal(
                self.tank.on_device, self.body_forces.near, self.relaxation, self.system.inverse_diagonal
            )

    def correction(self, dt: float) -> float:
        """Share of the compression a particle has that a step of dt [s] takes back.

        Taken back in one step it would drive particles apart at a speed that grows as the step shrinks.
        """
        return min(1.0, CORRECTED_PER_CROSSING * self.expected_speed * dt / self.spacing)

    def predict_compression(self, dt: float) -> None:
        """Compression that a step of dt [s] without pressure leads to, linear in the velocities.

        The velocities that it leads to stand in `pressure_acceleration` until the solve needs that.
        """
        predict_compression(
            self.tank.on_device,
            self.forces.acceleration,
            dt,
            self.correction(dt),
            self.pressure_acceleration,
            self.system.compression,
        )

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
        error_growth: float = math.inf,
        relax: Relax | None = None,
    ) -> ti.Ndarray:
        """P with an error below the tolerance; `pressure_acceleration` is what it causes.

        Args:
            record: counts the solve.
            pressure: the first guess of P [Pa]; afterwards it may hold anything.
            dt: the step [s].
            least: iterations to make in any case.
            tolerance: mean compression that may be left [-].
            error_growth: give up, not converged, where the error is more than so many times the first one, or ten
                times the tolerance, whichever is larger [-].
            relax: fills `system.remaining` with the compression that the accelerations leave, and `next_pressure`; as
                the linear system has it if omitted.
        """
        limit = max(self.parameters.max_iterations, least)
        iteration, next_look, bound = 0, least, math.inf
        while True:
            self.accelerate_by(pressure)
            if relax is None:
                self._relax_linearly(pressure, dt, iteration)
            else:
                relax(pressure, iteration)
            iteration += 1
            if iteration >= min(next_look, limit):
                error = self.mean_error(pressure, dt)
                if error <= tolerance or iteration >= limit or not error <= bound:
                    record.add(iteration, error, converged=error <= tolerance)
                    return pressure
                if math.isinf(bound):
                    bound = error_growth * max(error, 10.0 * tolerance)
                next_look += iterations_ahead(error, tolerance)
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

    def _relax_linearly(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        """Compression left, s - dt² A P with s from `system.compression`, and the pressure to try next."""
        relax_pressure(
            self.tank.on_device,
            self.system,
            self.pressure_acceleration,
            self.boundary_response,
            dt**2,
            momentum(iteration),
            pressure,
            self.next_pressure,
        )

    def mean_error(self, pressure: ti.Ndarray, dt: float, remaining: ti.Ndarray | None = None) -> float:
        """Mean error over all particles, or ten times that among those near a moving body, whichever is larger.

        Infinite where that of any particle is not finite. The error is what a pressure [Pa] leaves in a step of dt [s]:
        `remaining`, or that of the last relaxation; dt is 0 where no pressure has acted yet.
        """
        count = self.particles.count
        left = self.system.remaining if remaining is None else remaining
        error_of_each = SolveError(left, pressure, self.system.inverse_diagonal, dt**2)
        results = sum_errors(error_of_each, count, self._reduction.over(count))
        error = float(self._reduction.unpack(results)[0]) / max(count, 1)
        response = self.body_forces.response
        if response is not None and response.is_needed:
            # A light body answers to the few particles around it, whose error the mean over all of them would hide.
            near_bodies = self.body_forces.worst_mean_near_bodies(self.tank.on_device, error_of_each)
            error = max(error, CARE_NEAR_BODIES * near_bodies)
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
            cohesion_rate=self.cohesion_rate,
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
