"""Surface tension: cohesion (Becker & Teschner 2007), or that with area forces and adhesion (Akinci et al. 2013)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.fluid.boundary import Bodies, NearParticles
from sim.fluid.kernels import (
    Discretization,
    evaluate,
    inverse_distance,
    lattice_offsets,
    particle_volume,
    spline,
    spline_slope,
)
from sim.fluid.parameters import FluidParameters
from sim.fluid.particles import Fluid
from sim.fluid.traits import COHESION_PER_TENSION

RATE_PER_COHESION = 1.0  # squared frequency on cohesion's springs over c/h: six neighbours, each of 0.135/h at most
AREA_SHARE = 1.0e-3
"""Coefficient of the area forces over that of cohesion, both as accelerations. The paper has one gamma for both: its
cohesion is gamma rho0 V C, its area force gamma (n_i - n_j), and rho0 is 1000 in its units."""


@dataclass(frozen=True, eq=False)
class Cohesion:
    """Surface tension of the fluids of a tank: its model, its strength, and what it asks of speeds and steps."""

    is_becker_teschner2007: bool  # whether there is that of Becker & Teschner 2007
    is_akinci2013: bool  # whether there is that of Akinci et al. 2013
    akinci2013: NDArray[np.float64]  # its cohesion c of each fluid [m/s²], (k,)
    stress: float  # with which it pulls a filled lattice together, over the density [m²/s²]
    rate: float  # square of the frequency of a particle on the spring that its neighbours' cohesion is [1/s²]

    @classmethod
    def of(cls, fluids: tuple[FluidParameters, ...], discretization: Discretization) -> "Cohesion":
        """The surface tension of these fluids, which share a model."""
        support, support_in_spacings = discretization.support_radius, discretization.support_in_spacings
        kappa = max(fluid.surface_tension for fluid in fluids)
        is_akinci2013 = fluids[0].surface_tension_model == "akinci2013" and kappa > 0.0
        c = np.array([COHESION_PER_TENSION * f.surface_tension / (f.rest_density * support**2) for f in fluids])
        if is_akinci2013:
            stress = cohesion_stress_akinci2013(support_in_spacings) * float(c.max()) * support
            rate = RATE_PER_COHESION * float(c.max()) / support
        else:
            stress = cohesion_stress(support_in_spacings) * kappa / discretization.spacing
            rate = cohesion_rate(support_in_spacings) * kappa / discretization.spacing**3
        return cls(not is_akinci2013 and kappa > 0.0, is_akinci2013, c, stress, rate)


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
class Attraction(NamedTuple):
    """Attraction between particles, and to boundaries, of each fluid, (k,)."""

    cohesion: Floats  # c [m/s²]
    adhesion: Floats  # beta [-]
    samples: ti.i32  # boundary samples that attract: all but those of sheets
    with_adhesion: ti.template()  # whether any fluid has adhesion


class SurfaceTensionAkinci2013:
    """Cohesion and area forces between the particles of a fluid, and its adhesion to boundaries.

    a_i = -c sum_j K_ij [V C(|x_ij|) x_ij/|x_ij| + a (n_i - n_j)] - beta c sum_b V_b A(|x_ib|) x_ib/|x_ib|
    n_i = h sum_j V/rho_j grad W_ij (eq. 4), K_ij = 2/(rho_i + rho_j) (eq. 5), with relative densities

    C (eq. 2) pulls beyond 0.37 h and pushes nearer than that; A (eq. 7) pulls between h/2 and h. Our support h is
    theirs. Fluids attract their own kind alone. Momentum is conserved pair by pair, that of bodies included; angular
    momentum is not, as n_i - n_j is not along x_ij. Sheets do not attract.

    Attributes:
        adheres: whether walls and bodies attract any fluid.
    """

    def __init__(
        self,
        capacity: int,
        fluids: tuple[FluidParameters, ...],
        cohesion: np.ndarray,
        discretization: Discretization,
        samples: int,
    ) -> None:
        """Prepare for particles of these fluids, whose cohesion is c [m/s²], (k,), and samples that may attract."""
        self._normal = ti.Vector.ndarray(3, ti.f32, capacity)
        self._discretization = discretization
        adhesion = np.array([fluid.adhesion for fluid in fluids])
        self.adheres = bool((adhesion > 0.0).any())
        self._attraction = Attraction(on_device(cohesion), on_device(adhesion), samples, self.adheres)

    def add_acceleration(self, fluid: Fluid, acceleration: ti.Ndarray) -> None:
        """Add the accelerations by surface tension to all others [m/s²]."""
        d = self._discretization
        compute_normals(fluid, d.sigma * d.particle_volume, self._normal)
        add_surface_tension(fluid, self._attraction, d.support_radius, self._normal, acceleration)

    def fill_forces(self, fluid: Fluid, near: NearParticles, bodies: Bodies, force: ti.Ndarray) -> None:
        """The opposite of the adhesion to each sample of a moving body [N]."""
        gather_adhesion(fluid, self._attraction, self._discretization.support_radius, near, bodies, force)


@func
def cohesion_akinci2013(q: ti.f32) -> ti.f32:
    """C(q h) h³, eq. 2: 32/pi (1-q)³ q³, below q = 1/2 twice that less 1/64."""
    outer = ti.max(1.0 - q, 0.0)
    bump = outer * outer * outer * q * q * q
    return 32.0 / ti.math.pi * ti.select(q > 0.5, bump, 2.0 * bump - 1.0 / 64.0)


def cohesion_stress_akinci2013(support_in_spacings: float) -> float:
    """Stress of cohesion in a filled lattice over rho0 c h: sum_j V C(|x_ij|) |x_ij| / (6 h) [-]."""
    q = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1) / support_in_spacings
    bump = (1.0 - q) ** 3 * q**3
    cohesion = 32.0 / np.pi * np.where(q > 0.5, bump, 2.0 * bump - 1.0 / 64.0) / support_in_spacings**3
    return particle_volume(1.0, support_in_spacings) * float((cohesion * q).sum()) / 6.0


@func
def adhesion_akinci2013(q: ti.f32) -> ti.f32:
    """A(q h) h³, eq. 7: 0.007 (-4 q² + 6 q - 2)^(1/4) for 1/2 < q < 1."""
    return 0.007 * ti.sqrt(ti.sqrt(ti.max(-4.0 * q * q + 6.0 * q - 2.0, 0.0)))


@kernel
def compute_normals(fluid: Fluid, sigma_volume: ti.f32, normal: Vectors):
    """n_i = h sum_j V/rho_j grad W_ij over the particle's own fluid: 0 within, into the fluid at its surface."""
    particles, near = ti.static((fluid.particles, fluid.near))
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i = particles.position[i]
        total = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            if particles.phase[j] == particles.phase[i]:
                x_ij = x_i - particles.position[j]
                r_squared = x_ij.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                slope = spline_slope(r_squared * inverse_r * fluid.inverse_support)
                total += slope * inverse_r / particles.density[j] * x_ij
        normal[i] = sigma_volume * total


