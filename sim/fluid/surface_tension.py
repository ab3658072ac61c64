"""Surface tension: cohesion (Becker & Teschner 2007), or a continuum surface force by curvature and contact angle."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import BRANCHES, LaneReduction, Share, Tree, reduced_tree
from sim.fluid.boundary import Bodies, NearParticles, to_particle
from sim.fluid.kernels import (
    Discretization,
    evaluate,
    inverse_distance,
    lattice_offsets,
    spline,
    spline_slope,
)
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Fluid
from sim.fluid.traits import COHESION_NUMBER

LAPLACE_STRESS = 0.2  # pressure in a drop of 10 spacings to the radius over sigma/d, which a flow has to expect
TENSION_VISCOSITY = 0.07
"""Viscosity of fluid with tension besides its own, over sqrt(sigma d/rho0). The force of a curvature is no derivative
of an energy and drives what is a few spacings small; this damps it, and takes 0.12 sqrt(d/R) of a drop's frequency."""

GAIN = 0.976
"""Factor on the smoothed gradients at a support of two spacings. In a lattice with a flat surface smoothing takes 15 %
of their sum, which it leaves outside; in a drop at rest there is 20 % more, as pressure packs its outer layer."""

CONTACT_LINE = 0.73
"""Length of a contact line over the sum of gradients along a wall: with it a drop at rest pulls as it pushes, to 7 %
from 60 to 90 degrees; at 120 it pulls 16 % too little."""

BLEND_AT_WALL = 0.4  # share of the next layer's normal in that of the layer on a wall; the contact angle gives the rest
STEEPENING = 1.1  # of an angle below 90 degrees, from there: smoothing draws normals on a wall towards those above
LITTLE_BEYOND = 0.1  # weight of the next layer over that of its own, below which it has less share [-]
SEEN_WALL = 0.02  # h |grad c| of a wall from which on a particle lies on it [-]
LEAST_TANGENT = 0.2  # share of a gradient along a wall from which on it tells where the fluid ends [-]
LEAST_GRADIENT = 0.15  # h |grad c|, smoothed, of particles that have a curvature [-]; 0.9 at a surface, 0.04 within
NO_PULL, FULL_PULL = 0.05, 0.15  # the same, below which tension does not act, and from which on it acts in full [-]
DEPTH_OF_LAYER = 0.5  # of the outer layer's particles under the surface [spacings]
MOST_CURVATURE = 1.0  # that particles can tell [1/spacing]
LEAST_AREA = 0.3  # of the surface over that of its outer layer, where it is a trough as narrow as particles [-]
FADING = 0.05  # weight of no curvature in a mean: where no surface is near there is none [-]
LEAST_SPREAD = 0.02  # of neighbours along the surface, so that two of them do not tell a curvature [spacings²]


@dataclass(frozen=True, eq=False)
class Cohesion:
    """Surface tension of the fluids of a tank: its model, its strength, and what it asks of speeds and steps."""

    is_becker_teschner2007: bool  # whether there is that of Becker & Teschner 2007
    is_csf: bool  # whether there is a continuum surface force
    stress: float  # of the pressure that it makes, over the density [m²/s²]
    rate: float  # square of the frequency of its stiffest swing of particles [1/s²]
    viscosity: float  # that it needs besides the fluids' own [m²/s]

    @classmethod
    def of(cls, fluids: tuple[FluidParameters, ...], discretization: Discretization) -> "Cohesion":
        """The surface tension of these fluids, which share a model."""
        spacing, support_in_spacings = discretization.spacing, discretization.support_in_spacings
        strongest = max(fluid.surface_tension for fluid in fluids)
        is_csf = fluids[0].surface_tension_model == "csf" and strongest > 0.0
        if is_csf:
            tension = max(fluid.surface_tension / fluid.rest_density for fluid in fluids)
            stress, viscosity = LAPLACE_STRESS * tension / spacing, TENSION_VISCOSITY * math.sqrt(tension * spacing)
            rate = (COHESION_NUMBER / min(fluid.tension_step for fluid in fluids)) ** 2
        else:
            stress, viscosity = cohesion_stress(support_in_spacings) * strongest / spacing, 0.0
            rate = cohesion_rate(support_in_spacings) * strongest / spacing**3
        return cls(not is_csf and strongest > 0.0, is_csf, stress, rate, viscosity)


