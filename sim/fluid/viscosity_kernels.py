"""Kernels of implicit viscosity: its matrix, and conjugate gradients with the 3 x 3 blocks of its diagonal."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.kernels import TINY_DISTANCE, spline_slope
from sim.fluid.viscosity import pair_viscosity
from sim.launch import fast_launch


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


@fast_launch
@ti.kernel
def predict_velocity(
    velocity: Vectors, acceleration: Vectors, count: ti.i32, dt: ti.f32,
    change_x: Floats, change_y: Floats, change_z: Floats, predicted: Vectors, change: Vectors,
):  # fmt: skip
    """Velocities without viscosity, and the first guess of what it changes: as much as in the step before."""
    for i in range(count):
        predicted[i] = velocity[i] + dt * acceleration[i]
        change[i] = ti.math.vec3(change_x[i], change_y[i], change_z[i])


@fast_launch
@ti.kernel
def start_solve(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, dynamic_viscosity: Floats,
    factor: ti.f32, volume: ti.f32, inverse_support: ti.f32, softening: ti.f32, wall_friction: ti.f32,
    boundary_velocity: Vectors, velocity: Vectors, change: Vectors, boundary_change: Vectors,
    inverse_diagonal: Vectors, inverse_mixed: Vectors, residual: Vectors, preconditioned: Vectors, given: Vectors,
):  # fmt: skip
    """Blocks of the diagonal, inverted; `given`: the right-hand side; residual of the change so far."""
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
        determinant = (
            diagonal[0] * cofactors[0] + mixed[0] * mixed_cofactors[0] + mixed[1] * mixed_cofactors[1]
        )  # fmt: skip
        inverse_diagonal[i] = cofactors / determinant
        inverse_mixed[i] = mixed_cofactors / determinant
        residual[i] = right - left
        preconditioned[i] = solve_block(inverse_diagonal[i], inverse_mixed[i], right - left)
        given[i] = right


@fast_launch
@ti.kernel
def multiply(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, dynamic_viscosity: Floats,
    factor: ti.f32, volume: ti.f32, inverse_support: ti.f32, softening: ti.f32, wall_friction: ti.f32,
    vector: Vectors, boundary_vector: Vectors, product: Vectors,
):  # fmt: skip
    """The particles' rows of the matrix times a vector, which is 0 for boundary samples that are no unknowns."""
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
                boundary_sum += k_ib * (dv_i - boundary_vector[b]).dot(x_ib) * x_ib
        product[i] = rho0 * dv_i + factor * (volume * fluid_sum + boundary_sum)


@fast_launch
@ti.kernel
def sum_norms(
    phase: Integers, rest_density: Floats, residual: Vectors, given: Vectors, inverse_diagonal: Vectors,
    inverse_mixed: Vectors, count: ti.i32,
    lanes: ti.i32, items: ti.i32, lane_step: ti.i32, item_step: ti.i32, partial: Floats,
):  # fmt: skip
    """|r/rho0|², |b/rho0|² and |D⁻¹ b|²; over the rest density of its own fluid all are of one size."""
    for lane in range(lanes):
        left = 0.0
        right = 0.0
        asked = 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count:
                rho0 = rest_density[phase[i]]
                left += (residual[i] / rho0).norm_sqr()
                right += (given[i] / rho0).norm_sqr()
                asked += solve_block(inverse_diagonal[i], inverse_mixed[i], given[i]).norm_sqr()
        partial[lane] = left
        partial[lanes + lane] = right
        partial[2 * lanes + lane] = asked


@fast_launch
@ti.kernel
def sum_products(
    phase: Integers, rest_density: Floats, residual: Vectors, preconditioned: Vectors, product: Vectors, count: ti.i32,
    lanes: ti.i32, items: ti.i32, lane_step: ti.i32, item_step: ti.i32, partial: Floats,
):  # fmt: skip
    """r . u, u . A u and |r/rho0|²."""
    for lane in range(lanes):
        gamma = 0.0
        delta = 0.0
        norm = 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count:
                gamma += residual[i].dot(preconditioned[i])
                delta += product[i].dot(preconditioned[i])
                norm += (residual[i] / rest_density[phase[i]]).norm_sqr()
        partial[lane] = gamma
        partial[lanes + lane] = delta
        partial[2 * lanes + lane] = norm


@fast_launch
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


@fast_launch
@ti.kernel
def finish_solve(
    phase: Integers, rest_density: Floats, residual: Vectors, change: Vectors, count: ti.i32, dt: ti.f32,
    change_x: Floats, change_y: Floats, change_z: Floats, acceleration: Vectors, velocity: Vectors,
):  # fmt: skip
    """The change as the pair sum of the velocities found; kept for the next step, and as an acceleration.

    `velocity` becomes the velocities found, those of which the sum is.
    """
    for i in range(count):
        dv_i = change[i] + residual[i] / rest_density[phase[i]]
        change_x[i], change_y[i], change_z[i] = dv_i[0], dv_i[1], dv_i[2]
        acceleration[i] += dv_i / dt
        velocity[i] += change[i]
