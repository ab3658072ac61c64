"""Kernels of the forces between a fluid and the samples of sheets, and of the fluid that moves along with these."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.kernels import TINY_DISTANCE, distance, spline, spline_slope
from sim.launch import fast_launch


@fast_launch
@ti.kernel
def weigh_contacts(
    position: Vectors, phase: Integers, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    sample_position: Vectors, sample_volume: Floats, first_sample: ti.i32, rest_density: Floats,
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, full_field: ti.f32, touched_at: Vectors, contact: Floats,
):  # fmt: skip
    """Mass of each particle that touches sheets, m_i min(1, s_i/s_full), over s_i = sum_b V_b W_ib [kg], and where."""
    for i in range(count):
        x_i = position[i]
        field = 0.0
        first = start[i] + fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            if b >= first_sample:
                r = distance((x_i - sample_position[b]).norm_sqr())
                field += sample_volume[b] * spline(r * inverse_support)
        field *= sigma
        mass = volume * rest_density[phase[i]]
        touched_at[i] = x_i
        contact[i] = ti.select(field > 0.0, mass / ti.max(field, full_field), 0.0)


@fast_launch
@ti.kernel
def gather_contact_mass(
    sample_position: Vectors, sample_volume: Floats, first: ti.i32, skipped: ti.i32, count: ti.i32,
    near_start: Integers, near_count: Integers, near: Integers, position: Vectors, contact: Floats,
    sigma: ti.f32, inverse_support: ti.f32, mass: Floats,
):  # fmt: skip
    """m_b = sum_i contact_i V_b W_ib: each sample's share of the fluid that touches sheets."""
    for s in range(count):
        b = first + s
        total = 0.0
        for k in range(near_start[skipped + s], near_start[skipped + s] + near_count[skipped + s]):
            i = near[k]
            total += contact[i] * spline(distance((position[i] - sample_position[b]).norm_sqr()) * inverse_support)
        mass[s] = sigma * sample_volume[b] * total


@fast_launch
@ti.kernel
def take_larger(values: Floats, other: Floats, count: ti.i32, larger: Floats):
    """larger_s = max(values_s, other_s)."""
    for s in range(count):
        larger[s] = ti.max(values[s], other[s])


@fast_launch
@ti.kernel
def clear_vectors(vectors: Vectors, count: ti.i32):
    """vector_s = 0."""
    for s in range(count):
        vectors[s] = ti.math.vec3(0.0)


@fast_launch
@ti.kernel
def count_impulses(force: Vectors, skipped: ti.i32, count: ti.i32, dt: ti.f32, expected: Vectors, impulse: Vectors):
    """Add forces of a step to the impulses, and to what is expected of the next step."""
    for s in range(count):
        impulse[s] += dt * force[skipped + s]
        expected[s] += force[skipped + s]


@fast_launch
@ti.kernel
def push_sheet_samples(
    force: Vectors, skipped: ti.i32, count: ti.i32, factor: ti.f32, mass: Floats, first: ti.i32, velocity: Vectors,
    push: Vectors,
):  # fmt: skip
    """v_b += factor f_b/m_b, and the sum of these pushes since the samples were placed."""
    for s in range(count):
        change = factor / mass[s] * force[skipped + s]
        velocity[first + s] += change
        push[s] += change


@fast_launch
@ti.kernel
def accelerate_sheet_samples(
    force: Vectors, skipped: ti.i32, count: ti.i32, mass: Floats, first: ti.i32, acceleration: Vectors
):  # fmt: skip
    """a_b = f_b/m_b."""
    for s in range(count):
        acceleration[first + s] = force[skipped + s] / mass[s]


@fast_launch
@ti.kernel
def sum_sheet_gradients(
    sample_position: Vectors, sample_volume: Floats, first: ti.i32, skipped: ti.i32, count: ti.i32,
    near_start: Integers, near_count: Integers, near: Integers, position: Vectors,
    gradient_factor: ti.f32, inverse_support: ti.f32, mass: Floats, answer: Floats,
):  # fmt: skip
    """V_b sum_i |V_b grad W_ib| / m_b: what a sample has in the bound of `add_sheets_to_diagonal`."""
    for s in range(count):
        x_b = sample_position[first + s]
        total = 0.0
        for k in range(near_start[skipped + s], near_start[skipped + s] + near_count[skipped + s]):
            total -= spline_slope(distance((position[near[k]] - x_b).norm_sqr()) * inverse_support)
        v_b = sample_volume[first + s]
        answer[s] = gradient_factor * v_b * v_b * total / mass[s]