@func
def cohesion_becker_teschner2007(distance: ti.f32, inverse_support: ti.f32, spacing: ti.f32) -> ti.f32:
    """Factor on -kappa sigma (x_i - x_j) of the cohesion; w at the distance, at least one spacing.

    Becker & Teschner 2007, eq. 16, for particles of equal mass: a_i = -kappa sum_j (x_i - x_j) W(max(|x_ij|, d)).
    The lower limit d keeps particles from clumping. Momentum is conserved pair by pair.
    """
    return spline(ti.max(distance, spacing) * inverse_support)


def cohesion_stress(support_in_spacings: float) -> float:
    """Stress with which this cohesion pulls a filled lattice together, over rho kappa/d: sum_j |x_ij|² W_ij d/6 [-]."""
    distances = _neighbor_distances(support_in_spacings)
    return float((distances**2 * evaluate(distances, support_in_spacings)).sum()) / 6.0


def cohesion_rate(support_in_spacings: float) -> float:
    """Square of a particle's frequency on the springs that its neighbours are, over kappa/d³: sum_j W_ij d³ [-]."""
    return float(evaluate(_neighbor_distances(support_in_spacings), support_in_spacings).sum())


def _neighbor_distances(support_in_spacings: float) -> np.ndarray:
    """Of the neighbours in a filled lattice [spacings]; none is nearer than the lower limit."""
    distances = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1)
    return distances[distances > 0.0]


@bundle
class Interface(NamedTuple):
    """The surface as particles see it, (capacity,) each."""

    normal: Vectors  # outward unit normal [-]
    gradient: Floats  # h |grad c|, smoothed, of the fluid's colour c, which is 1 in it and on walls [-]


@bundle
class Contact(NamedTuple):
    """Where a surface meets walls: the contact angle of each fluid, (k,), and what lies there, (capacity,)."""

    cosine: Floats
    sine: Floats
    on_wall: Floats  # 1 for particles of the layer on a wall, else 0
    pull: Vectors  # of the surface on the wall over sum_b V_b W_ib [N]


class SurfaceTensionCSF:
    """Continuum surface force of each fluid against the air, by the curvature of its surface.

        a_i = 2 C/rho0 sigma k_i <grad c>_i,   grad c = sum_j V grad W_ij + 1/2 sum_b V_b grad W_ib

    after Brackbill, Kothe & Zemach 1992, in particles Morris 2000 and Müller et al. 2003. Here the gradient is smoothed
    once by the kernel, <g>_i = sum_j V g_j W_ij. So it is a field like that of gravity, which pressure balances without
    moving single particles, and vanishes within the fluid, where plain gradients are noise that a pressure would press
    apart. C is `GAIN`.

    k is the trace of the surface's shape operator, the least-squares slope of the unit normals along the surface over
    the neighbours, weighted by W |<g>|². Normals are those of the layers under the surface: with the principal
    curvatures k1, k2 at a depth t those of the surface are k/(1 + t k). k_i is its mean over the neighbours, twice.

    In the layer on a wall the direction of g is n_w cos(theta) + t sin(theta), with the wall's normal n_w and t along
    g's part along the wall (Brackbill et al.). That is right at the wall; half a spacing above it the next
    layer's normal counts as well. A body that moves gets sigma along the surface for each length of the contact line.

    Fluids have a surface each: two that touch have both tensions between them. The sum of k n over a closed surface
    is 0. As long as no fluid is on a wall, what the sum over particles has is taken from them by their share of the
    surface, so that momentum is conserved. Else it stays.
    """

    def __init__(self, capacity: int, fluids: tuple[FluidParameters, ...], discretization: Discretization) -> None:
        """Prepare for particles of these fluids."""
        self._discretization = discretization
        given = np.array([fluid.contact_angle_deg for fluid in fluids])
        angles = np.radians(np.where(given < 90.0, 90.0 + STEEPENING * (given - 90.0), given))
        self._gradient = ti.Vector.ndarray(3, ti.f32, capacity)
        self._curvature, self._mean_curvature = (ti.ndarray(ti.f32, capacity) for _ in range(2))
        self._interface = Interface(ti.Vector.ndarray(3, ti.f32, capacity), ti.ndarray(ti.f32, capacity))
        self._contact = Contact(
            on_device(np.cos(angles)),
            on_device(np.sin(angles)),
            ti.ndarray(ti.f32, capacity),
            ti.Vector.ndarray(3, ti.f32, capacity),
        )
        self._reduction = LaneReduction(maxima=0, sums=5)

    def add_acceleration(self, fluid: Fluid, acceleration: ti.Ndarray) -> None:
        """Add the accelerations by surface tension to all others [m/s²]."""
        spacing, interface, curvature = self._discretization.spacing, self._interface, self._curvature
        compute_gradients(fluid, self._contact, spacing, self._gradient)
        smooth_gradients(fluid, self._gradient, self._contact, interface)
        compute_curvatures(fluid, interface, spacing, curvature)
        average_at_surface(fluid, interface, curvature, self._mean_curvature)
        share, force = self._reduction.over(fluid.particles.count), self._gradient  # which has been read
        compute_surface_force(fluid, interface, self._contact, self._mean_curvature, force, share)
        add_surface_force(fluid, interface, force, share.tree, acceleration)

    def fill_forces(self, fluid: Fluid, near: NearParticles, bodies: Bodies, force: ti.Ndarray) -> None:
        """Pull of the surface on each sample of a moving body [N], along the contact line."""
        gather_contact_pull(fluid, self._contact.pull, near, bodies, force)


