"""Stiff viscosity: the viscous change of all velocities at once, from a linear system (Weiler et al. 2018)."""

import math
from collections.abc import Callable
from typing import Any

import taichi as ti

from sim.fluid.body_friction import BodyFriction, Friction
from sim.fluid.solve_record import SolveRecord
from sim.fluid.time_step import CFL_NUMBER, VISCOUS_NUMBER
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING
from sim.fluid.viscosity_kernels import (
    advance_solve,
    finish_solve,
    multiply,
    predict_velocity,
    start_solve,
    sum_norms,
    sum_products,
)
from sim.reductions import LaneReduction

TOLERANCE = 1.0e-3
"""Where the iteration stops: the residual as a velocity, over the velocity changes that viscosity asks for, both as
root mean squares. Both are 0 for a fluid that moves as a rigid body, however fast."""

MAX_ITERATIONS = 200
"""A solve that needs more is counted as not converged; its velocities are used as they are."""

CARRIED = ("viscous_change_x", "viscous_change_y", "viscous_change_z")
"""Velocity change of each particle in the step before [m/s], from which the next solve starts."""

STAGNATION = 0.5
"""A restart whose residual is more than this share of that of the restart before has met the limits of float32."""

LEAST_SQUARE = 1.0e-24
"""Velocity changes whose squares add up to less are nothing, and no reason to iterate [m²/s²]."""

SUMS = 3


def is_implicit(solver: str, *, viscosity: float, spacing: float, speed: float, dt: float | str, cfl: float) -> bool:
    """Whether viscosity is solved for: as `solver` says, or for "auto" where it would limit the time step.

    Args:
        solver: "explicit", "implicit" or "auto".
        viscosity: kinematic viscosity of the stiffest fluid, against walls too [m²/s].
        spacing: particle spacing [m].
        speed: of the signals that limit the step otherwise [m/s].
        dt: the time step [s], or "adaptive".
        cfl: the user's factor on the step.
    """
    if solver != "auto" or viscosity == 0.0:
        return solver == "implicit" and viscosity > 0.0
    other = float(dt) if dt != "adaptive" else cfl * CFL_NUMBER * spacing / speed
    return VISCOUS_NUMBER * spacing**2 / viscosity < other