@kernel
def add_surface_tension(
    fluid: Fluid, attraction: Attraction, support_radius: ti.f32, normal: Vectors, acceleration: Vectors
):
    """Cohesion, area forces and adhesion; the equations stand at the class."""
    particles, near, samples = ti.static((fluid.particles, fluid.near, fluid.samples))
    inverse_support = 1.0 / support_radius
    per_volume = inverse_support * inverse_support * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(particles.count):
        x_i, n_i, own = particles.position[i], normal[i], particles.phase[i]
        total = ti.math.vec3(0.0)
        first = near.start[i]
        for k in range(near.fluid_count[i]):
            j = near.indices[first + k * near.stride]
            x_ij = x_i - particles.position[j]
            r_squared = x_ij.norm_sqr()
            if particles.phase[j] == own and r_squared < support_radius * support_radius:
                inverse_r = inverse_distance(r_squared)
                pull = (
                    fluid.volume * per_volume * cohesion_akinci2013(r_squared * inverse_r * inverse_support) * inverse_r
                )
                symmetric = 2.0 / (particles.density[i] + particles.density[j])
                total += symmetric * (pull * x_ij + AREA_SHARE * (n_i - normal[j]))
        if ti.static(attraction.with_adhesion):
            first += near.fluid_count[i] * near.stride
            for k in range(near.boundary_count[i]):
                b = near.indices[first + k * near.stride]
                if b < attraction.samples:
                    x_ib = x_i - samples.position[b]
                    pull = samples.volume[b] * per_volume * attraction.adhesion[own]
                    total += pull * adhesion_towards(x_ib, inverse_support)
        acceleration[i] -= attraction.cohesion[own] * total


@func
def adhesion_towards(x_ib: ti.math.vec3, inverse_support: ti.f32) -> ti.math.vec3:
    """A h³ along x_ib."""
    r_squared = x_ib.norm_sqr()
    inverse_r = inverse_distance(r_squared)
    return adhesion_akinci2013(r_squared * inverse_r * inverse_support) * inverse_r * x_ib


@kernel
def gather_adhesion(
    fluid: Fluid,
    attraction: Attraction,
    support_radius: ti.f32,
    near: NearParticles,
    bodies: Bodies,
    force: Vectors,
):
    """Force of adhesion on each sample of a moving body [N]; 0 on those of sheets."""
    particles, samples = ti.static((fluid.particles, fluid.samples))
    inverse_support = 1.0 / support_radius
    per_volume = fluid.volume * inverse_support * inverse_support * inverse_support
    for b in range(near.sample_count):
        total = ti.math.vec3(0.0)
        if b < bodies.sample_count:
            x_b = samples.position[near.first + b]
            for k in range(near.start[b], near.start[b] + near.count[b]):
                i = near.particles[k]
                own = particles.phase[i]
                pull = fluid.materials.rest_density[own] * attraction.cohesion[own] * attraction.adhesion[own]
                total += pull * adhesion_towards(particles.position[i] - x_b, inverse_support)
        force[b] = per_volume * samples.volume[near.first + b] * total
