"""Viscous forces between particles, shared by all particle fluids."""

from typing import NamedTuple

import taichi as ti

from sim.core.bundles import bundle, func

# 2 (d + 2) of Monaghan's viscosity in d = 3 dimensions.
LAPLACIAN_FACTOR = 10.0

# Keeps |x_ij|² + 0.01 h² away from zero for particles that meet.
SOFTENING = 0.01


@bundle
class Viscosity(NamedTuple):
    """Viscosity that is not of one fluid alone."""

    softening: ti.f32  # 0.01 h² [m²]
    artificial: ti.f32  # alpha c_s h/2 [m²/s]
    wall_friction: ti.f32  # viscosity against boundaries over that of the fluid [-]
    with_wall_friction: ti.template()  # whether it is above 0


@func
def viscous_factor(v_dot_x: ti.f32, r_squared: ti.f32, softening: ti.f32, mu: ti.f32, artificial: ti.f32) -> ti.f32:
    """Factor on V/(rho_ij/rho0) grad W_ij / rho0 of the viscous acceleration.

    Physical part, Monaghan 2005, eq. 8.9 with the constant for three dimensions:
    a_i = 2 (d+2) nu sum_j (m_j / rho_ij) (v_ij . x_ij) / (|x_ij|² + 0.01 h²) grad W_ij.
    Artificial part, Monaghan 1992, eq. 4.1 with beta = 0, between particles that approach each other only:
    a_i = alpha c_s h_s sum_j (m_j / rho_ij) min(v_ij . x_ij, 0) / (|x_ij|² + 0.01 h²) grad W_ij,
    with the smoothing length h_s = h/2. Both conserve momentum pair by pair as rho_ij = (rho_i + rho_j)/2. Particles of
    equal volume V have m_j = rho0 V; so the force holds between two fluids as well. `softening` is 0.01 h² [m²], `mu`
    2 (d+2) rho0 nu, and `artificial` rho0 alpha c_s h_s [Pa s].
    """
    return (mu * v_dot_x + artificial * ti.min(v_dot_x, 0.0)) / (r_squared + softening)


@func
def pair_viscosity(mu_i: ti.f32, mu_j: ti.f32) -> ti.f32:
    """Dynamic viscosity between particles of two fluids, the harmonic mean: the shear stress is continuous then.

    Cleary & Monaghan 1999, "Conduction modelling using smoothed particle hydrodynamics", eq. 14, for viscosity.
    """
    return 2.0 * mu_i * mu_j / ti.max(mu_i + mu_j, 1.0e-30)