class ImplicitViscosity:
    """Solves v' = v + dt/rho0 div(mu grad v') for the change v' - v of the velocities.

    With the pair forces of the explicit viscosity (`sim.fluid.viscosity`), taken at the new velocities:

        rho0_i dv_i + dt sum_j k_ij x_ij x_ij^T (dv_i - dv_j) + dt sum_b k_ib x_ib x_ib^T (dv_i - dv_b)
            = -dt sum_j k_ij (v_ij . x_ij) x_ij - dt sum_b k_ib (v_ib . x_ib) x_ib,
        k_ij = 2 (d+2) mu_ij V 2/(rho_i + rho_j) |grad W_ij| / (|x_ij| (|x_ij|² + 0.01 h²)) = k_ji

    and with dv_b = 0 for walls and driven bodies, that of the body for free ones, whose velocities are unknowns too
    (`sim.fluid.body_friction`). The matrix is symmetric and positive definite for every time step: conjugate gradients
    with the 3 x 3 blocks of its diagonal as preconditioner (Weiler et al. 2018, section 3.2), in the form with one
    reduction an iteration (Chronopoulos & Gear 1989). That form carries the residual along, which drifts from the true
    one; so the true one is computed where the carried one says that it is done, and if need be the iteration starts
    again from there. In the end the residual over rho0 is added to the change, which is the pair sum with the
    velocities found: linear and angular momentum are conserved to rounding, wherever the iteration stopped.

    Attributes:
        velocity: of the particles with the change found, those that the pair sums were taken at [m/s].
        bodies: likewise the share of the free bodies.
        record: of the solves of this frame; its error is the true residual in the unit of `TOLERANCE`.
    """

    def __init__(self, capacity: int, bodies: BodyFriction) -> None:
        """Prepare for so many particles, and for bodies."""
        self.record = SolveRecord()
        self.bodies = bodies
        self._reduction = LaneReduction(maxima=0, sums=SUMS)
        vectors = [ti.Vector.ndarray(3, ti.f32, max(capacity, 1)) for _ in range(7)]
        self.velocity, self._change, self._residual, self._preconditioned, self._product = vectors[:5]
        self._direction, self._direction_product = vectors[5:]
        # The right-hand side has been read when the first direction is written.
        self._given = self._direction_product
        # Two vectors hold the six numbers of a symmetric block: its diagonal, then xy, xz and yz.
        self._inverse_diagonal = ti.Vector.ndarray(3, ti.f32, max(capacity, 1))
        self._inverse_mixed = ti.Vector.ndarray(3, ti.f32, max(capacity, 1))

    def begin_frame(self) -> None:
        """Restart the counters of the frame."""
        self.record = SolveRecord()

    def add_acceleration(
        self,
        *,
        position: ti.Ndarray,
        velocity: ti.Ndarray,
        phase: ti.Ndarray,
        density: ti.Ndarray,
        count: int,
        neighbor_list: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray, ti.Ndarray, int],
        boundary: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray],
        materials: tuple[ti.Ndarray, ti.Ndarray],
        friction: Friction,
        gradient_factor: float,
        volume: float,
        support_radius: float,
        wall_friction: float,
        rest_density: float,
        carried: dict[str, ti.Ndarray],
        acceleration: ti.Ndarray,
        dt: float,
    ) -> None:
        """Add the viscous acceleration of a step to all others; leaves the new velocities in `velocity`.

        Args:
            position: of the particles [m].
            velocity: before the step [m/s].
            phase: which of the materials each particle is of.
            density: relative to the rest density [-].
            count: number of particles.
            neighbor_list: start, fluid_count, boundary_count, indices, stride.
            boundary: position [m], velocity [m/s] and volume for friction [m³] of the boundary samples.
            materials: rest density [kg/m³] and dynamic viscosity [Pa s] of each fluid.
            friction: of the particles on the bodies.
            gradient_factor: sigma/h of the kernel [1/m⁴].
            volume: of a particle [m³].
            support_radius: h [m].
            wall_friction: viscosity against boundaries over that of the fluid [-].
            rest_density: of the densest fluid [kg/m³].
            carried: the particles' scalars with the names of `CARRIED`.
            acceleration: by all other forces [m/s²]; that by viscosity is added.
            dt: the step [s].
        """
        changes = tuple(carried[name] for name in CARRIED)
        bodies = self.bodies
        bodies.forget()
        if count == 0:
            return
        self._with_bodies = bodies.are_free and wall_friction > 0.0
        self._count, self._materials = count, (phase, materials[0])
        operator = (
            position, phase, density, count, *neighbor_list, boundary[0], boundary[2], *materials,
            dt * LAPLACIAN_FACTOR * gradient_factor, volume, 1.0 / support_radius,
            SOFTENING * support_radius**2, wall_friction,
        )  # fmt: skip
        predict_velocity(velocity, acceleration, count, dt, *changes, self.velocity, self._change)
        if self._with_bodies:
            self._product.fill(0.0)
            bodies.prepare(friction, self.velocity, self._product, volume=volume, rest_density=rest_density, dt=dt)
            bodies.guess(self._change)
        self._solve(operator, boundary[1])
        finish_solve(*self._materials, self._residual, self._change, count, dt, *changes, acceleration, self.velocity)

    def _solve(self, operator: tuple[Any, ...], boundary_velocity: ti.Ndarray) -> None:
        """Find the change, and its true residual."""
        left, given, asked = self._start(operator, boundary_velocity)
        if not left <= given:
            # Without the guess there is less to do: viscosity has nothing to change any more, or something new.
            self._change.fill(0.0)
            self.bodies.forget()
            left, _, asked = self._start(operator, boundary_velocity)
        asked = max(asked, LEAST_SQUARE / TOLERANCE**2)
        iterations, wanted, before = 0, TOLERANCE**2 * asked, math.inf
        while left > wanted and left <= STAGNATION**2 * before and iterations < MAX_ITERATIONS:
            iterations += self._iterate(operator, wanted, MAX_ITERATIONS - iterations)
            before = left
            left, _, _ = self._start(operator, boundary_velocity)
        self.record.add(iterations, math.sqrt(left / asked), converged=left <= wanted)

    def _start(self, operator: tuple[Any, ...], boundary_velocity: ti.Ndarray) -> tuple[float, float, float]:
        """Find the true residual of the change so far; squares of it, of the right-hand side and of what that asks for.

        Squares are sums over the particles [m²/s²]: |r/rho0|², |b/rho0|² and |D⁻¹ b|².
        """
        bodies = self.bodies
        if self._with_bodies:
            bodies.restart(self._change)
        start_solve(
            *operator, boundary_velocity, self.velocity, self._change, bodies.changes,
            self._inverse_diagonal, self._inverse_mixed, self._residual, self._preconditioned, self._given,
        )  # fmt: skip
        sum_norms(
            *self._materials, self._residual, self._given, self._inverse_diagonal, self._inverse_mixed, *self._lanes,
        )  # fmt: skip
        return self._with_share_of(bodies.norms)

    def _iterate(self, operator: tuple[Any, ...], wanted: float, most: int) -> int:
        """Conjugate gradients until the residual they carry along is as small as wanted; returns the iterations."""
        bodies = self.bodies
        alpha = gamma_before = 0.0
        for iteration in range(most):
            if self._with_bodies:
                bodies.spread_preconditioned()
            multiply(*operator, self._preconditioned, bodies.changes, self._product)
            if self._with_bodies:
                bodies.multiply(self._preconditioned)
            sum_products(*self._materials, self._residual, self._preconditioned, self._product, *self._lanes)
            gamma, delta, left = self._with_share_of(bodies.products)
            beta = gamma / gamma_before if iteration else 0.0
            curvature = delta - beta * gamma / alpha if iteration else delta
            # Of a positive matrix both are positive; rounding, or velocities that are not finite, end the iteration.
            if left <= wanted or not (curvature > 0.0 and gamma > 0.0):
                return iteration
            alpha, gamma_before = gamma / curvature, gamma
            advance_solve(
                self._count, alpha, beta, self._inverse_diagonal, self._inverse_mixed, self._product,
                self._direction, self._direction_product, self._change, self._residual, self._preconditioned,
            )  # fmt: skip
            if self._with_bodies:
                bodies.advance(alpha, beta)
        return most

    @property
    def _lanes(self) -> tuple[Any, ...]:
        """How many particles there are, and how a kernel shares them out, for the end of its arguments."""
        count, lanes = self._count, self._reduction.lanes
        return (
            count, lanes.count, lanes.items(count), lanes.lane_step(count), lanes.item_step(), self._reduction.partial,
        )  # fmt: skip

    def _with_share_of(self, bodies_share: Callable[[], tuple[float, float, float]]) -> tuple[float, float, float]:
        """The sums over all particles, and the bodies' share in them."""
        first, second, third = (float(value) for value in self._reduction.result())
        if self._with_bodies:
            shares = bodies_share()
            return first + shares[0], second + shares[1], third + shares[2]
        return first, second, third
