"""Implicit pressure: the linear system that the solvers with one share, its iteration, its accuracy and cost.

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
from sim.fluid.forces import Forces
from sim.fluid.kernels import evaluate_slope, lattice_offsets
from sim.fluid.phases import Phases
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
from sim.fluid.tank import ParticleTank
from sim.fluid.time_step import CFL_NUMBER, stable_time_step

RUNAWAY = 30.0, "the largest expected speed"
"""Speeds beyond this multiple of the largest expected one are numerical: the same bound as in WCSPH."""

CORRECTED_PER_CROSSING = 0.5
"""Share of a particle's compression that is taken back while the largest expected speed crosses a spacing."""

MOST_ITERATIONS_AHEAD = 4
"""Iterations between two looks at the error, at most."""

DISORDER = 1.3
"""Largest eigenvalue of A over its diagonal among particles in disorder and at walls, over that of a lattice.

It is 1.26 after random shifts by 0.3 d.
"""

LEAST_DIAGONAL = 1.0e-6
"""Share of a filled neighbourhood's A_ii below which a particle can have no pressure: it has no neighbour."""

LARGEST_ERROR = 1.0e20
"""Means of errors beyond it contain one of a particle that is `NOT_FINITE`."""

CARE_NEAR_BODIES = 10.0
"""Factor by which the error is kept smaller near moving bodies: what is left around a light one accelerates it for many
steps in the same direction."""


Relax = Callable[[ti.Ndarray, int], None]
"""From a pressure that is tried, and the number of the iteration, to the compression left and the next pressure."""


