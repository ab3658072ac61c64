"""Kernels of the forces between a fluid and the samples of sheets, and of the fluid that moves along with these."""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Vectors
from sim.core.bundles import bundle
from sim.core.launch import kernel
from sim.fluid.boundary import NearParticles, Samples, Sheets
from sim.fluid.device import Fluid
from sim.fluid.kernels import TINY_DISTANCE, distance, spline, spline_slope


@bundle
class Contacts(NamedTuple):
    """Particles as they touched sheets at the start of the step, (capacity,) each."""

    position: Vectors  # where they were [m]
    mass: Floats  # m_i min(1, s_i/s_full) over s_i = sum_b V_b W_ib [kg]; 0 for those that touch none
    count: ti.i32  # particles there were


@bundle
class OneSide(NamedTuple):
    """Fluid at rest on one side of a sheet, as a sample sees it."""

    field: ti.f32  # V sum_i W_ib [-]
    tilt: ti.f32  # length of the mean unit vector to the particles, weighted by W [-]


@kernel
def weigh_contacts(fluid: Fluid, sheets: Sheets, full_field: ti.f32, contacts: Contacts):
    """Mass of each particle that touches sheets, m_i min(1, s_i/s_full), over s_i = sum_b V_b W_ib [kg], and where."""
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        field = 0.0
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            if b >= sheets.first:
                r = distance((x_i - fluid.samples.position[b]).norm_sqr())
                field += fluid.samples.volume[b] * spline(r * fluid.inverse_support)
        field *= fluid.sigma
        mass = fluid.volume * fluid.materials.rest_density[fluid.particles.phase[i]]
        contacts.position[i] = x_i
        contacts.mass[i] = ti.select(field > 0.0, mass / ti.max(field, full_field), 0.0)


@kernel
def gather_contact_mass(fluid: Fluid, near: NearParticles, sheets: Sheets, contact: Floats, mass: Floats):
    """m_b = sum_i contact_i V_b W_ib: each sample's share of the fluid that touches sheets."""
    for s in range(sheets.count):
        b = sheets.first + s
        m = sheets.skipped + s
        total = 0.0
        for k in range(near.start[m], near.start[m] + near.count[m]):
            i = near.particles[k]
            r = distance((fluid.particles.position[i] - fluid.samples.position[b]).norm_sqr())
            total += contact[i] * spline(r * fluid.inverse_support)
        mass[s] = fluid.sigma * fluid.samples.volume[b] * total


@kernel
def take_larger(values: Floats, other: Floats, count: ti.i32, larger: Floats):
    """larger_s = max(values_s, other_s)."""
    for s in range(count):
        larger[s] = ti.max(values[s], other[s])


@kernel
def clear_vectors(vectors: Vectors, count: ti.i32):
    """vector_s = 0."""
    for s in range(count):
        vectors[s] = ti.math.vec3(0.0)


@kernel
def count_impulses(force: Vectors, sheets: Sheets, dt: ti.f32, expected: Vectors, impulse: Vectors):
    """Forces of a step, added to the impulses and to what is expected of the next step."""
    for s in range(sheets.count):
        impulse[s] += dt * force[sheets.skipped + s]
        expected[s] += force[sheets.skipped + s]


@kernel
def push_sheet_samples(force: Vectors, sheets: Sheets, factor: ti.f32, mass: Floats, samples: Samples, push: Vectors):
    """v_b += factor f_b/m_b, and the sum of these pushes since the samples were placed."""
    for s in range(sheets.count):
        change = factor / mass[s] * force[sheets.skipped + s]
        samples.velocity[sheets.first + s] += change
        push[s] += change


@kernel
def accelerate_sheet_samples(force: Vectors, sheets: Sheets, mass: Floats, acceleration: Vectors):
    """a_b = f_b/m_b."""
    for s in range(sheets.count):
        acceleration[sheets.first + s] = force[sheets.skipped + s] / mass[s]


@kernel
def sum_sheet_gradients(
    fluid: Fluid, near: NearParticles, sheets: Sheets, gradient_factor: ti.f32, mass: Floats, answer: Floats
):
    """V_b sum_i |V_b grad W_ib| / m_b: what a sample has in the bound of `add_sheets_to_diagonal`."""
    for s in range(sheets.count):
        x_b = fluid.samples.position[sheets.first + s]
        m = sheets.skipped + s
        total = 0.0
        for k in range(near.start[m], near.start[m] + near.count[m]):
            r = distance((fluid.particles.position[near.particles[k]] - x_b).norm_sqr())
            total -= spline_slope(r * fluid.inverse_support)
        v_b = fluid.samples.volume[sheets.first + s]
        answer[s] = gradient_factor * v_b * v_b * total / mass[s]


