"""Kernels of implicit pressure; `sim.fluid.pressure` has the operators."""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import Results, Share, is_finite, reduced_tree
from sim.fluid.body_response import SolveError, error_left
from sim.fluid.device import Fluid
from sim.fluid.kernels import distance, inverse_distance, spline, spline_slope


@bundle
class PressureSystem(NamedTuple):
    """Linear system of a pressure solve, (capacity,) each."""

    compression: Floats  # s_i that a step without pressure leads to [-]
    inverse_diagonal: Floats  # 1/A_ii [kg/m], alpha_i of Bender & Koschier 2015 in the unit of this P
    relaxed_before: Floats  # P of the iteration before without its momentum [Pa]
    remaining: Floats  # compression that is left [-]
    relaxation: ti.f32  # omega


@func
def slope_over_distance(r_squared: ti.f32, inverse_support: ti.f32) -> ti.f32:
    """Factor on (sigma/h) x_ij of grad W_ij; times x_ij it is 0 where two particles coincide."""
    inverse = inverse_distance(r_squared)
    return spline_slope(r_squared * inverse * inverse_support) * inverse


@func
def density_rate(fluid: Fluid, i: ti.i32, velocity: Vectors, boundary_velocity: Vectors) -> ti.f32:
    """(D v)_i; `boundary_velocity` counts where there are moving samples only."""
    x_i, v_i = fluid.particles.position[i], velocity[i]
    fluid_sum = 0.0
    first = fluid.near.start[i]
    for k in range(fluid.near.fluid_count[i]):
        j = fluid.near.indices[first + k * fluid.near.stride]
        x_ij = x_i - fluid.particles.position[j]
        fluid_sum += (v_i - velocity[j]).dot(x_ij) * slope_over_distance(x_ij.norm_sqr(), fluid.inverse_support)
    boundary_sum = 0.0
    first += fluid.near.fluid_count[i] * fluid.near.stride
    for k in range(fluid.near.boundary_count[i]):
        b = fluid.near.indices[first + k * fluid.near.stride]
        x_ib = x_i - fluid.samples.position[b]
        v_ib = v_i
        if ti.static(fluid.samples.with_moving):
            v_ib -= boundary_velocity[b]
        boundary_sum += (
            fluid.samples.volume[b] * v_ib.dot(x_ib) * slope_over_distance(x_ib.norm_sqr(), fluid.inverse_support)
        )
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
    gradient_factor, volume = fluid.sigma * fluid.inverse_support, fluid.volume
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        own = 0
        if ti.static(fluid.materials.several):
            own = fluid.particles.phase[i]
        inverse_rho0 = 1.0 / fluid.materials.rest_density[own]
        weight_sum = 1.0  # w(0): the particle itself
        gradient_sum = ti.math.vec3(0.0)
        square_sum = 0.0
        first = fluid.near.start[i]
        for k in range(fluid.near.fluid_count[i]):
            j = fluid.near.indices[first + k * fluid.near.stride]
            x_ij = x_i - fluid.particles.position[j]
            r_squared = x_ij.norm_sqr()
            inverse = inverse_distance(r_squared)
            q = r_squared * inverse * fluid.inverse_support
            weight_sum += spline(q)
            slope = spline_slope(q)
            gradient_sum += slope * inverse * x_ij
            lightness = inverse_rho0
            if ti.static(fluid.materials.several):
                lightness = 1.0 / fluid.materials.rest_density[fluid.particles.phase[j]]
            square_sum += slope * slope * lightness
        boundary_sum = 0.0
        boundary_gradient = ti.math.vec3(0.0)
        first += fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            x_ib = x_i - fluid.samples.position[b]
            r_squared = x_ib.norm_sqr()
            boundary_sum += fluid.samples.volume[b] * spline(distance(r_squared) * fluid.inverse_support)
            boundary_gradient += fluid.samples.volume[b] * slope_over_distance(r_squared, fluid.inverse_support) * x_ib
        fluid.particles.density[i] = fluid.sigma * (volume * weight_sum + boundary_sum)
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
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        x_i, pressure_i = fluid.particles.position[i], pressure[i]
        own = 0
        if ti.static(fluid.materials.several):
            own = fluid.particles.phase[i]
        fluid_sum = ti.math.vec3(0.0)
        first = fluid.near.start[i]
        for k in range(fluid.near.fluid_count[i]):
            j = fluid.near.indices[first + k * fluid.near.stride]
            x_ij = x_i - fluid.particles.position[j]
            fluid_sum += (pressure_i + pressure[j]) * slope_over_distance(x_ij.norm_sqr(), fluid.inverse_support) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        if pressure_i > 0.0:
            first += fluid.near.fluid_count[i] * fluid.near.stride
            for k in range(fluid.near.boundary_count[i]):
                b = fluid.near.indices[first + k * fluid.near.stride]
                x_ib = x_i - fluid.samples.position[b]
                boundary_sum += (
                    fluid.samples.volume[b] * slope_over_distance(x_ib.norm_sqr(), fluid.inverse_support) * x_ib
                )
        acceleration[i] = (
            -fluid.sigma
            * fluid.inverse_support
            / fluid.materials.rest_density[own]
            * (fluid.volume * fluid_sum + pressure_i * boundary_sum)
        )


@kernel
def relax_pressure(
    fluid: Fluid,
    system: PressureSystem,
    acceleration: Vectors,
    boundary_response: Vectors,
    dt_squared: ti.f32,
    momentum: ti.f32,
    pressure: Floats,
    next_pressure: Floats,
):
    """The compression that the accelerations by P leave, and the pressure to try next.

    remaining = s + dt² D a, relaxed = max(P + omega/(dt² A_ii) remaining, 0), next = relaxed + momentum (relaxed -
    relaxed before), at least 0.
    """
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        rate = density_rate(fluid, i, acceleration, boundary_response)
        left = system.compression[i] + dt_squared * rate
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


@kernel
def sum_errors(error: SolveError, count: ti.i32, share: Share) -> Results:
    """Sum of the errors of all particles that can have a pressure."""
    for lane in range(share.tree.lanes):
        total = 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count and error.inverse_diagonal[i] > 0.0:
                total += error_left(error, i)
        share.tree.partial[lane] = total
    return reduced_tree(share.tree)
