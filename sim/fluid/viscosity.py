"""Viscous forces between particles: explicit, or for stiff fluids from a linear system (Weiler et al. 2018)."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, reduced_tree
from sim.fluid.body_friction import BodyFriction, Friction
from sim.fluid.boundary import to_particle
from sim.fluid.kernels import TINY_DISTANCE, Discretization, spline_slope
from sim.fluid.particles import Fluid, Particles, ParticleSet
from sim.fluid.stepping import SolveRecord

LAPLACIAN_FACTOR = 10.0  # 2 (d + 2) of Monaghan's viscosity in d = 3 dimensions
CALMING = 3.0  # least artificial viscosity of pairs at rest, over sqrt(g d) h/2 times the ratio of signals' speeds [-]
CALM_SPEED = 0.01  # over sqrt(g d), of an approach that has half of it [-]: neighbours in a fluid at rest are slower
SOFTENING = 0.01  # keeps |x_ij|² + 0.01 h² away from zero for particles that meet
TOLERANCE = 1.0e-3  # where a solve stops: residual over the velocity changes that viscosity asks for, root mean squares
MAX_ITERATIONS = 200  # a solve that needs more is counted as not converged; its velocities are used as they are
STAGNATION = 0.5  # of the residual of the restart before: with more left the limits of float32 are met
TINY_SQUARE = 1.0e-30  # keeps the share of a pair that is at rest, without gravity, from 0/0 [m⁴/s²]
LEAST_SQUARE = 1.0e-24  # velocity changes whose squares add up to less are nothing, and no reason to iterate [m²/s²]
CARRIED = ("viscous_change_x", "viscous_change_y", "viscous_change_z")  # of each particle, where the next solve starts


@bundle
class Viscosity(NamedTuple):
    """Viscosity that is not of one fluid alone."""

    softening: ti.f32  # 0.01 h² [m²]
    artificial: ti.f32  # alpha c_s h/2 [m²/s]
    calming: ti.f32  # what pairs at rest have more of it [m²/s]
    steady: ti.f32  # what fluid with surface tension has besides, where 2 (d + 2) nu stands [m²/s]
    calm_speed_squared: ti.f32  # square of the approach that halves this [m²/s²]
    wall_friction: ti.f32  # viscosity against boundaries over that of the fluid [-]
    with_wall_friction: ti.template()  # whether it is above 0


@func
def viscous_factor(v_dot_x: ti.f32, r_squared: ti.f32, viscosity: Viscosity, mu: ti.f32, rho0: ti.f32) -> ti.f32:
    """Factor on V/(rho_ij/rho0) grad W_ij / rho0 of the viscous acceleration.

    Physical part, Monaghan 2005, eq. 8.9 with the constant for three dimensions:
    a_i = 2 (d+2) nu sum_j (m_j / rho_ij) (v_ij . x_ij) / (|x_ij|² + 0.01 h²) grad W_ij.
    Artificial part, Monaghan 1992, eq. 4.1 with beta = 0, between particles that approach each other only:
    a_i = alpha c_s h_s sum_j (m_j / rho_ij) min(v_ij . x_ij, 0) / (|x_ij|² + 0.01 h²) grad W_ij,
    with the smoothing length h_s = h/2. Both conserve momentum pair by pair as rho_ij = (rho_i + rho_j)/2. Particles of
    equal volume V have m_j = rho0 V; so the force holds between two fluids as well. `mu` is 2 (d+2) rho0 nu [Pa s].

    The slower an approach u the more is added to alpha c_s, by u_c²/(u_c² + u²) of `calming`: what small errors of the
    pressure move in a fluid at rest has no speed in common, and no scale but the spacing.
    """
    slow = viscosity.calm_speed_squared * r_squared
    share = slow / (slow + v_dot_x * v_dot_x + TINY_SQUARE)
    artificial = rho0 * (viscosity.artificial + viscosity.calming * share)
    return ((mu + rho0 * viscosity.steady) * v_dot_x + artificial * ti.min(v_dot_x, 0.0)) / (
        r_squared + viscosity.softening
    )


@func
def pair_viscosity(mu_i: ti.f32, mu_j: ti.f32) -> ti.f32:
    """Dynamic viscosity between particles of two fluids, the harmonic mean: the shear stress is continuous then.

    Cleary & Monaghan 1999, "Conduction modelling using smoothed particle hydrodynamics", eq. 14, for viscosity.
    """
    return 2.0 * mu_i * mu_j / ti.max(mu_i + mu_j, 1.0e-30)


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
        self._reduction = LaneReduction(maxima=0, sums=3)
        self.velocity, *vectors = (ti.Vector.ndarray(3, ti.f32, capacity) for _ in range(9))
        self._iterate, self._blocks = Iterate(*vectors[:6]), Blocks(*vectors[6:])
        # The right-hand side has been read when the first direction is written.
        self._given = self._iterate.direction_product

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
        predict_velocity(particles.arrays, acceleration, dt, carried, self.velocity, iterate.change)
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

    def _start(self) -> tuple[float, ...]:
        """Find the true residual of the change so far; squares of it, of the right-hand side and of what that asks for.

        Squares are sums over the particles [m²/s²]: |r/rho0|², |b/rho0|² and |D⁻¹ b|².
        """
        bodies, iterate = self.bodies, self._iterate
        if self._with_bodies:
            bodies.restart(iterate.change)
        start_solve(self._matrix, self.velocity, bodies.changes, self._blocks, iterate, self._given)
        sums = sum_norms(self._matrix, iterate.residual, self._given, self._blocks, self._share)
        return self._with_share_of(bodies.norms, sums)

    def _advance(self, wanted: float, most: int) -> int:
        """Conjugate gradients until the residual they carry along is as small as wanted; returns the iterations."""
        bodies, iterate = self.bodies, self._iterate
        alpha = gamma_before = 0.0
        for iteration in range(most):
            if self._with_bodies:
                bodies.spread(bodies.preconditioned)
            multiply(self._matrix, iterate.preconditioned, bodies.changes, iterate.product)
            if self._with_bodies:
                bodies.multiply(iterate.preconditioned)
            gamma, delta, left = self._with_share_of(bodies.products, sum_products(self._matrix, iterate, self._share))
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

    def _with_share_of(self, bodies: Callable[[], tuple[float, ...]], sums: Sequence[float]) -> tuple[float, ...]:
        """The sums over all particles, and the bodies' share in them."""
        first, second, third = self._reduction.unpack(sums).tolist()
        shares = bodies() if self._with_bodies else (0.0, 0.0, 0.0)
        return first + shares[0], second + shares[1], third + shares[2]


