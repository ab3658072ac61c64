"""Stiff viscosity: the viscous change of all velocities at once, from a linear system (Weiler et al. 2018)."""

import math
from collections.abc import Callable

import taichi as ti

from sim.core.reductions import LaneReduction
from sim.fluid.body_friction import BodyFriction, Friction
from sim.fluid.device import Fluid
from sim.fluid.discretization import Discretization
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import ParticleSet
from sim.fluid.solve_record import SolveRecord
from sim.fluid.time_step import CFL_NUMBER, VISCOUS_NUMBER
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING
from sim.fluid.viscosity_kernels import (
    Blocks,
    Carried,
    Iterate,
    ViscousMatrix,
    advance_solve,
    finish_solve,
    multiply,
    predict_velocity,
    start_solve,
    sum_norms,
    sum_products,
)

TOLERANCE = 1.0e-3
"""Where the iteration stops: the residual as a velocity, over the velocity changes that viscosity asks for, both as
root mean squares."""

# A solve that needs more is counted as not converged; its velocities are used as they are.
MAX_ITERATIONS = 200

CARRIED = ("viscous_change_x", "viscous_change_y", "viscous_change_z")
"""Velocity change of each particle in the step before [m/s], from which the next solve starts."""

# A restart whose residual is more than this share of that of the restart before has met the limits of float32.
STAGNATION = 0.5

# Velocity changes whose squares add up to less are nothing, and no reason to iterate [m²/s²].
LEAST_SQUARE = 1.0e-24

SUMS = 3


