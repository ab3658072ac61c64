"""Stiff viscosity: the viscous change of all velocities at once, from a linear system (Weiler et al. 2018)."""

import math

import taichi as ti

from sim.cells import Floats, Integers, Vectors
from sim.fluid.kernels import TINY_DISTANCE, spline_slope
from sim.fluid.time_step import CFL_NUMBER, VISCOUS_NUMBER
from sim.fluid.viscosity import LAPLACIAN_FACTOR, SOFTENING, pair_viscosity
from sim.reductions import LaneReduction

TOLERANCE = 1.0e-3
"""Where the iteration stops: the residual as a velocity, over the velocity changes that viscosity asks for, both as
root mean squares. Both are 0 for a fluid that moves as a rigid body, however fast."""

MAX_ITERATIONS = 200
"""A solve that needs more is counted as not converged; its velocities are used as they are."""

CARRIED = ("viscous_change_x", "viscous_change_y", "viscous_change_z")
"""Velocity change of each particle in the step before [m/s], from which the next solve starts."""

SUMS = 4


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

        rho0_i dv_i + dt sum_j k_ij x_ij x_ij^T (dv_i - dv_j) + dt sum_b k_ib x_ib x_ib^T dv_i
            = -dt sum_j k_ij (v_ij . x_ij) x_ij - dt sum_b k_ib (v_ib . x_ib) x_ib,
        k_ij = 2 (d+2) mu_ij V 2/(rho_i + rho_j) |grad W_ij| / (|x_ij| (|x_ij|² + 0.01 h²)) = k_ji

    The matrix is symmetric and positive definite for every time step: conjugate gradients with the 3 x 3 blocks of its
    diagonal as preconditioner (Weiler et al. 2018, section 3.2), in the form with one reduction an iteration
    (Chronopoulos & Gear 1989). In the end the residual over rho0 is added to the change, which is the pair sum with
    the velocities found: linear and angular momentum are conserved to rounding, wherever the iteration stopped.

    Attributes:
        iterations: of all solves of this frame.
        solves: in this frame.
        not_converged: solves of this frame that hit `MAX_ITERATIONS`.
    """

    def __init__(self, capacity: int) -> None:
        self.iterations = self.solves = self.not_converged = 0
        self._reduction = LaneReduction(maxima=0, sums=SUMS)
        vectors = [ti.Vector.ndarray(3, ti.f32, max(capacity, 1)) for _ in range(7)]
        self.velocity, self._change, self._residual, self._preconditioned, self._product = vectors[:5]
        self._direction, self._direction_product = vectors[5:]
        # Two vectors hold the six numbers of a symmetric block: its diagonal, then xy, xz and yz.
        self._inverse_diagonal = ti.Vector.ndarray(3, ti.f32, max(capacity, 1))
        self._inverse_mixed = ti.Vector.ndarray(3, ti.f32, max(capacity, 1))

    def begin_frame(self) -> None:
        """Restart the counters of the frame."""
        self.iterations = self.solves = self.not_converged = 0

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
        gradient_factor: float,
        volume: float,
        support_radius: float,
        wall_friction: float,
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
            boundary: position [m], velocity [m/s] and volume [m³] of the boundary samples.
            materials: rest density [kg/m³] and dynamic viscosity [Pa s] of each fluid.
            gradient_factor: sigma/h of the kernel [1/m⁴].
            volume: of a particle [m³].
            support_radius: h [m].
            wall_friction: viscosity against boundaries over that of the fluid [-].
            carried: the particles' scalars with the names of `CARRIED`.
            acceleration: by all other forces [m/s²]; that by viscosity is added.
            dt: the step [s].
        """
        changes = tuple(carried[name] for name in CARRIED)
        if count == 0:
            return
        rest_density, _ = materials
        operator = (
            position, phase, density, count, *neighbor_list, boundary[0], boundary[2], *materials,
            dt * LAPLACIAN_FACTOR * gradient_factor, volume, 1.0 / support_radius,
            SOFTENING * support_radius**2, wall_friction,
        )  # fmt: skip
        predict_velocity(velocity, acceleration, count, dt, *changes, self.velocity, self._change)
        start_solve(
            *operator, boundary[1], self.velocity, self._change, self._inverse_diagonal, self._inverse_mixed,
            self._residual, self._preconditioned, self._direction,
        )  # fmt: skip
        self._iterate(operator, phase, rest_density, count)
        finish_solve(
            phase, rest_density, self._residual, self._change, count, dt, *changes, acceleration, self.velocity
        )
        self.solves += 1

    def _iterate(self, operator: tuple[object, ...], phase: ti.Ndarray, rest_density: ti.Ndarray, count: int) -> None:
        lanes = self._reduction.lanes
        alpha = gamma_before = 0.0
        wanted = math.inf
        for iteration in range(MAX_ITERATIONS + 1):
            multiply(*operator, self._preconditioned, self._product)
            sum_products(
                phase, rest_density, self._residual, self._preconditioned, self._product, self._direction, count,
                lanes.count, lanes.items(count), lanes.lane_step(count), lanes.item_step(), self._reduction.partial,
            )  # fmt: skip
            gamma, delta, residual, scale = (float(value) for value in self._reduction.result())
            if iteration == 0:
                wanted = TOLERANCE**2 * scale
            if residual <= wanted:
                return
            beta = gamma / gamma_before if iteration else 0.0
            curvature = delta - beta * gamma / alpha if iteration else delta
            # Of a positive matrix both are positive; rounding, or velocities that are not finite, end the iteration.
            if iteration == MAX_ITERATIONS or not (curvature > 0.0 and gamma > 0.0):
                break
            alpha, gamma_before = gamma / curvature, gamma
            advance_solve(
                count, alpha, beta, self._inverse_diagonal, self._inverse_mixed, self._product,
                self._direction, self._direction_product, self._change, self._residual, self._preconditioned,
            )  # fmt: skip
            self.iterations += 1
        self.not_converged += 1