@bundle
class ViscousMatrix(NamedTuple):
    """Matrix of implicit viscosity: what its entries are computed from wherever they are needed."""

    fluid: Fluid
    factor: ti.f32  # dt 2 (d + 2) sigma/h
    softening: ti.f32  # 0.01 h² [m²]
    wall_friction: ti.f32  # viscosity against boundaries over that of the fluid [-]


@bundle
class Blocks(NamedTuple):
    """Inverse 3 x 3 blocks of the matrix's diagonal, (capacity,) each."""

    diagonal: Vectors
    mixed: Vectors  # xy, xz and yz


@bundle
class Iterate(NamedTuple):
    """Vectors of conjugate gradients, (capacity,) each."""

    change: Vectors  # x, of the velocities [m/s]
    residual: Vectors  # r
    preconditioned: Vectors  # u = D^-1 r
    product: Vectors  # A u
    direction: Vectors  # p
    direction_product: Vectors  # A p


@bundle
class Carried(NamedTuple):
    """Change of the velocities in the step before [m/s], (capacity,) each."""

    x: Floats
    y: Floats
    z: Floats


@func
def friction_coefficient(matrix: ViscousMatrix, r_squared: ti.f32, mean_density: ti.f32, mu: ti.f32) -> ti.f32:
    """mu |w'|/(rho |x| (|x|² + 0.01 h²)): k without its constant factors."""
    r = ti.sqrt(r_squared)
    slope = -spline_slope(r * matrix.fluid.inverse_support)
    return mu * slope / (mean_density * (r + TINY_DISTANCE) * (r_squared + matrix.softening))


@func
def fluid_coefficient(matrix: ViscousMatrix, i: ti.i32, j: ti.i32, x_ij: ti.math.vec3, mu: ti.f32) -> ti.f32:
    """k_ij without its constant factors, of particle i of viscosity mu."""
    particles, materials = ti.static((matrix.fluid.particles, matrix.fluid.materials))
    mean_density = 0.5 * (particles.density[i] + particles.density[j])
    mu_ij = pair_viscosity(mu, materials.dynamic_viscosity[particles.phase[j]])
    return friction_coefficient(matrix, x_ij.norm_sqr(), mean_density, mu_ij)