@func
def is_alike(fluid: Fluid, own: ti.i32, j: ti.i32) -> ti.i32:
    """Whether a particle is of a fluid; not looked up where there is one."""
    alike = 1
    if ti.static(fluid.materials.several):
        alike = ti.cast(fluid.particles.phase[j] == own, ti.i32)
    return alike


@kernel
def compute_gradients(fluid: Fluid, contact: Contact, spacing: ti.f32, gradient: Vectors):
    """-h grad c of each particle, turned to the contact angle on walls, and the pull of the surface on these.

    The push of a wall's samples is twice that of the fluid that they stand for (`wall_calibration`), hence its half.
    """
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, own = particles.position[i], particles.phase[i]
        total = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            if is_alike(fluid, own, j) != 0:
                x_ij = x_i - particles.position[j]
                r_squared = x_ij.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                total -= spline_slope(r_squared * inverse_r * fluid.inverse_support) * inverse_r * x_ij
        wall = ti.math.vec3(0.0)
        wall_field = 0.0
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            x_ib = to_particle(samples, b, x_i)
            r_squared = x_ib.norm_sqr()
            inverse_r = inverse_distance(r_squared)
            q = r_squared * inverse_r * fluid.inverse_support
            wall -= samples.volume[b] * spline_slope(q) * inverse_r * x_ib
            wall_field += samples.volume[b] * spline(q)
        g = fluid.sigma * (fluid.volume * total + 0.5 * wall)
        wall *= fluid.sigma
        thickness = wall.norm()
        contact.on_wall[i] = ti.select(thickness > SEEN_WALL, 1.0, 0.0)
        contact.pull[i] = ti.math.vec3(0.0)
        if thickness > SEEN_WALL:
            up = wall / thickness
            along = g - g.dot(up) * up
            size, tangent = g.norm(), along.norm()
            outward = along / ti.max(ti.max(tangent, LEAST_TANGENT * size), 1.0e-9)
            cosine, sine = contact.cosine[own], contact.sine[own]
            line = 2.0 * CONTACT_LINE * fluid.volume * fluid.inverse_support * tangent / spacing
            pull = fluid.materials.surface_tension[own] * line * (sine * up - cosine * outward)
            contact.pull[i] = pull / (fluid.sigma * wall_field)
            g = size * (cosine * up + sine * outward).normalized(1.0e-9)
        gradient[i] = g