@fast_launch
@ti.kernel
def add_sheets_to_diagonal(
    position: Vectors, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    sample_position: Vectors, first_sample: ti.i32, answer: Floats, gradient_factor: ti.f32, inverse_support: ti.f32,
    weight: ti.f32, inverse_diagonal: Floats,
):  # fmt: skip
    """1/A_ii becomes 1/(A_ii + weight sum_b |n_ib| sum_j |n_jb| / m_b), n_ib = V_b grad W_ib."""
    for i in range(count):
        x_i = position[i]
        bound = 0.0
        first = start[i] + fluid_count[i] * stride
        for k in range(boundary_count[i]):
            b = neighbors[first + k * stride]
            if b >= first_sample:
                r = distance((x_i - sample_position[b]).norm_sqr())
                bound -= answer[b - first_sample] * spline_slope(r * inverse_support)
        inverse = inverse_diagonal[i]
        inverse_diagonal[i] = inverse / (1.0 + weight * gradient_factor * bound * inverse)


@fast_launch
@ti.kernel
def add_missing_weight(
    sample_position: Vectors, first: ti.i32, skipped: ti.i32, count: ti.i32,
    near_start: Integers, near_count: Integers, near: Integers, position: Vectors, phase: Integers,
    rest_density: Floats, missing_volume: Floats, factor: ti.f32, one_side: ti.f32, one_sided_tilt: ti.f32,
    inverse_support: ti.f32, gravity_dt: ti.math.vec3, impulse: Vectors,
):  # fmt: skip
    """J_b += dt g rho0 V of the fluid that would be where samples keep it away, if they had no more volume than cloth.

    Nothing where it is on one side only, where the mean of the unit vectors to the particles, weighted by W, is
    `one_sided_tilt` long; all of it from half of that on, which disorder alone may give on both sides; and less where
    the sum of V W is less than that on one side at rest, `one_side`.
    """
    for s in range(count):
        x_b = sample_position[first + s]
        total = 0.0
        weighted = 0.0
        tilt = ti.math.vec3(0.0)
        for k in range(near_start[skipped + s], near_start[skipped + s] + near_count[skipped + s]):
            i = near[k]
            x_ib = position[i] - x_b
            r = distance(x_ib.norm_sqr())
            weight = spline(r * inverse_support)
            total += weight
            tilt += weight / (r + TINY_DISTANCE) * x_ib
            weighted += weight * rest_density[phase[i]]
        if total > 0.0:
            tilted = tilt.norm() / (one_sided_tilt * total)
            part = ti.min(factor * total / one_side, 1.0) * ti.min(ti.max(2.0 - 2.0 * tilted, 0.0), 1.0)
            impulse[s] += part * missing_volume[s] * weighted / total * gravity_dt


@fast_launch
@ti.kernel
def take_sheet_motion(
    position: Vectors, velocity: Vectors, phase: Integers, touched_at: Vectors, contact: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    sample_position: Vectors, sample_volume: Floats, first_sample: ti.i32, change: Vectors, rest_density: Floats,
    volume: ti.f32, sigma: ti.f32, inverse_support: ti.f32, dt: ti.f32, wall_low: ti.math.vec3, wall_high: ti.math.vec3,
):  # fmt: skip
    """v_i += sum_b phi_ib dv_b with m_i phi_ib = contact_i V_b W_ib, as if it had been so during the step.

    Who would pass a wall is put back onto it, as at the end of the fluid's own step.
    """
    for i in range(count):
        if contact[i] > 0.0:
            x_i = touched_at[i]
            total = ti.math.vec3(0.0)
            first = start[i] + fluid_count[i] * stride
            for k in range(boundary_count[i]):
                b = neighbors[first + k * stride]
                if b >= first_sample:
                    r = distance((x_i - sample_position[b]).norm_sqr())
                    total += sample_volume[b] * spline(r * inverse_support) * change[b - first_sample]
            dv = sigma * contact[i] / (volume * rest_density[phase[i]]) * total
            v_i = velocity[i] + dv
            free = position[i] + dt * dv
            x_end = ti.min(ti.max(free, wall_low), wall_high)
            for axis in ti.static(range(3)):
                if x_end[axis] != free[axis]:
                    v_i[axis] = 0.0
            velocity[i] = v_i
            position[i] = x_end
