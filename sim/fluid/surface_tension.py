"""Surface tension as cohesion between particles."""

import taichi as ti

from sim.fluid.kernels import spline


@ti.func
def cohesion_becker_teschner2007(distance: ti.f32, inverse_support: ti.f32, spacing: ti.f32) -> ti.f32:
    """Factor on -kappa sigma (x_i - x_j) of the cohesion; w at the distance, at least one spacing.

    Becker & Teschner 2007, eq. 16, for particles of equal mass: a_i = -kappa sum_j (x_i - x_j) W(max(|x_ij|, d)).
    The lower limit d keeps particles from clumping. Momentum is conserved pair by pair.
    """
    return spline(ti.max(distance, spacing) * inverse_support)