@kernel
def add_sheets_to_diagonal(
    fluid: Fluid, sheets: Sheets, answer: Floats, gradient_factor: ti.f32, weight: ti.f32, inverse_diagonal: Floats
):
    """1/A_ii becomes 1/(A_ii + weight sum_b |n_ib| sum_j |n_jb| / m_b), n_ib = V_b grad W_ib."""
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        bound = 0.0
        first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
        for k in range(fluid.near.boundary_count[i]):
            b = fluid.near.indices[first + k * fluid.near.stride]
            if b >= sheets.first:
                r = distance((x_i - fluid.samples.position[b]).norm_sqr())
                bound -= answer[b - sheets.first] * spline_slope(r * fluid.inverse_support)
        inverse = inverse_diagonal[i]
        inverse_diagonal[i] = inverse / (1.0 + weight * gradient_factor * bound * inverse)


@kernel
def add_missing_weight(
    fluid: Fluid,
    near: NearParticles,
    sheets: Sheets,
    missing_volume: Floats,
    factor: ti.f32,
    one_side: OneSide,
    gravity_dt: ti.math.vec3,
    impulse: Vectors,
):
    """J_b += dt g rho0 V of the fluid that would be where samples keep it away, if they had no more volume than cloth.

    Nothing where it is on one side only, where the mean of the unit vectors to the particles, weighted by W, is
    `one_side.tilt` long; all of it from half of that on, which disorder alone may give on both sides; and less where
    the sum of V W is less than that on one side at rest.
    """
    for s in range(sheets.count):
        x_b = fluid.samples.position[sheets.first + s]
        m = sheets.skipped + s
        total = 0.0
        weighted = 0.0
        tilt = ti.math.vec3(0.0)
        for k in range(near.start[m], near.start[m] + near.count[m]):
            i = near.particles[k]
            x_ib = fluid.particles.position[i] - x_b
            r = distance(x_ib.norm_sqr())
            weight = spline(r * fluid.inverse_support)
            total += weight
            tilt += weight / (r + TINY_DISTANCE) * x_ib
            weighted += weight * fluid.materials.rest_density[fluid.particles.phase[i]]
        if total > 0.0:
            tilted = tilt.norm() / (one_side.tilt * total)
            part = ti.min(factor * total / one_side.field, 1.0) * ti.min(ti.max(2.0 - 2.0 * tilted, 0.0), 1.0)
            impulse[s] += part * missing_volume[s] * weighted / total * gravity_dt


@kernel
def take_sheet_motion(
    fluid: Fluid,
    contacts: Contacts,
    sheets: Sheets,
    change: Vectors,
    dt: ti.f32,
    wall_low: ti.math.vec3,
    wall_high: ti.math.vec3,
):
    """v_i += sum_b phi_ib dv_b with m_i phi_ib = contact_i V_b W_ib, as if it had been so during the step.

    Who would pass a wall is put back onto it, as at the end of the fluid's own step.
    """
    for i in range(contacts.count):
        if contacts.mass[i] > 0.0:
            x_i = contacts.position[i]
            total = ti.math.vec3(0.0)
            first = fluid.near.start[i] + fluid.near.fluid_count[i] * fluid.near.stride
            for k in range(fluid.near.boundary_count[i]):
                b = fluid.near.indices[first + k * fluid.near.stride]
                if b >= sheets.first:
                    r = distance((x_i - fluid.samples.position[b]).norm_sqr())
                    total += fluid.samples.volume[b] * spline(r * fluid.inverse_support) * change[b - sheets.first]
            mass = fluid.volume * fluid.materials.rest_density[fluid.particles.phase[i]]
            dv = fluid.sigma * contacts.mass[i] / mass * total
            v_i = fluid.particles.velocity[i] + dv
            free = fluid.particles.position[i] + dt * dv
            x_end = ti.min(ti.max(free, wall_low), wall_high)
            for axis in ti.static(range(3)):
                if x_end[axis] != free[axis]:
                    v_i[axis] = 0.0
            fluid.particles.velocity[i] = v_i
            fluid.particles.position[i] = x_end