def is_implicit(parameters: FluidParameters, viscosity: float, speed: float) -> bool:
    """Whether viscosity is solved for: as the parameters say, or for "auto" where it would limit the time step.

    `viscosity` is that of the stiffest fluid, against walls too [m²/s], and `speed` that of signals [m/s].
    """
    if parameters.viscosity_solver != "auto" or viscosity == 0.0:
        return parameters.viscosity_solver == "implicit" and viscosity > 0.0
    dt, spacing = parameters.dt, parameters.spacing
    other = float(dt) if dt != "adaptive" else parameters.cfl * CFL_NUMBER * spacing / speed
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
    reduction an iteration (Chronopoulos & Gear 1989). That form carries the residual along, which drifts; so the true
    one is computed where the carried one says that it is done, and if need be the iteration starts again from there.
    In the end the residual over rho0 is added to the change, which is the pair sum with the velocities found: momentum
    is conserved to rounding, wherever the iteration stopped.

    Attributes:
        velocity: of the particles with the change found, those that the pair sums were taken at [m/s].
        bodies: likewise the share of the free bodies.
        record: of the solves of this frame; its error is the true residual in the unit of `TOLERANCE`.
    """

    def __init__(
        self, capacity: int, bodies: BodyFriction, wall_friction: float, discretization: Discretization
    ) -> None:
        """Prepare for particles, for bodies, and for a viscosity against walls over that of the fluid [-]."""
        self.record = SolveRecord()
        self.bodies = bodies
        self._wall_friction, self._discretization = wall_friction, discretization
        self._reduction = LaneReduction(maxima=0, sums=SUMS)
        self.velocity, *vectors = (ti.Vector.ndarray(3, ti.f32, capacity) for _ in range(9))
        self._iterate, self._blocks = Iterate(*vectors[:6]), Blocks(*vectors[6:])
        # The right-hand side has been read when the first direction is written.
        self._given = self._iterate.direction_product

    @property
    def change(self) -> ti.Ndarray:
        """Change of the particles' velocities that the last solve found [m/s]."""
        return self._iterate.change

    def add_acceleration(
        self, particles: ParticleSet, fluid: Fluid, friction: Friction, acceleration: ti.Ndarray, dt: float
    ) -> None:
        """Add the viscous acceleration of a step of dt [s] to all others [m/s²]; `velocity` becomes the new velocities.

        The particles have the scalars `CARRIED`, and `fluid` is the same with the viscosities to solve for.
        """
        carried = Carried(*(particles.carried[name] for name in CARRIED))
        bodies, iterate, d = self.bodies, self._iterate, self._discretization
        bodies.forget()
        if particles.count == 0:
            return
        self._with_bodies = bodies.are_free and self._wall_friction > 0.0
        self._matrix = ViscousMatrix(
            fluid=fluid,
            factor=dt * LAPLACIAN_FACTOR * d.gradient_factor,
            softening=SOFTENING * d.support_radius**2,
            wall_friction=self._wall_friction,
        )
        self._share = self._reduction.over(particles.count)
        predict_velocity(particles.velocity, acceleration, particles.count, dt, carried, self.velocity, iterate.change)
        if self._with_bodies:
            iterate.product.fill(0.0)
            bodies.prepare(friction, self.velocity, iterate.product, dt)
            bodies.guess(iterate.change)
        self._solve()
        finish_solve(self._matrix, iterate, dt, carried, acceleration, self.velocity)

    def _solve(self) -> None:
        """Find the change, and its true residual."""
        left, given, asked = self._start()
        if not left <= given:
            # Without the guess there is less to do: viscosity has nothing to change any more, or something new.
            self._iterate.change.fill(0.0)
            self.bodies.forget()
            left, _, asked = self._start()
        asked = max(asked, LEAST_SQUARE / TOLERANCE**2)
        iterations, wanted, before = 0, TOLERANCE**2 * asked, math.inf
        while left > wanted and left <= STAGNATION**2 * before and iterations < MAX_ITERATIONS:
            iterations += self._advance(wanted, MAX_ITERATIONS - iterations)
            before = left
            left, _, _ = self._start()
        self.record.add(iterations, math.sqrt(left / asked), converged=left <= wanted)

    def _start(self) -> tuple[float, float, float]:
        """Find the true residual of the change so far; squares of it, of the right-hand side and of what that asks for.

        Squares are sums over the particles [m²/s²]: |r/rho0|², |b/rho0|² and |D⁻¹ b|².
        """
        bodies, iterate = self.bodies, self._iterate
        if self._with_bodies:
            bodies.restart(iterate.change)
        start_solve(self._matrix, self.velocity, bodies.changes, self._blocks, iterate, self._given)
        sum_norms(self._matrix, iterate.residual, self._given, self._blocks, self._share)
        return self._with_share_of(bodies.norms)

    def _advance(self, wanted: float, most: int) -> int:
        """Conjugate gradients until the residual they carry along is as small as wanted; returns the iterations."""
        bodies, iterate = self.bodies, self._iterate
        alpha = gamma_before = 0.0
        for iteration in range(most):
            if self._with_bodies:
                bodies.spread_preconditioned()
            multiply(self._matrix, iterate.preconditioned, bodies.changes, iterate.product)
            if self._with_bodies:
                bodies.multiply(iterate.preconditioned)
            sum_products(self._matrix, iterate, self._share)
            gamma, delta, left = self._with_share_of(bodies.products)
            beta = gamma / gamma_before if iteration else 0.0
            curvature = delta - beta * gamma / alpha if iteration else delta
            # Of a positive matrix both are positive; rounding, or velocities that are not finite, end the iteration.
            if left <= wanted or not (curvature > 0.0 and gamma > 0.0):
                return iteration
            alpha, gamma_before = gamma / curvature, gamma
            advance_solve(self._matrix.fluid.particles.count, alpha, beta, self._blocks, iterate)
            if self._with_bodies:
                bodies.advance(alpha, beta)
        return most

    def _with_share_of(self, bodies_share: Callable[[], tuple[float, float, float]]) -> tuple[float, float, float]:
        """The sums over all particles, and the bodies' share in them."""
        first, second, third = (float(value) for value in self._reduction.result())
        if self._with_bodies:
            shares = bodies_share()
            return first + shares[0], second + shares[1], third + shares[2]
        return first, second, third
