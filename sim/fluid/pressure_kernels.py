"""Kernels of the implicit pressure solves: relative density, its rate of change, and the pressure that corrects it.

With D the matrix of the rates of change, D rho_i/Dt = (D v)_i relative to the rest density,

    (D v)_i = sum_j V (v_i - v_j) . grad W_ij + sum_b V_b (v_i - v_b) . grad W_ib,

the forces of pressure are F = -V D^T P with P_i = p_i/(rho_i/rho0)², and what a step of dt changes by them is
-dt² A P, A = V D M^-1 D^T: symmetric and positive semi-definite, whatever the masses M.
"""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.kernels import distance, inverse_distance, spline, spline_slope
from sim.launch import fast_launch
from sim.reductions import Results, is_finite, reduced

NOT_FINITE = 1.0e30
"""Stands for an error that is infinite or not a number, which the larger of two numbers would hide."""

NOT_SOLVED = -1.0e6
"""Relative compression of a particle that takes no part in a solve: so much room that its pressure stays 0."""


@ti.func
def slope_over_distance(r_squared: ti.f32, inverse_support: ti.f32) -> ti.f32:
    """Factor on (sigma/h) x_ij of grad W_ij; times x_ij it is 0 where two particles coincide."""
    inverse = inverse_distance(r_squared)
    return spline_slope(r_squared * inverse * inverse_support) * inverse


@ti.func
def density_rate(
    i: ti.i32, position: Vectors, velocity: Vectors,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_volume: Floats, with_moving: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32,
) -> ti.f32:  # fmt: skip
    """(D v)_i; `boundary_velocity` counts where there are moving samples only."""
    x_i, v_i = position[i], velocity[i]
    fluid_sum = 0.0
    first = start[i]
    for k in range(fluid_count[i]):
        j = neighbors[first + k * stride]
        x_ij = x_i - position[j]
        fluid_sum += (v_i - velocity[j]).dot(x_ij) * slope_over_distance(x_ij.norm_sqr(), inverse_support)
    boundary_sum = 0.0
    first += fluid_count[i] * stride
    for k in range(boundary_count[i]):
        b = neighbors[first + k * stride]
        x_ib = x_i - boundary_position[b]
        v_ib = v_i
        if ti.static(with_moving):
            v_ib -= boundary_velocity[b]
        boundary_sum += boundary_volume[b] * v_ib.dot(x_ib) * slope_over_distance(x_ib.norm_sqr(), inverse_support)
    return sigma * inverse_support * (volume * fluid_sum + boundary_sum)


@ti.func
def not_negative(pressure: ti.f32) -> ti.f32:
    """The pressure, or 0 where it is negative; one that is not a number stays, where a maximum would make it 0."""
    return ti.select(is_finite(pressure), ti.max(pressure, 0.0), pressure)


@ti.func
def error_left(remaining: ti.f32, pressure: ti.f32, inverse_diagonal: ti.f32, dt_squared: ti.f32) -> ti.f32:
    """|compression left|; where that is negative, no more of it than taking P_i away would change."""
    error = ti.abs(ti.max(remaining, -pressure * dt_squared / inverse_diagonal))
    return ti.select(is_finite(remaining) & is_finite(pressure), error, NOT_FINITE)


@fast_launch
@ti.kernel
def measure_density_and_diagonal(
    position: Vectors, phase: Integers, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, several: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, least_diagonal: ti.f32,
    density: Floats, inverse_diagonal: Floats,
):  # fmt: skip
    """Relative density, and 1/A_ii [kg/m], 0 where A_ii is below the least.

    A_ii = |sum_j V grad W_ij + sum_b V_b grad W_ib|²/rho0_i + sum_j V² |grad W_ij|²/rho0_j, which in one fluid is
    rho_i/alpha_i of Bender & Koschier 2015, eq. 9, in the unit of this P.
    """
    gradient_factor = sigma * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = position[i]
        own = 0
        if ti.static(several):
            own = phase[i]
        inverse_rho0 = 1.0 / rest_density[own]
        weight_sum = 1.0  # w(0): the particle itself
        gradient_sum = ti.math.vec3(0.0)
        square_sum = 0.0
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            r_squared = x_ij.norm_sqr()
            inverse = inverse_distance(r_squared)
            q = r_squared * inverse * inverse_support
            weight_sum += spline(q)
            slope = spline_slope(q)
            gradient_sum += slope * inverse * x_ij
            lightness = inverse_rho0
            if ti.static(several):
                lightness = 1.0 / rest_density[phase[j]]
            square_sum += slope * slope * lightness
        boundary_sum = 0.0
        boundary_gradient = ti.math.vec3(0.0)
        first += fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            x_ib = x_i - boundary_position[b]
            r_squared = x_ib.norm_sqr()
            boundary_sum += boundary_volume[b] * spline(distance(r_squared) * inverse_support)
            boundary_gradient += boundary_volume[b] * slope_over_distance(r_squared, inverse_support) * x_ib
        density[i] = sigma * (volume * weight_sum + boundary_sum)
        diagonal = (volume * gradient_sum + boundary_gradient).norm_sqr() * inverse_rho0 + volume * volume * square_sum
        diagonal *= gradient_factor * gradient_factor
        inverse_diagonal[i] = ti.select(diagonal > least_diagonal, 1.0 / ti.max(diagonal, least_diagonal), 0.0)