@func
def solve_block(diagonal: ti.math.vec3, mixed: ti.math.vec3, b: ti.math.vec3) -> ti.math.vec3:
    """Product of a symmetric block, given by its diagonal and its xy, xz and yz, with a vector."""
    return ti.math.vec3(
        diagonal[0] * b[0] + mixed[0] * b[1] + mixed[1] * b[2],
        mixed[0] * b[0] + diagonal[1] * b[1] + mixed[2] * b[2],
        mixed[1] * b[0] + mixed[2] * b[1] + diagonal[2] * b[2],
    )


@kernel
def predict_velocity(
    particles: Particles, acceleration: Vectors, dt: ti.f32, carried: Carried, predicted: Vectors, change: Vectors
):
    """Velocities without viscosity, and the first guess of what it changes: as much as in the step before."""
    for i in range(particles.count):
        predicted[i] = particles.velocity[i] + dt * acceleration[i]
        change[i] = ti.math.vec3(carried.x[i], carried.y[i], carried.z[i])


@kernel
def start_solve(
    matrix: ViscousMatrix, velocity: Vectors, boundary_change: Vectors, blocks: Blocks, iterate: Iterate, given: Vectors
):
    """Blocks of the diagonal, inverted; `given`: the right-hand side; residual of the change so far."""
    fluid, near = ti.static((matrix.fluid, matrix.fluid.near))
    particles, samples, materials = ti.static((fluid.particles, fluid.samples, fluid.materials))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, v_i, dv_i = particles.position[i], velocity[i], iterate.change[i]
        own = particles.phase[i]
        rho0, mu = materials.rest_density[own], materials.dynamic_viscosity[own]
        right = ti.math.vec3(0.0)
        left = rho0 * dv_i
        diagonal = ti.math.vec3(rho0)
        mixed = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            k_ij = matrix.factor * fluid.volume * fluid_coefficient(matrix, i, j, x_ij, mu)
            right -= k_ij * (v_i - velocity[j]).dot(x_ij) * x_ij
            left += k_ij * (dv_i - iterate.change[j]).dot(x_ij) * x_ij
            diagonal += k_ij * x_ij * x_ij
            mixed += k_ij * ti.math.vec3(x_ij[0] * x_ij[1], x_ij[0] * x_ij[2], x_ij[1] * x_ij[2])
        first += near.fluid_count[i] * near.stride
        if matrix.wall_friction > 0.0:
            for k in range(near.boundary_count[i]):
                b = near.indices[first + k * near.stride]
                x_ib = to_particle(samples, b, x_i)
                k_ib = (
                    matrix.factor
                    * samples.friction_volume[b]
                    * friction_coefficient(matrix, x_ib.norm_sqr(), particles.density[i], matrix.wall_friction * mu)
                )
                right -= k_ib * (v_i - samples.velocity[b]).dot(x_ib) * x_ib
                left += k_ib * (dv_i - boundary_change[b]).dot(x_ib) * x_ib
                diagonal += k_ib * x_ib * x_ib
                mixed += k_ib * ti.math.vec3(x_ib[0] * x_ib[1], x_ib[0] * x_ib[2], x_ib[1] * x_ib[2])
        # The inverse by cofactors; its determinant is at least rho0³.
        cofactors = ti.math.vec3(
            diagonal[1] * diagonal[2] - mixed[2] * mixed[2],
            diagonal[0] * diagonal[2] - mixed[1] * mixed[1],
            diagonal[0] * diagonal[1] - mixed[0] * mixed[0],
        )
        mixed_cofactors = ti.math.vec3(
            mixed[1] * mixed[2] - mixed[0] * diagonal[2],
            mixed[0] * mixed[2] - mixed[1] * diagonal[1],
            mixed[0] * mixed[1] - mixed[2] * diagonal[0],
        )
        determinant = diagonal[0] * cofactors[0] + mixed[0] * mixed_cofactors[0] + mixed[1] * mixed_cofactors[1]
        blocks.diagonal[i] = cofactors / determinant
        blocks.mixed[i] = mixed_cofactors / determinant
        iterate.residual[i] = right - left
        iterate.preconditioned[i] = solve_block(blocks.diagonal[i], blocks.mixed[i], right - left)
        given[i] = right


