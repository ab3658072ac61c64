"""Kernels of implicit viscosity: its matrix, and conjugate gradients with the 3 x 3 blocks of its diagonal."""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import Share
from sim.fluid.device import Fluid
from sim.fluid.kernels import TINY_DISTANCE, spline_slope
from sim.fluid.viscosity import pair_viscosity


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
    mean_density = 0.5 * (matrix.fluid.particles.density[i] + matrix.fluid.particles.density[j])
    mu_ij = pair_viscosity(mu, matrix.fluid.materials.dynamic_viscosity[matrix.fluid.particles.phase[j]])
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
    velocity: Vectors,
    acceleration: Vectors,
    count: ti.i32,
    dt: ti.f32,
    carried: Carried,
    predicted: Vectors,
    change: Vectors,
):
    """Velocities without viscosity, and the first guess of what it changes: as much as in the step before."""
    for i in range(count):
        predicted[i] = velocity[i] + dt * acceleration[i]
        change[i] = ti.math.vec3(carried.x[i], carried.y[i], carried.z[i])


@kernel
def start_solve(
    matrix: ViscousMatrix, velocity: Vectors, boundary_change: Vectors, blocks: Blocks, iterate: Iterate, given: Vectors
):
    """Blocks of the diagonal, inverted; `given`: the right-hand side; residual of the change so far."""
    ti.loop_config(block_dim=128)
    for i in range(matrix.fluid.particles.count):
        x_i, v_i, dv_i = matrix.fluid.particles.position[i], velocity[i], iterate.change[i]
        own = matrix.fluid.particles.phase[i]
        rho0, mu = matrix.fluid.materials.rest_density[own], matrix.fluid.materials.dynamic_viscosity[own]
        right = ti.math.vec3(0.0)
        left = rho0 * dv_i
        diagonal = ti.math.vec3(rho0)
        mixed = ti.math.vec3(0.0)
        first = matrix.fluid.near.start[i]
        for k in range(matrix.fluid.near.fluid_count[i]):
            j = matrix.fluid.near.indices[first + k * matrix.fluid.near.stride]
            x_ij = x_i - matrix.fluid.particles.position[j]
            k_ij = matrix.factor * matrix.fluid.volume * fluid_coefficient(matrix, i, j, x_ij, mu)
            right -= k_ij * (v_i - velocity[j]).dot(x_ij) * x_ij
            left += k_ij * (dv_i - iterate.change[j]).dot(x_ij) * x_ij
            diagonal += k_ij * x_ij * x_ij
            mixed += k_ij * ti.math.vec3(x_ij[0] * x_ij[1], x_ij[0] * x_ij[2], x_ij[1] * x_ij[2])
        first += matrix.fluid.near.fluid_count[i] * matrix.fluid.near.stride
        if matrix.wall_friction > 0.0:
            for k in range(matrix.fluid.near.boundary_count[i]):
                b = matrix.fluid.near.indices[first + k * matrix.fluid.near.stride]
                x_ib = x_i - matrix.fluid.samples.position[b]
                k_ib = (
                    matrix.factor
                    * matrix.fluid.samples.friction_volume[b]
                    * friction_coefficient(
                        matrix, x_ib.norm_sqr(), matrix.fluid.particles.density[i], matrix.wall_friction * mu
                    )
                )
                right -= k_ib * (v_i - matrix.fluid.samples.velocity[b]).dot(x_ib) * x_ib
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
    ti.loop_config(block_dim=128)
    for i in range(matrix.fluid.particles.count):
        x_i, dv_i, own = matrix.fluid.particles.position[i], vector[i], matrix.fluid.particles.phase[i]
        rho0, mu = matrix.fluid.materials.rest_density[own], matrix.fluid.materials.dynamic_viscosity[own]
        fluid_sum = ti.math.vec3(0.0)
        first = matrix.fluid.near.start[i]
        for k in range(matrix.fluid.near.fluid_count[i]):
            j = matrix.fluid.near.indices[first + k * matrix.fluid.near.stride]
            x_ij = x_i - matrix.fluid.particles.position[j]
            fluid_sum += fluid_coefficient(matrix, i, j, x_ij, mu) * (dv_i - vector[j]).dot(x_ij) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        first += matrix.fluid.near.fluid_count[i] * matrix.fluid.near.stride
        if matrix.wall_friction > 0.0:
            for k in range(matrix.fluid.near.boundary_count[i]):
                b = matrix.fluid.near.indices[first + k * matrix.fluid.near.stride]
                x_ib = x_i - matrix.fluid.samples.position[b]
                k_ib = matrix.fluid.samples.friction_volume[b] * friction_coefficient(
                    matrix, x_ib.norm_sqr(), matrix.fluid.particles.density[i], matrix.wall_friction * mu
                )
                boundary_sum += k_ib * (dv_i - boundary_vector[b]).dot(x_ib) * x_ib
        product[i] = rho0 * dv_i + matrix.factor * (matrix.fluid.volume * fluid_sum + boundary_sum)


@kernel
def sum_norms(matrix: ViscousMatrix, residual: Vectors, given: Vectors, blocks: Blocks, share: Share):
    """|r/rho0|², |b/rho0|² and |D⁻¹ b|²; over the rest density of its own fluid all are of one size."""
    for lane in range(share.tree.lanes):
        left = 0.0
        right = 0.0
        asked = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < matrix.fluid.particles.count:
                rho0 = matrix.fluid.materials.rest_density[matrix.fluid.particles.phase[i]]
                left += (residual[i] / rho0).norm_sqr()
                right += (given[i] / rho0).norm_sqr()
                asked += solve_block(blocks.diagonal[i], blocks.mixed[i], given[i]).norm_sqr()
        share.tree.partial[lane] = left
        share.tree.partial[share.tree.lanes + lane] = right
        share.tree.partial[2 * share.tree.lanes + lane] = asked


@kernel
def sum_products(matrix: ViscousMatrix, iterate: Iterate, share: Share):
    """r . u, u . A u and |r/rho0|²."""
    for lane in range(share.tree.lanes):
        gamma = 0.0
        delta = 0.0
        norm = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < matrix.fluid.particles.count:
                gamma += iterate.residual[i].dot(iterate.preconditioned[i])
                delta += iterate.product[i].dot(iterate.preconditioned[i])
                norm += (
                    iterate.residual[i] / matrix.fluid.materials.rest_density[matrix.fluid.particles.phase[i]]
                ).norm_sqr()
        share.tree.partial[lane] = gamma
        share.tree.partial[share.tree.lanes + lane] = delta
        share.tree.partial[2 * share.tree.lanes + lane] = norm


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
