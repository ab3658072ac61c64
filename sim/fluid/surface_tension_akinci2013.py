"""Surface tension after Akinci, Akinci & Teschner 2013, "Versatile Surface Tension and Adhesion for SPH Fluids"."""

import numpy as np
import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.fluid.kernels import inverse_distance, lattice_offsets, particle_volume, spline_slope
from sim.launch import fast_launch

COHESION_PER_TENSION = 100.0
"""Cohesion c [m/s²] over sigma/(rho0 h²) with which a drop oscillates as one of surface tension sigma does (Rayleigh).

Measured. A sharp surface of particles that attract each other with the force m c V C(r) would have the tension
sigma = pi/8 rho0 c int C(r) r⁴ dr (Fowler 1937), which asks for 335; area forces and the layers that form under the
surface make it stronger.
"""

RATE_PER_COHESION = 1.0
"""Square of the frequency of a particle on the springs of its neighbours' cohesion over c/h [-]: at the usual support
the slope of V C is at most 0.135/h between two particles of a lattice, and six are as near as that. At wider ones the
sum of all slopes is at most 1.44/h, and no displacement is along more than a third of it."""

AREA_SHARE = 1.0e-3
"""Coefficient of the area forces over that of cohesion, both as accelerations. The paper has one gamma for both: its
cohesion is gamma rho0 V C, its area force gamma (n_i - n_j), and rho0 is 1000 in its units."""


class SurfaceTensionAkinci2013:
    """Cohesion and area forces between the particles of a fluid, and its adhesion to boundaries.

    a_i = -c sum_j K_ij [V C(|x_ij|) x_ij/|x_ij| + a (n_i - n_j)] - beta c sum_b V_b A(|x_ib|) x_ib/|x_ib|
    n_i = h sum_j V/rho_j grad W_ij (eq. 4), K_ij = 2/(rho_i + rho_j) (eq. 5), with relative densities

    C (eq. 2) pulls beyond 0.37 h and pushes nearer than that; A (eq. 7) pulls between h/2 and h. Our support h is
    theirs. Fluids attract their own kind alone. Momentum is conserved pair by pair; angular momentum is not, as
    n_i - n_j is not along x_ij.
    """

    def __init__(self, capacity: int) -> None:
        self._normal = ti.Vector.ndarray(3, ti.f32, max(capacity, 1))

    def add_acceleration(
        self,
        *,
        position: ti.Ndarray,
        phase: ti.Ndarray,
        density: ti.Ndarray,
        count: int,
        neighbor_list: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray, ti.Ndarray, int],
        boundary: tuple[ti.Ndarray, ti.Ndarray],
        cohesion: ti.Ndarray,
        adhesion: ti.Ndarray,
        sigma: float,
        volume: float,
        support_radius: float,
        with_adhesion: bool,
        acceleration: ti.Ndarray,
    ) -> None:
        """Add the accelerations by surface tension to all others.

        Args:
            position: of the particles [m].
            phase: which fluid each particle is of.
            density: relative to the rest density [-].
            count: number of particles.
            neighbor_list: start, fluid_count, boundary_count, indices, stride.
            boundary: position [m] and volume [m³] of the boundary samples.
            cohesion: c of each fluid [m/s²].
            adhesion: beta of each fluid [-].
            sigma: factor of the kernel [1/m³].
            volume: of a particle [m³].
            support_radius: h [m].
            with_adhesion: whether any fluid has adhesion.
            acceleration: by all other forces [m/s²]; that by surface tension is added.
        """
        start, fluid_count, _, neighbors, stride = neighbor_list
        compute_normals(
            position, phase, density, count, start, fluid_count, neighbors, stride,
            sigma * volume, 1.0 / support_radius, self._normal,
        )  # fmt: skip
        add_surface_tension(
            position, phase, density, count, *neighbor_list, *boundary, cohesion, adhesion,
            volume, support_radius, with_adhesion, self._normal, acceleration,
        )  # fmt: skip