@kernel
def multiply(matrix: ViscousMatrix, vector: Vectors, boundary_vector: Vectors, product: Vectors):
    """The particles' rows of the matrix times a vector, which is 0 for boundary samples that are no unknowns."""
    fluid, near = ti.static((matrix.fluid, matrix.fluid.near))
    particles, samples, materials = ti.static((fluid.particles, fluid.samples, fluid.materials))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, dv_i, own = particles.position[i], vector[i], particles.phase[i]
        rho0, mu = materials.rest_density[own], materials.dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            fluid_sum += fluid_coefficient(matrix, i, j, x_ij, mu) * (dv_i - vector[j]).dot(x_ij) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        first += near.fluid_count[i] * near.stride
        if matrix.wall_friction > 0.0:
            for k in range(near.boundary_count[i]):
                b = near.indices[first + k * near.stride]
                x_ib = to_particle(samples, b, x_i)
                k_ib = samples.friction_volume[b] * friction_coefficient(
                    matrix, x_ib.norm_sqr(), particles.density[i], matrix.wall_friction * mu
                )
                boundary_sum += k_ib * (dv_i - boundary_vector[b]).dot(x_ib) * x_ib
        product[i] = rho0 * dv_i + matrix.factor * (fluid.volume * fluid_sum + boundary_sum)


@kernel
def sum_norms(matrix: ViscousMatrix, residual: Vectors, given: Vectors, blocks: Blocks, share: Share) -> Results:
    """|r/rho0|², |b/rho0|² and |D⁻¹ b|²; over the rest density of its own fluid all are of one size."""
    particles, materials = ti.static((matrix.fluid.particles, matrix.fluid.materials))
    for lane in range(share.tree.lanes):
        left = 0.0
        right = 0.0
        asked = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < particles.count:
                rho0 = materials.rest_density[particles.phase[i]]
                left += (residual[i] / rho0).norm_sqr()
                right += (given[i] / rho0).norm_sqr()
                asked += solve_block(blocks.diagonal[i], blocks.mixed[i], given[i]).norm_sqr()
        share.tree.partial[lane] = left
        share.tree.partial[share.tree.lanes + lane] = right
        share.tree.partial[2 * share.tree.lanes + lane] = asked
    return reduced_tree(share.tree)


@kernel
def sum_products(matrix: ViscousMatrix, iterate: Iterate, share: Share) -> Results:
    """r . u, u . A u and |r/rho0|²."""
    particles, materials = ti.static((matrix.fluid.particles, matrix.fluid.materials))
    for lane in range(share.tree.lanes):
        gamma = 0.0
        delta = 0.0
        norm = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < particles.count:
                gamma += iterate.residual[i].dot(iterate.preconditioned[i])
                delta += iterate.product[i].dot(iterate.preconditioned[i])
                norm += (iterate.residual[i] / materials.rest_density[particles.phase[i]]).norm_sqr()
        share.tree.partial[lane] = gamma
        share.tree.partial[share.tree.lanes + lane] = delta
        share.tree.partial[2 * share.tree.lanes + lane] = norm
    return reduced_tree(share.tree)


@kernel
def advance_solve(count: ti.i32, alpha: ti.f32, beta: ti.f32, blocks: Blocks, iterate: Iterate):
    """p = u + beta p, A p = A u + beta A p, x += alpha p, r -= alpha A p, u = M⁻¹ r."""
    for i in range(count):
        p_i = iterate.preconditioned[i]
        product_i = iterate.product[i]
        # In the first iteration the arrays hold something else, which might not be finite.
        if beta != 0.0:
            p_i += beta * iterate.direction[i]
            product_i += beta * iterate.direction_product[i]
        iterate.direction[i] = p_i
        iterate.direction_product[i] = product_i
        iterate.change[i] += alpha * p_i
        r_i = iterate.residual[i] - alpha * product_i
        iterate.residual[i] = r_i
        iterate.preconditioned[i] = solve_block(blocks.diagonal[i], blocks.mixed[i], r_i)


@kernel
def finish_solve(
    matrix: ViscousMatrix, iterate: Iterate, dt: ti.f32, carried: Carried, acceleration: Vectors, velocity: Vectors
):
    """The change as the pair sum of the velocities found; kept for the next step, and as an acceleration.

    `velocity` becomes the velocities found, those of which the sum is.
    """
    for i in range(matrix.fluid.particles.count):
        rho0 = matrix.fluid.materials.rest_density[matrix.fluid.particles.phase[i]]
        dv_i = iterate.change[i] + iterate.residual[i] / rho0
        carried.x[i], carried.y[i], carried.z[i] = dv_i[0], dv_i[1], dv_i[2]
        acceleration[i] += dv_i / dt
        velocity[i] += iterate.change[i]
