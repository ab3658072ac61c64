"""What the solvers with an implicit pressure share: the iteration, its accuracy and cost, the time step."""

import math
from abc import abstractmethod
from typing import Any

import numpy as np
import taichi as ti

from sim.fluid.forces import SPHFluid
from sim.fluid.kernels import evaluate_slope, lattice_offsets
from sim.fluid.pressure_kernels import (
    accelerate_by_pressure,
    copy_scalars,
    measure_density_and_diagonal,
    predict_compression,
    relax_pressure,
    sum_errors,
)
from sim.fluid.solve_record import SolveRecord
from sim.fluid.time_step import CFL_NUMBER, stable_time_step
from sim.fluid.viscosity import LAPLACIAN_FACTOR
from sim.reductions import LaneReduction
from sim.solver import Diagnostics

RUNAWAY_RATIO = 30.0
"""Speeds beyond this multiple of the largest expected one are numerical: the same bound as in WCSPH."""

CORRECTED_PER_CROSSING = 0.5
"""Share of a particle's compression that is taken back while the largest expected speed crosses a spacing."""

MOST_ITERATIONS_AHEAD = 4
"""Iterations between two looks at the error, at most."""

DISORDER = 1.3
"""Largest eigenvalue of A over its diagonal among particles in disorder and at walls, over that of a lattice.

Computed for 360 particles in a box: 0.98 on the lattice, 1.12 after random shifts by up to 0.1 d, 1.26 by 0.3 d.
"""

LEAST_DIAGONAL = 1.0e-6
"""Share of a filled neighbourhood's A_ii below which a particle can have no pressure: it has no neighbour."""

LARGEST_ERROR = 1.0e20
"""Means of errors beyond it contain one of a particle that is `NOT_FINITE`."""

CARE_NEAR_BODIES = 10.0
"""How much smaller the error is kept near moving bodies: a mean compression of 1e-4 that is left around a body in a
step of 2 ms is an error of its acceleration of 0.5 m/s², which for a light one does not change sign for many steps."""


