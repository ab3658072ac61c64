"""Viscous forces between particles, shared by all particle fluids."""

import taichi as ti

DIMENSIONS = 3
LAPLACIAN_FACTOR = 2.0 * (DIMENSIONS + 2)
"""2 (d + 2) of Monaghan's viscosity."""

SOFTENING = 0.01
"""Keeps |x_ij|² + 0.01 h² away from zero for particles that meet."""


@ti.func
def viscous_factor(v_dot_x: ti.f32, r_squared: ti.f32, softening: ti.f32, nu: ti.f32, artificial: ti.f32) -> ti.f32:
    """Factor on (m_j / rho_ij) grad W_ij of the viscous acceleration.

    Physical part, Monaghan 2005, eq. 8.9 with the constant for three dimensions:
    a_i = 2 (d+2) nu sum_j (m_j / rho_ij) (v_ij . x_ij) / (|x_ij|² + 0.01 h²) grad W_ij.
    Artificial part, Monaghan 1992, eq. 4.1 with beta = 0, between particles that approach each other only:
    a_i = alpha c_s h_s sum_j (m_j / rho_ij) min(v_ij . x_ij, 0) / (|x_ij|² + 0.01 h²) grad W_ij,
    with the smoothing length h_s = h/2. Both conserve momentum pair by pair as rho_ij = (rho_i + rho_j)/2.

    Args:
        v_dot_x: (v_i - v_j) . (x_i - x_j) [m²/s].
        r_squared: |x_i - x_j|² [m²].
        softening: 0.01 h² [m²].
        nu: kinematic viscosity times 2 (d+2) [m²/s].
        artificial: alpha c_s h_s [m²/s].
    """
    return (nu * v_dot_x + artificial * ti.min(v_dot_x, 0.0)) / (r_squared + softening)