class PressureSolver:
    """Pressure that keeps particles from being compressed in a step.

    A solve looks for P >= 0 such that the compression that is left, s - dt² A P, is 0 where P > 0 and not positive
    elsewhere: a linear complementarity problem, as pressure cannot pull. An iteration computes the accelerations by P,
    lets the moving bodies respond to the same P, measures the compression that both leave, and relaxes P by it. It
    stops when the mean over all particles of the compression left is below the tolerance (its absolute value, but where
    it is negative no more than taking P_i away would change); P and the accelerations are those that left it, and so
    belong together to rounding.

    Attributes:
        acceleration: by the pressure of the last iteration [m/s²], (capacity,) of 3-vectors.
        boundary_response: acceleration of each boundary sample by it [m/s²].
        next_pressure: the pressure to try next [Pa], (capacity,).
        system: right-hand side, diagonal and what is left.
        relaxation: omega, on the inverse diagonal [-].
        filled_diagonal: rho0 A_ii of a particle amid a filled lattice [1/m²].
    """

    def __init__(self, tank: ParticleTank, forces: Forces, phases: Phases, expected_speed: float) -> None:
        """Prepare for the particles of a tank of this largest expected speed [m/s]; bodies answer from now on."""
        self._tank, self._forces, self._phases = tank, forces, phases
        self._expected_speed = expected_speed
        capacity = tank.particles.capacity
        support = tank.discretization.support_in_spacings
        self.relaxation = 1.0 / (DISORDER * largest_eigenvalue(support))
        self.filled_diagonal = filled_diagonal(tank.discretization.spacing, support)
        self.acceleration = ti.Vector.ndarray(3, ti.f32, capacity)
        self.boundary_response = ti.Vector.ndarray(3, ti.f32, 1)
        self.next_pressure = ti.ndarray(ti.f32, capacity)
        self.system = PressureSystem(*(ti.ndarray(ti.f32, capacity) for _ in range(4)), self.relaxation)
        self._least_diagonal = LEAST_DIAGONAL * self.filled_diagonal / float(phases.rest_densities.max())
        self._reduction = LaneReduction(maxima=0, sums=1)
        tank.body_forces.let_bodies_respond(tank.gravity, tank.discretization.spacing)

    def compute_density_and_alpha(self) -> None:
        """Relative density of each particle by summation, and 1/A_ii, for its current neighbours."""
        tank = self._tank
        tank.update_neighbors()
        particles = tank.particles
        compute_density_and_alpha(
            particles.arrays,
            particles.near,
            tank.boundary.samples,
            self._phases.materials,
            tank.discretization.smoothing,
            self._least_diagonal,
            self.system.inverse_diagonal,
        )
        response = tank.body_forces.response
        if response is not None and response.is_needed:
            response.add_to_diagonal(
                particles.arrays, particles.near, tank.discretization, self.relaxation, self.system.inverse_diagonal
            )

    def begin_sheets(self) -> None:
        """Find the fluid that touches sheets, and add their share in A to its diagonal."""
        self._forces.begin_sheets()
        body_forces = self._tank.body_forces
        if body_forces.sheets is not None:
            body_forces.sheets.add_to_diagonal(
                self._tank.particles, body_forces.near, self.relaxation, self.system.inverse_diagonal
            )

    def correction(self, dt: float) -> float:
        """Share of the compression a particle has that a step of dt [s] takes back.

        Taken back in one step it would drive particles apart at a speed that grows as the step shrinks.
        """
        return min(1.0, CORRECTED_PER_CROSSING * self._expected_speed * dt / self._tank.discretization.spacing)

    def predict_compression(self, dt: float) -> None:
        """Compression that a step of dt [s] without pressure leads to, linear in the velocities.

        The velocities that it leads to stand in `acceleration` until the solve needs that.
        """
        tank = self._tank
        predict_compression(
            tank.particles.arrays,
            tank.particles.near,
            tank.boundary.samples,
            tank.discretization.smoothing,
            self._forces.acceleration,
            dt,
            self.correction(dt),
            self.acceleration,
            self.system.compression,
        )

    def start_from(self, pressure: ti.Ndarray) -> None:
        """Note the first guess of a solve, from which its first change of pressure counts."""
        copy_scalars(pressure, self._tank.particles.count, self.system.relaxed_before)

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
        """Iterate until the error is below the tolerance, and count; `acceleration` has the result.

        Args:
            record: where to count.
            pressure: the first guess of P [Pa]; afterwards it may hold anything.
            dt: the step [s].
            least: iterations to make in any case.
            tolerance: mean compression that may be left [-].
            error_growth: give up, not converged, where the error is more than so many times the first one, or ten
                times the tolerance, whichever is larger [-].
            relax: fills `system.remaining` with the compression that the accelerations leave, and `next_pressure`; as
                the linear system has it if omitted.

        Returns:
            P, in this array or in another one.
        """
        limit = max(self._phases.shared.max_iterations, least)
        iteration, next_look, bound = 0, least, math.inf
        while True:
            self.accelerate_by(pressure)
            if relax is None:
                self.relax_linearly(pressure, dt, iteration)
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
        tank = self._tank
        accelerate_by_pressure(
            tank.particles.arrays,
            tank.particles.near,
            tank.boundary.samples,
            self._phases.materials,
            tank.discretization.smoothing,
            pressure,
            self.acceleration,
        )
        response = tank.body_forces.response
        if response is None:
            return
        self.boundary_response = response.no_acceleration
        if tank.body_forces.answer:
            self.boundary_response = tank.body_forces.respond(self._forces.exerted(pressure, with_friction=False))

    def relax_linearly(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        """Compression left, s - dt² A P with s from `system.compression`, and the pressure to try next."""
        tank = self._tank
        relax_pressure(
            tank.particles.arrays,
            tank.particles.near,
            tank.boundary.samples,
            tank.discretization.smoothing,
            self.system,
            self.acceleration,
            self.boundary_response,
            dt**2,
            momentum(iteration),
            pressure,
            self.next_pressure,
        )

    def mean_error(self, pressure: ti.Ndarray, dt: float, remaining: ti.Ndarray | None = None) -> float:
        """Mean error over all particles, or ten times that among those near a moving body, whichever is larger.

        Infinite where that of any particle is not finite.

        Args:
            pressure: with which compression is left [Pa].
            dt: the step [s]; 0 for what is left where no pressure has acted yet.
            remaining: compression that is left of each particle [-]; that of the last relaxation if omitted.
        """
        tank, count = self._tank, self._tank.particles.count
        left = self.system.remaining if remaining is None else remaining
        error_of_each = SolveError(left, pressure, self.system.inverse_diagonal, dt**2)
        results = sum_errors(error_of_each, count, self._reduction.over(count))
        everywhere = float(self._reduction.unpack(results)[0]) / max(count, 1)
        response = tank.body_forces.response
        if response is None or not response.is_needed:
            return everywhere if everywhere < LARGEST_ERROR else math.inf
        # A light body answers to the few particles around it, whose error the mean over all of them would hide.
        near_bodies = tank.body_forces.worst_mean_near_bodies(
            tank.particles.arrays, error_of_each, 1.0 / tank.discretization.support_radius
        )
        error = max(everywhere, CARE_NEAR_BODIES * near_bodies)
        return error if error < LARGEST_ERROR else math.inf

    def adapt_time_step(
        self, *, cfl: float, cfl_number: float, gravity_number: float, viscosity: float, cohesion_rate: float
    ) -> float:
        """Largest time step [s] for the current state.

        No particle goes farther than a share of the spacing, accelerated for the whole step by what accelerated it in
        the last one, or by gravity where that is more.

        Args:
            cfl: the user's factor on the step [-].
            cfl_number: largest displacement of a particle in a step [spacings].
            gravity_number: largest step over sqrt(d/g), whatever the speed [-].
            viscosity: that limits the step [m²/s].
            cohesion_rate: square of the frequency of a particle on the spring that cohesion is [1/s²].
        """
        tank, spacing = self._tank, self._tank.discretization.spacing
        speed = max(tank.motion.max_speed, tank.boundary_speed)
        gravity = float(np.linalg.norm(tank.gravity))
        distance = cfl * cfl_number * spacing
        # (v + a dt) dt = distance, solved for the speed at the end of such a step.
        fastest = 0.5 * (speed + math.sqrt(speed**2 + 4.0 * distance * max(tank.motion.max_acceleration, gravity)))
        limit = stable_time_step(
            spacing=spacing,
            signal_speed=fastest,
            acceleration=0.0,
            viscosity=viscosity,
            cohesion_rate=cohesion_rate,
            cfl=cfl * cfl_number / CFL_NUMBER,
        )
        at_rest = gravity_number * math.sqrt(spacing / gravity) if gravity > 0.0 else math.inf
        return min(limit, at_rest, tank.emission.longest_step(distance))


def iterations_ahead(error: float, tolerance: float) -> int:
    """Iterations until the next look at the error: 1 within 1.26 times the tolerance, 4 from twice that on.

    A look is a sum over all particles, and the device waits for the host to read it. An iteration takes away some
    tenths of the error at first, and less later.
    """
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
    """Share of the last change by which the pressure goes on (Nesterov 1983), (k - 1)/(k + 2), from k = 7 on.

    The first guess is near the solution, so that small shares at first would only cost iterations: 15 % of them.
    """
    k = iteration + 7.0
    return (k - 1.0) / (k + 2.0)