class ImplicitFluid(SPHFluid):
    """A fluid whose pressure is what keeps particles from being compressed in a step.

    With the operator A of `sim.fluid.pressure_kernels` a solve looks for P >= 0 such that the compression that is left,
    s - dt² A P, is 0 where P > 0 and not positive elsewhere: a linear complementarity problem, as pressure cannot pull.
    An iteration computes the accelerations by P, lets the moving bodies respond to the same P, measures the compression
    that both leave, and relaxes P by it. It stops when the mean over all particles of the compression left is
    below the tolerance (its absolute value, but where it is negative no more than taking P_i away would change);
    P and the accelerations are those that left it, and so belong together to rounding.

    Attributes:
        cfl_number: largest way of a particle in a step [spacings].
        gravity_number: largest step over sqrt(d/g), whatever the speed.
    """

    cfl_number = CFL_NUMBER
    # A column of 20 layers is stable up to 0.13, and not at 0.18.
    gravity_number = 0.1
    sheets_answer = True
    _relaxation = 1.0

    def __init__(self, *args: Any, **keywords: Any) -> None:
        """Take particles, walls and bodies, as `ParticleFluid` does."""
        super().__init__(*args, **keywords)
        capacity = self.capacity
        self._pressure_acceleration = ti.Vector.ndarray(3, ti.f32, capacity)
        self._compression = ti.ndarray(ti.f32, capacity)
        self._remaining = ti.ndarray(ti.f32, capacity)
        self._inverse_diagonal = ti.ndarray(ti.f32, capacity)
        self._next_pressure = ti.ndarray(ti.f32, capacity)
        self._relaxed_before = ti.ndarray(ti.f32, capacity)
        self._relaxation = 1.0 / (DISORDER * largest_eigenvalue(self.parameters.support_in_spacings))
        self._boundary_response = ti.Vector.ndarray(3, ti.f32, 1)
        self.body_forces.let_bodies_respond(self.gravity, self.spacing)
        self._filled_diagonal = filled_diagonal(self.spacing, self.parameters.support_in_spacings)
        self._reduction = LaneReduction(maxima=0, sums=1)

    def begin_frame(self, time_s: float) -> None:
        """Restart the counters of the frame."""
        super().begin_frame(time_s)
        self._density_solves = SolveRecord()

    def stable_dt(self) -> float:
        """Largest time step [s] for the current state, or the fixed one that the parameters name.

        No particle goes farther than a share of the spacing, accelerated for the whole step by what accelerated it in
        the last one, or by gravity where that is more.
        """
        if self.parameters.dt != "adaptive":
            return float(self.parameters.dt)
        speed = max(self._motion.max_speed, self._boundary_speed)
        gravity = float(np.linalg.norm(self.gravity))
        way = self.parameters.cfl * self.cfl_number * self.spacing
        # (v + a dt) dt = way, solved for the speed at the end of such a step.
        fastest = 0.5 * (speed + math.sqrt(speed**2 + 4.0 * way * max(self._motion.max_acceleration, gravity)))
        artificial = self._artificial_viscosity / LAPLACIAN_FACTOR * max(1.0, self.parameters.wall_friction)
        limit = stable_time_step(
            spacing=self.spacing,
            signal_speed=fastest,
            acceleration=0.0,
            viscosity=self._limiting_viscosity + artificial,
            cohesion_rate=self._cohesion_rate,
            cfl=self.parameters.cfl * self.cfl_number / CFL_NUMBER,
        )
        at_rest = self.gravity_number * math.sqrt(self.spacing / gravity) if gravity > 0.0 else math.inf
        return min(limit, at_rest, self._emission.longest_step(way))

    def diagnostics(self) -> Diagnostics:
        """As for every particle fluid, with the iterations and errors of the pressure solves of this frame."""
        common, record = super().diagnostics(), self._density_solves
        return {
            **common,
            "iterations": record.mean_iterations,
            "density_error": record.worst_error,
        }

    @property
    def _solves(self) -> dict[str, SolveRecord]:
        return {**super()._solves, "density": self._density_solves}

    @property
    def _runaway(self) -> tuple[float, str, float]:
        return RUNAWAY_RATIO, "the largest expected speed", self._expected_speed

    @property
    def _signal_speed(self) -> float:
        return self._expected_speed

    def _compute_density(self) -> None:
        self._update_neighbors()
        particles, boundary, phases = self._particles, self.boundary, self.phases
        measure_density_and_diagonal(
            particles.position, particles.phase, particles.count, *self._list, boundary.position, boundary.volume,
            phases.rest_density, len(phases) > 1, self.particle_volume, self._sigma, 1.0 / self.support_radius,
            LEAST_DIAGONAL * self._filled_diagonal / float(phases.rest_densities.max()),
            self._density, self._inverse_diagonal,
        )  # fmt: skip
        response = self.body_forces.response
        if response is not None and response.is_needed:
            response.add_to_diagonal(
                particles.position, particles.count, self._list, volume=self.particle_volume,
                gradient_factor=self._sigma / self.support_radius, inverse_support=1.0 / self.support_radius,
                relaxation=self._relaxation, inverse_diagonal=self._inverse_diagonal,
            )  # fmt: skip

    def _begin_sheets(self) -> None:
        super()._begin_sheets()
        if self.body_forces.sheets is not None:
            self.body_forces.sheets.add_to_diagonal(
                self.body_forces.near, self._sheet_terms, self._particles.count,
                relaxation=self._relaxation, inverse_diagonal=self._inverse_diagonal,
            )  # fmt: skip

    def _correction(self, dt: float) -> float:
        """Share of the compression a particle has that a step of dt [s] takes back.

        Taken back in one step it would drive particles apart at a speed that grows as the step shrinks: the energy of a
        column at rest, whose corners start compressed by 6 %, rose by 27 % at dt = 1 ms and by 6 % at 2 ms.
        """
        return min(1.0, CORRECTED_PER_CROSSING * self._expected_speed * dt / self.spacing)

    def _solve(
        self, record: SolveRecord, pressure: ti.Ndarray, dt: float, *,
        least: int, tolerance: float, error_growth: float = math.inf,
    ) -> ti.Ndarray:  # fmt: skip
        """Iterate until the error is below the tolerance, and count; `_pressure_acceleration` has the result.

        Args:
            record: where to count.
            pressure: the first guess of P [Pa]; afterwards it may hold anything.
            dt: the step [s].
            least: iterations to make in any case.
            tolerance: mean compression that may be left [-].
            error_growth: give up, not converged, where the error is more than so many times the first one, or ten
                times the tolerance, whichever is larger [-].

        Returns:
            P, in this array or in another one.
        """
        limit = max(self.parameters.max_iterations, least)
        iteration, next_look, bound = 0, least, math.inf
        while True:
            self._accelerate_by_pressure(pressure)
            self._bodies_respond(pressure)
            self._relax(pressure, dt, iteration)
            iteration += 1
            if iteration >= min(next_look, limit):
                error = self._mean_error(self._remaining, pressure, dt)
                if error <= tolerance or iteration >= limit or not error <= bound:
                    record.add(iteration, error, converged=error <= tolerance)
                    return pressure
                if math.isinf(bound):
                    bound = error_growth * max(error, 10.0 * tolerance)
                next_look += iterations_ahead(error, tolerance)
            pressure, self._next_pressure = self._next_pressure, pressure

    def _start_from(self, pressure: ti.Ndarray) -> None:
        """Note the first guess of a solve, from which its first change of pressure counts."""
        copy_scalars(pressure, self._particles.count, self._relaxed_before)

    @abstractmethod
    def _relax(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        """Fill `_remaining` with the compression that the accelerations leave, and `_next_pressure`."""

    def _predict_compression(self, dt: float) -> None:
        """Fill `_compression` with what a step of dt [s] without pressure leads to, linear in the velocities.

        The velocities that it leads to stand in `_pressure_acceleration` until the solve needs that.
        """
        particles, boundary = self._particles, self.boundary
        predict_compression(
            particles.position, particles.velocity, self._acceleration, self._density, particles.count, *self._list,
            boundary.position, boundary.velocity, boundary.volume, boundary.moving_count > 0,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, dt, self._correction(dt),
            self._pressure_acceleration, self._compression,
        )  # fmt: skip

    def _relax_linearly(self, pressure: ti.Ndarray, dt: float, iteration: int) -> None:
        """`_relax` with s - dt² A P for the compression that is left, s from `_compression`."""
        particles, boundary = self._particles, self.boundary
        relax_pressure(
            particles.position, self._pressure_acceleration, self._compression, self._inverse_diagonal,
            particles.count, *self._list,
            boundary.position, self._boundary_response, boundary.volume, boundary.moving_count > 0,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, dt**2, self._relaxation,
            momentum(iteration), pressure, self._relaxed_before, self._next_pressure, self._remaining,
        )  # fmt: skip

    def _accelerate_by_pressure(self, pressure: ti.Ndarray) -> None:
        particles = self._particles
        accelerate_by_pressure(
            particles.position, particles.phase, pressure, particles.count, *self._list,
            self.boundary.position, self.boundary.volume, self.phases.rest_density, len(self.phases) > 1,
            self.particle_volume, self._sigma, 1.0 / self.support_radius, self._pressure_acceleration,
        )  # fmt: skip

    def _bodies_respond(self, pressure: ti.Ndarray) -> None:
        """Fill `_boundary_response`, the acceleration of each sample that answers to this pressure [m/s²]."""
        response = self.body_forces.response
        if response is None:
            return
        self._boundary_response = response.no_acceleration
        if self.body_forces.answer:
            self._boundary_response = self.body_forces.respond(*self._body_force_terms(pressure, with_friction=False))

    def _mean_error(self, remaining: ti.Ndarray, pressure: ti.Ndarray, dt: float) -> float:
        """Mean error over all particles, or ten times that among those near a moving body, whichever is larger.

        Infinite where that of any particle is not finite.

        Args:
            remaining: compression that is left of each particle [-].
            pressure: with which it is left [Pa].
            dt: the step [s]; 0 for what is left where no pressure has acted yet.
        """
        reduction, lanes, count = self._reduction, self._reduction.lanes, self._particles.count
        results = sum_errors(
            remaining, pressure, self._inverse_diagonal, dt**2, count,
            lanes.items(count), lanes.lane_step(count), lanes.item_step(), *reduction.tree,
        )  # fmt: skip
        everywhere = float(reduction.unpack(results)[0]) / max(count, 1)
        response = self.body_forces.response
        if response is None or not response.is_needed:
            return everywhere if everywhere < LARGEST_ERROR else math.inf
        # A light body answers to the few particles around it, whose error the mean over all of them would hide.
        near_bodies = self.body_forces.worst_mean_near_bodies(
            remaining, pressure, self._particles.position, self._inverse_diagonal, dt**2,
            1.0 / self.support_radius,
        )  # fmt: skip
        error = max(everywhere, CARE_NEAR_BODIES * near_bodies)
        return error if error < LARGEST_ERROR else math.inf


def iterations_ahead(error: float, tolerance: float) -> int:
    """Iterations after which the error is worth a look again: 1 within 1.26 times the tolerance, 4 from twice that on.

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