@fast_launch
@ti.kernel
def predict_compression(
    position: Vectors, velocity: Vectors, acceleration: Vectors, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_volume: Floats, with_moving: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, dt: ti.f32, correction: ti.f32,
    predicted: Vectors, compression: Floats,
):  # fmt: skip
    """Relative compression s_i = dt (D v*)_i + (rho_i - 1) that a step without pressure leads to; v* = v + dt a.

    Where rho_i > 1 already, only the share `correction` of that counts. `predicted` becomes v*: to gather the velocity
    and the acceleration of every neighbour would take a third longer.
    """
    for i in range(count):
        predicted[i] = velocity[i] + dt * acceleration[i]
    ti.loop_config(block_dim=128)
    for i in range(count):
        rate = density_rate(
            i, position, predicted, start, fluid_count, boundary_count, neighbors, stride,
            boundary_position, boundary_velocity, boundary_volume, with_moving, volume, sigma, inverse_support,
        )  # fmt: skip
        excess = density[i] - 1.0
        compression[i] = dt * rate + ti.min(excess, 0.0) + correction * ti.max(excess, 0.0)


@fast_launch
@ti.kernel
def measure_divergence(
    position: Vectors, velocity: Vectors, density: Floats, inverse_diagonal: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_velocity: Vectors, boundary_volume: Floats, with_moving: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, dt: ti.f32, least_density: ti.f32, relaxation: ti.f32,
    compression: Floats, pressure: Floats, relaxed_before: Floats,
):  # fmt: skip
    """Relative compression s_i = dt (D v)_i, and the first relaxation of it from P = 0.

    Below the least density a particle is `NOT_SOLVED`.
    """
    ti.loop_config(block_dim=128)
    for i in range(count):
        rate = density_rate(
            i, position, velocity, start, fluid_count, boundary_count, neighbors, stride,
            boundary_position, boundary_velocity, boundary_volume, with_moving, volume, sigma, inverse_support,
        )  # fmt: skip
        s_i = dt * rate
        if density[i] < least_density:
            s_i = NOT_SOLVED
        p_i = not_negative(relaxation / (dt * dt) * inverse_diagonal[i] * s_i)
        compression[i] = s_i
        pressure[i] = p_i
        relaxed_before[i] = p_i


@fast_launch
@ti.kernel
def accelerate_by_pressure(
    position: Vectors, phase: Integers, pressure: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, rest_density: Floats, several: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, acceleration: Vectors,
):  # fmt: skip
    """a_i = -1/rho0_i [sum_j V (P_i + P_j) grad W_ij + sum_b V_b P_i grad W_ib]; boundary samples have no own P."""
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, pressure_i = position[i], pressure[i]
        own = 0
        if ti.static(several):
            own = phase[i]
        fluid_sum = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            fluid_sum += (pressure_i + pressure[j]) * slope_over_distance(x_ij.norm_sqr(), inverse_support) * x_ij
        boundary_sum = ti.math.vec3(0.0)
        if pressure_i > 0.0:
            first += fluid_count[i] * stride
            for k in range(boundary_count[i]):
                b = neighbors[first + k * stride]
                x_ib = x_i - boundary_position[b]
                boundary_sum += boundary_volume[b] * slope_over_distance(x_ib.norm_sqr(), inverse_support) * x_ib
        acceleration[i] = (
            -sigma * inverse_support / rest_density[own] * (volume * fluid_sum + pressure_i * boundary_sum)
        )


@fast_launch
@ti.kernel
def relax_pressure(
    position: Vectors, acceleration: Vectors, compression: Floats, inverse_diagonal: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_response: Vectors, boundary_volume: Floats, with_moving: ti.template(),
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, dt_squared: ti.f32, relaxation: ti.f32, momentum: ti.f32,
    pressure: Floats, relaxed_before: Floats, next_pressure: Floats, remaining: Floats,
):  # fmt: skip
    """The compression that the accelerations leave, and the pressure to try next.

    remaining = s + dt² D a, relaxed = max(P + omega/(dt² A_ii) remaining, 0), next = relaxed + momentum (relaxed -
    relaxed before), at least 0.

    Args:
        acceleration: by the pressure.
        boundary_response: acceleration of the moving samples by it.
        relaxed_before: from the iteration before; exchanged for the new one.
    """
    ti.loop_config(block_dim=128)
    for i in range(count):
        rate = density_rate(
            i, position, acceleration, start, fluid_count, boundary_count, neighbors, stride,
            boundary_position, boundary_response, boundary_volume, with_moving, volume, sigma, inverse_support,
        )  # fmt: skip
        left = compression[i] + dt_squared * rate
        relaxed = not_negative(pressure[i] + relaxation / dt_squared * inverse_diagonal[i] * left)
        next_pressure[i] = not_negative(relaxed + momentum * (relaxed - relaxed_before[i]))
        relaxed_before[i] = relaxed
        remaining[i] = left


@fast_launch
@ti.kernel
def copy_scalars(source: Floats, count: ti.i32, target: Floats):
    """target_i = source_i."""
    for i in range(count):
        target[i] = source[i]


@fast_launch
@ti.kernel
def add_scaled(vector: Vectors, other: Vectors, factor: ti.f32, count: ti.i32):
    """vector_i += factor other_i."""
    for i in range(count):
        vector[i] += factor * other[i]


@fast_launch
@ti.kernel
def sum_errors(
    remaining: Floats, pressure: Floats, inverse_diagonal: Floats, dt_squared: ti.f32, count: ti.i32,
    items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats,
) -> Results:  # fmt: skip
    """Sum of the errors of all particles that can have a pressure."""
    for lane in range(lanes):
        total = 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count and inverse_diagonal[i] > 0.0:
                total += error_left(remaining[i], pressure[i], inverse_diagonal[i], dt_squared)
        partial[lane] = total
    return reduced(partial, lanes, quantities, maxima, nodes)