@kernel
def smooth_gradients(fluid: Fluid, gradient: Vectors, contact: Contact, interface: Interface):
    """Length and direction of the gradients smoothed by the kernel; a wall goes on as the particle on it has it."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, own = particles.position[i], particles.phase[i]
        total = gradient[i]  # w(0): the particle itself
        beyond = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            if is_alike(fluid, own, j) != 0:
                r_squared = (x_i - particles.position[j]).norm_sqr()
                weight = spline(r_squared * inverse_distance(r_squared) * fluid.inverse_support)
                if contact.on_wall[i] > contact.on_wall[j]:
                    beyond += weight * gradient[j]
                else:
                    total += weight * gradient[j]
        wall_field = 0.0
        first += near.fluid_count[i] * near.stride
        for k in range(near.boundary_count[i]):
            b = near.indices[first + k * near.stride]
            r_squared = to_particle(samples, b, x_i).norm_sqr()
            wall_field += samples.volume[b] * spline(r_squared * inverse_distance(r_squared) * fluid.inverse_support)
        total += wall_field / fluid.volume * gradient[i]
        size, size_beyond = total.norm(), beyond.norm()
        if size > 0.0 and size_beyond > 0.0:
            blend = BLEND_AT_WALL * ti.min(size_beyond / (LITTLE_BEYOND * size), 1.0)
            mixed = (1.0 - blend) / size * total + blend / size_beyond * beyond
            total = (size + size_beyond) * mixed.normalized(1.0e-9)
        size = total.norm()
        interface.gradient[i] = fluid.volume * fluid.sigma * size
        interface.normal[i] = total / ti.max(size, 1.0e-12)


@kernel
def compute_curvatures(fluid: Fluid, interface: Interface, spacing: ti.f32, curvature: Floats):
    """Curvature of the surface above each particle near it [1/m], else 0; the way stands at the class."""
    particles, near = ti.static((fluid.particles, fluid.near))
    depth, most = DEPTH_OF_LAYER * spacing, MOST_CURVATURE / spacing
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        k_i = 0.0
        if interface.gradient[i] > LEAST_GRADIENT:
            x_i, n_i, own = particles.position[i], interface.normal[i], particles.phase[i]
            axis = ti.math.vec3(1.0, 0.0, 0.0)
            if ti.abs(n_i[0]) > 0.6:
                axis = ti.math.vec3(0.0, 1.0, 0.0)
            u = n_i.cross(axis).normalized()
            v = n_i.cross(u)
            uu, uv, vv = LEAST_SPREAD * spacing * spacing, 0.0, LEAST_SPREAD * spacing * spacing
            slope_u = ti.math.vec2(0.0)
            slope_v = ti.math.vec2(0.0)
            first = near.start[i]
            for k in range(near.fluid_count[i]):
                j = near.indices[first + k * near.stride]
                if is_alike(fluid, own, j) != 0:
                    x_ji = particles.position[j] - x_i
                    r_squared = x_ji.norm_sqr()
                    weight = spline(r_squared * inverse_distance(r_squared) * fluid.inverse_support)
                    weight *= interface.gradient[j] * interface.gradient[j]
                    change = interface.normal[j] - n_i
                    along = ti.math.vec2(x_ji.dot(u), x_ji.dot(v))
                    slope_u += weight * change.dot(u) * along
                    slope_v += weight * change.dot(v) * along
                    uu += weight * along[0] * along[0]
                    uv += weight * along[0] * along[1]
                    vv += weight * along[1] * along[1]
            inverse = 1.0 / (uu * vv - uv * uv)
            shape_uu = (slope_u[0] * vv - slope_u[1] * uv) * inverse
            shape_uv = (slope_u[1] * uu - slope_u[0] * uv) * inverse
            shape_vu = (slope_v[0] * vv - slope_v[1] * uv) * inverse
            shape_vv = (slope_v[1] * uu - slope_v[0] * uv) * inverse
            trace = ti.min(ti.max(shape_uu + shape_vv, -most), most)
            gauss = shape_uu * shape_vv - shape_uv * shape_vu
            gauss = ti.min(ti.max(gauss, -0.25 * most * most), 0.25 * trace * trace)
            # k1/(1 + t k1) + k2/(1 + t k2)
            k_i = (trace + 2.0 * depth * gauss) / ti.max(1.0 + depth * trace + depth * depth * gauss, LEAST_AREA)
            k_i = ti.min(ti.max(k_i, -most), most)
        curvature[i] = k_i


@func
def mean_curvature(fluid: Fluid, interface: Interface, curvature: Floats, i: ti.i32) -> ti.f32:
    """Mean of the curvatures near a particle, weighted by W and the gradients; less than that far from the surface."""
    particles, near = ti.static((fluid.particles, fluid.near))
    x_i, own = particles.position[i], particles.phase[i]
    norm = 0.0
    if interface.gradient[i] > LEAST_GRADIENT:
        norm = interface.gradient[i]
    total = norm * curvature[i]
    first = near.start[i]
    for k in range(near.fluid_count[i]):
        j = near.indices[first + k * near.stride]
        if is_alike(fluid, own, j) != 0 and interface.gradient[j] > LEAST_GRADIENT:
            r_squared = (x_i - particles.position[j]).norm_sqr()
            weight = spline(r_squared * inverse_distance(r_squared) * fluid.inverse_support) * interface.gradient[j]
            total += weight * curvature[j]
            norm += weight
    return total / (norm + FADING)


@kernel
def average_at_surface(fluid: Fluid, interface: Interface, curvature: Floats, mean: Floats):
    """Means of the curvatures of the particles at the surface [1/m], else 0."""
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        k_i = 0.0
        if interface.gradient[i] > LEAST_GRADIENT:
            k_i = mean_curvature(fluid, interface, curvature, i)
        mean[i] = k_i


@func
def pulled_share(gradient: ti.f32) -> ti.f32:
    """h |grad c| of a particle, less where it is no more than noise [-]."""
    return gradient * ti.min(ti.max(gradient - NO_PULL, 0.0) / (FULL_PULL - NO_PULL), 1.0)


@kernel
def compute_surface_force(
    fluid: Fluid, interface: Interface, contact: Contact, curvature: Floats, force: Vectors, share: Share
):
    """a_i = -2 C sigma k_i |<grad c>| n_i/rho0; in the tree its sum [N], and those of surface mass and of walls."""
    particles, materials = ti.static((fluid.particles, fluid.materials))
    lanes = share.tree.lanes
    for lane in range(lanes):
        total = ti.math.vec3(0.0)
        mass = 0.0
        on_wall = 0.0
        for item in range(share.items):
            i = lane * share.lane_step + item * share.item_step
            if i < particles.count:
                own = particles.phase[i]
                a_i = ti.math.vec3(0.0)
                pulled = pulled_share(interface.gradient[i])
                if pulled > 0.0:
                    k_i = mean_curvature(fluid, interface, curvature, i)
                    strength = 2.0 * GAIN * materials.surface_tension[own] / materials.rest_density[own]
                    a_i = -strength * k_i * pulled * fluid.inverse_support * interface.normal[i]
                m_i = fluid.volume * materials.rest_density[own]
                total += m_i * a_i
                mass += m_i * pulled
                on_wall += contact.on_wall[i]
                force[i] = a_i
        for axis in ti.static(range(3)):
            share.tree.partial[axis * lanes + lane] = total[axis]
        share.tree.partial[3 * lanes + lane] = mass
        share.tree.partial[4 * lanes + lane] = on_wall
    reduced_tree(share.tree)


@kernel
def add_surface_force(fluid: Fluid, interface: Interface, force: Vectors, tree: Tree, acceleration: Vectors):
    """a_i += the force by curvature, without its sum, by share of the surface, where no fluid is on a wall."""
    stride = tree.lanes // BRANCHES
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        change = force[i]
        mass = tree.nodes[3 * stride]
        if tree.nodes[4 * stride] == 0.0 and mass > 0.0:
            net = ti.math.vec3(tree.nodes[0], tree.nodes[stride], tree.nodes[2 * stride])
            change -= pulled_share(interface.gradient[i]) / mass * net
        acceleration[i] += change


@kernel
def gather_contact_pull(fluid: Fluid, pull: Vectors, near: NearParticles, bodies: Bodies, force: Vectors):
    """Force of the surface on each sample of a moving body [N]; 0 on those of sheets."""
    particles, samples = ti.static((fluid.particles, fluid.samples))
    for b in range(near.sample_count):
        total = ti.math.vec3(0.0)
        if b < bodies.sample_count:
            x_b = samples.position[near.first + b]
            for k in range(near.start[b], near.start[b] + near.count[b]):
                i = near.particles[k]
                r_squared = (particles.position[i] - x_b).norm_sqr()
                total += spline(r_squared * inverse_distance(r_squared) * fluid.inverse_support) * pull[i]
        force[b] = fluid.sigma * samples.volume[near.first + b] * total