@ti.func
def cohesion_akinci2013(q: ti.f32) -> ti.f32:
    """C(q h) h³, eq. 2: 32/pi (1-q)³ q³, below q = 1/2 twice that less 1/64."""
    outer = ti.max(1.0 - q, 0.0)
    bump = outer * outer * outer * q * q * q
    return 32.0 / ti.math.pi * ti.select(q > 0.5, bump, 2.0 * bump - 1.0 / 64.0)


def cohesion_stress_akinci2013(support_in_spacings: float) -> float:
    """Stress with which cohesion pulls a filled lattice together, over rho0 c h: sum_j V C(|x_ij|) |x_ij| / (6 h) [-].

    0.028 at the usual support, 0.024 to 0.025 at wider ones.
    """
    q = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1) / support_in_spacings
    bump = (1.0 - q) ** 3 * q**3
    cohesion = 32.0 / np.pi * np.where(q > 0.5, bump, 2.0 * bump - 1.0 / 64.0) / support_in_spacings**3
    return particle_volume(1.0, support_in_spacings) * float((cohesion * q).sum()) / 6.0


@ti.func
def adhesion_akinci2013(q: ti.f32) -> ti.f32:
    """A(q h) h³, eq. 7: 0.007 (-4 q² + 6 q - 2)^(1/4) for 1/2 < q < 1."""
    return 0.007 * ti.sqrt(ti.sqrt(ti.max(-4.0 * q * q + 6.0 * q - 2.0, 0.0)))


@fast_launch
@ti.kernel
def compute_normals(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, neighbors: Integers, stride: ti.template(),
    sigma_volume: ti.f32, inverse_support: ti.f32, normal: Vectors,
):  # fmt: skip
    """n_i = h sum_j V/rho_j grad W_ij over the particle's own fluid: 0 within, into the fluid at its surface."""
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = position[i]
        total = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            if phase[j] == phase[i]:
                x_ij = x_i - position[j]
                r_squared = x_ij.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                total += spline_slope(r_squared * inverse_r * inverse_support) * inverse_r / density[j] * x_ij
        normal[i] = sigma_volume * total


@fast_launch
@ti.kernel
def add_surface_tension(
    position: Vectors, phase: Integers, density: Floats, count: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, neighbors: Integers, stride: ti.template(),
    boundary_position: Vectors, boundary_volume: Floats, cohesion: Floats, adhesion: Floats,
    volume: ti.f32, support_radius: ti.f32, with_adhesion: ti.template(), normal: Vectors, acceleration: Vectors,
):  # fmt: skip
    """Cohesion, area forces and adhesion; the equations stand at the class."""
    inverse_support = 1.0 / support_radius
    per_volume = inverse_support * inverse_support * inverse_support
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, n_i, own = position[i], normal[i], phase[i]
        total = ti.math.vec3(0.0)
        first = start[i]
        for k in range(fluid_count[i]):
            j = neighbors[first + k * stride]
            x_ij = x_i - position[j]
            r_squared = x_ij.norm_sqr()
            if phase[j] == own and r_squared < support_radius * support_radius:
                inverse_r = inverse_distance(r_squared)
                pull = volume * per_volume * cohesion_akinci2013(r_squared * inverse_r * inverse_support) * inverse_r
                total += 2.0 / (density[i] + density[j]) * (pull * x_ij + AREA_SHARE * (n_i - normal[j]))
        if ti.static(with_adhesion):
            first += fluid_count[i] * stride
            for k in range(boundary_count[i]):
                b = neighbors[first + k * stride]
                x_ib = x_i - boundary_position[b]
                r_squared = x_ib.norm_sqr()
                inverse_r = inverse_distance(r_squared)
                pull = boundary_volume[b] * per_volume * adhesion_akinci2013(r_squared * inverse_r * inverse_support)
                total += adhesion[own] * pull * inverse_r * x_ib
        acceleration[i] -= cohesion[own] * total