@ti.func
def friction_coefficient(
    r_squared: ti.f32, inverse_support: ti.f32, softening: ti.f32, mean_density: ti.f32, mu: ti.f32
) -> ti.f32:  # fmt: skip
    """mu |w'|/(rho |x| (|x|² + 0.01 h²)): k without its constant factors."""
    r = ti.sqrt(r_squared)
    slope = -spline_slope(r * inverse_support)
    return mu * slope / (mean_density * (r + TINY_DISTANCE) * (r_squared + softening))


@ti.func
def solve_block(diagonal: ti.math.vec3, mixed: ti.math.vec3, b: ti.math.vec3) -> ti.math.vec3:
    """Product of a symmetric block, given by its diagonal and its xy, xz and yz, with a vector."""
    return ti.math.vec3(
        diagonal[0] * b[0] + mixed[0] * b[1] + mixed[1] * b[2],
        mixed[0] * b[0] + diagonal[1] * b[1] + mixed[2] * b[2],
        mixed[1] * b[0] + mixed[2] * b[1] + diagonal[2] * b[2],
    )


@ti.kernel
def predict_velocity(
    velocity: Vectors, acceleration: Vectors, count: ti.i32, dt: ti.f32,
    change_x: Floats, change_y: Floats, change_z: Floats, predicted: Vectors, change: Vectors,
):  # fmt: skip
    """Velocities without viscosity, and the first guess of what it changes: as much as in the step before."""
    for i in range(count):
        predicted[i] = velocity[i] + dt * acceleration[i]
        change[i] = ti.math.vec3(change_x[i], change_y[i], change_z[i])


@ti.kernel
def start_solve(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, dynamic_viscosity: Floats,
    factor: ti.f32, volume: ti.f32, inverse_support: ti.f32, softening: ti.f32, wall_friction: ti.f32,
    boundary_velocity: Vectors, velocity: Vectors, change: Vectors, inverse_diagonal: Vectors, inverse_mixed: Vectors,
    residual: Vectors, preconditioned: Vectors, asked: Vectors,
):  # fmt: skip
    """Blocks of the diagonal, inverted; residual of the first guess; `asked`: the right-hand side over the blocks."""
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, v_i, dv_i, own = position[i], velocity[i], change[i], phase[i]
        rho0, mu = rest_density[own], dynamic_viscosity[own]
        right = ti.math.vec3(0.0)
        left = rho0 * dv_i
        diagonal = ti.math.vec3(rho0)
        mixed = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            mu_ij = pair_viscosity(mu, dynamic_viscosity[phase[j]])
            mean_density = 0.5 * (density[i] + density[j])
            k_ij = factor * volume * friction_coefficient(
                x_ij.norm_sqr(), inverse_support, softening, mean_density, mu_ij
            )  # fmt: skip
            right -= k_ij * (v_i - velocity[j]).dot(x_ij) * x_ij
            left += k_ij * (dv_i - change[j]).dot(x_ij) * x_ij
            diagonal += k_ij * x_ij * x_ij
            mixed += k_ij * ti.math.vec3(x_ij[0] * x_ij[1], x_ij[0] * x_ij[2], x_ij[1] * x_ij[2])
        first += fluid_count[i] * stride
        if wall_friction > 0.0:
            for k in range(boundary_count[i]):
                b = neighbors[first + k * stride]
                x_ib = x_i - boundary_position[b]
                k_ib = factor * boundary_volume[b] * friction_coefficient(
                    x_ib.norm_sqr(), inverse_support, softening, density[i], wall_friction * mu
                )  # fmt: skip
                right -= k_ib * (v_i - boundary_velocity[b]).dot(x_ib) * x_ib
                left += k_ib * dv_i.dot(x_ib) * x_ib
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
        determinant = (
            diagonal[0] * cofactors[0] + mixed[0] * mixed_cofactors[0] + mixed[1] * mixed_cofactors[1]
        )  # fmt: skip
        inverse_diagonal[i] = cofactors / determinant
        inverse_mixed[i] = mixed_cofactors / determinant
        residual[i] = right - left
        preconditioned[i] = solve_block(inverse_diagonal[i], inverse_mixed[i], right - left)
        asked[i] = solve_block(inverse_diagonal[i], inverse_mixed[i], right)


