"""Surface tension after Akinci, Akinci & Teschner 2013, "Versatile Surface Tension and Adhesion for SPH Fluids"."""

from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.fluid.device import Fluid
from sim.fluid.discretization import Discretization
from sim.fluid.kernels import inverse_distance, lattice_offsets, particle_volume, spline_slope
from sim.fluid.parameters import FluidParameters

COHESION_PER_TENSION = 100.0
"""Cohesion c [m/s²] over sigma/(rho0 h²) with which a drop oscillates as one of surface tension sigma does (Rayleigh);
measured."""

RATE_PER_COHESION = 1.0
"""Square of the frequency of a particle on the springs of its neighbours' cohesion over c/h [-]: the slope of V C is at
most 0.135/h between two particles of a lattice, and six are as near as that."""

AREA_SHARE = 1.0e-3
"""Coefficient of the area forces over that of cohesion, both as accelerations. The paper has one gamma for both: its
cohesion is gamma rho0 V C, its area force gamma (n_i - n_j), and rho0 is 1000 in its units."""


@bundle
class Attraction(NamedTuple):
    """Attraction between particles, and to boundaries, of each fluid, (k,)."""

    cohesion: Floats  # c [m/s²]
    adhesion: Floats  # beta [-]
    with_adhesion: ti.template()  # whether any fluid has adhesion


class SurfaceTensionAkinci2013:
    """Cohesion and area forces between the particles of a fluid, and its adhesion to boundaries.

    a_i = -c sum_j K_ij [V C(|x_ij|) x_ij/|x_ij| + a (n_i - n_j)] - beta c sum_b V_b A(|x_ib|) x_ib/|x_ib|
    n_i = h sum_j V/rho_j grad W_ij (eq. 4), K_ij = 2/(rho_i + rho_j) (eq. 5), with relative densities

    C (eq. 2) pulls beyond 0.37 h and pushes nearer than that; A (eq. 7) pulls between h/2 and h. Our support h is
    theirs. Fluids attract their own kind alone. Momentum is conserved pair by pair; angular momentum is not, as
    n_i - n_j is not along x_ij.
    """

    def __init__(
        self, capacity: int, fluids: tuple[FluidParameters, ...], cohesion: np.ndarray, discretization: Discretization
    ) -> None:
        """Prepare for particles of these fluids, whose cohesion is c [m/s²], (k,)."""
        self._normal = ti.Vector.ndarray(3, ti.f32, capacity)
        self._discretization = discretization
        adhesion = np.array([fluid.adhesion for fluid in fluids])
        self._attraction = Attraction(on_device(cohesion), on_device(adhesion), bool((adhesion > 0.0).any()))

    def add_acceleration(self, fluid: Fluid, acceleration: ti.Ndarray) -> None:
        """Add the accelerations by surface tension to all others [m/s²]."""
        d = self._discretization
        compute_normals(fluid, d.sigma * d.particle_volume, self._normal)
        add_surface_tension(fluid, self._attraction, d.support_radius, self._normal, acceleration)


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
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        x_i = fluid.particles.position[i]
        total = ti.math.vec3(0.0)
        first = fluid.near.start[i]
        for k in range(fluid.near.fluid_count[i]):
            j = fluid.near.indices[first + k * fluid.near.stride]
            if fluid.particles.phase[j] == fluid.particles.phase[i]:
                x_ij = x_i - fluid.particles.position[j]
                r_squared = x_ij.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                slope = spline_slope(r_squared * inverse_r * fluid.inverse_support)
                total += slope * inverse_r / fluid.particles.density[j] * x_ij
        normal[i] = sigma_volume * total


@kernel
def add_surface_tension(
    fluid: Fluid, attraction: Attraction, support_radius: ti.f32, normal: Vectors, acceleration: Vectors
):
    """Cohesion, area forces and adhesion; the equations stand at the class."""
    inverse_support = 1.0 / support_radius
    per_volume = inverse_support * inverse_support * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(fluid.particles.count):
        x_i, n_i, own = fluid.particles.position[i], normal[i], fluid.particles.phase[i]
        total = ti.math.vec3(0.0)
        first = fluid.near.start[i]
        for k in range(fluid.near.fluid_count[i]):
            j = fluid.near.indices[first + k * fluid.near.stride]
            x_ij = x_i - fluid.particles.position[j]
            r_squared = x_ij.norm_sqr()
            if fluid.particles.phase[j] == own and r_squared < support_radius * support_radius:
                inverse_r = inverse_distance(r_squared)
                pull = (
                    fluid.volume * per_volume * cohesion_akinci2013(r_squared * inverse_r * inverse_support) * inverse_r
                )
                symmetric = 2.0 / (fluid.particles.density[i] + fluid.particles.density[j])
                total += symmetric * (pull * x_ij + AREA_SHARE * (n_i - normal[j]))
        if ti.static(attraction.with_adhesion):
            first += fluid.near.fluid_count[i] * fluid.near.stride
            for k in range(fluid.near.boundary_count[i]):
                b = fluid.near.indices[first + k * fluid.near.stride]
                x_ib = x_i - fluid.samples.position[b]
                r_squared = x_ib.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                pull = (
                    fluid.samples.volume[b] * per_volume * adhesion_akinci2013(r_squared * inverse_r * inverse_support)
                )
                total += attraction.adhesion[own] * pull * inverse_r * x_ib
        acceleration[i] -= attraction.cohesion[own] * total