@ti.kernel
def multiply(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, dynamic_viscosity: Floats,
    factor: ti.f32, volume: ti.f32, inverse_support: ti.f32, softening: ti.f32, wall_friction: ti.f32,
    vector: Vectors, product: Vectors,
):  # fmt: skip
    """The matrix times a vector."""
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, dv_i, own = position[i], vector[i], phase[i]
        rho0, mu = rest_density[own], dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            mu_ij = pair_viscosity(mu, dynamic_viscosity[phase[j]])
            mean_density = 0.5 * (density[i] + density[j])
            k_ij = friction_coefficient(x_ij.norm_sqr(), inverse_support, softening, mean_density, mu_ij)
            fluid_sum += k_ij * (dv_i - vector[j]).dot(x_ij) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        first += fluid_count[i] * stride
        if wall_friction > 0.0:
            for k in range(boundary_count[i]):
                b = neighbors[first + k * stride]
                x_ib = x_i - boundary_position[b]
                k_ib = boundary_volume[b] * friction_coefficient(
                    x_ib.norm_sqr(), inverse_support, softening, density[i], wall_friction * mu
                )  # fmt: skip
                boundary_sum += k_ib * dv_i.dot(x_ib) * x_ib
        product[i] = rho0 * dv_i + factor * (volume * fluid_sum + boundary_sum)


@ti.kernel
def sum_products(
    phase: Integers, rest_density: Floats, residual: Vectors, preconditioned: Vectors, product: Vectors,
    asked: Vectors, count: ti.i32,
    lanes: ti.i32, items: ti.i32, lane_step: ti.i32, item_step: ti.i32, partial: Floats,
):  # fmt: skip
    """r . u, u . A u, |r/rho0|² and |asked|²; r over the mean rest density of its own fluid keeps all of one size."""
    for lane in range(lanes):
        gamma = 0.0
        delta = 0.0
        norm = 0.0
        scale = 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count:
                gamma += residual[i].dot(preconditioned[i])
                delta += product[i].dot(preconditioned[i])
                norm += (residual[i] / rest_density[phase[i]]).norm_sqr()
                scale += asked[i].norm_sqr()
        partial[lane] = gamma
        partial[lanes + lane] = delta
        partial[2 * lanes + lane] = norm
        partial[3 * lanes + lane] = scale


@ti.kernel
def advance_solve(
    count: ti.i32, alpha: ti.f32, beta: ti.f32, inverse_diagonal: Vectors, inverse_mixed: Vectors, product: Vectors,
    direction: Vectors, direction_product: Vectors, change: Vectors, residual: Vectors, preconditioned: Vectors,
):  # fmt: skip
    """p = u + beta p, A p = A u + beta A p, x += alpha p, r -= alpha A p, u = M⁻¹ r."""
    for i in range(count):
        p_i = preconditioned[i]
        product_i = product[i]
        # In the first iteration the arrays hold something else, which might not be finite.
        if beta != 0.0:
            p_i += beta * direction[i]
            product_i += beta * direction_product[i]
        direction[i] = p_i
        direction_product[i] = product_i
        change[i] += alpha * p_i
        r_i = residual[i] - alpha * product_i
        residual[i] = r_i
        preconditioned[i] = solve_block(inverse_diagonal[i], inverse_mixed[i], r_i)


@ti.kernel
def finish_solve(
    phase: Integers, rest_density: Floats, residual: Vectors, change: Vectors, count: ti.i32, dt: ti.f32,
    change_x: Floats, change_y: Floats, change_z: Floats, acceleration: Vectors, velocity: Vectors,
):  # fmt: skip
    """The change as the pair sum of the velocities found; kept for the next step, and as an acceleration."""
    for i in range(count):
        dv_i = change[i] + residual[i] / rest_density[phase[i]]
        change_x[i], change_y[i], change_z[i] = dv_i[0], dv_i[1], dv_i[2]
        acceleration[i] += dv_i / dt
        velocity[i] += dv_i
