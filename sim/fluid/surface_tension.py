"""Surface tension as cohesion between particles."""

import numpy as np
import taichi as ti

from sim.fluid.kernels import evaluate, lattice_offsets, spline


@ti.func
def cohesion_becker_teschner2007(distance: ti.f32, inverse_support: ti.f32, spacing: ti.f32) -> ti.f32:
    """Factor on -kappa sigma (x_i - x_j) of the cohesion; w at the distance, at least one spacing.

    Becker & Teschner 2007, eq. 16, for particles of equal mass: a_i = -kappa sum_j (x_i - x_j) W(max(|x_ij|, d)).
    The lower limit d keeps particles from clumping. Momentum is conserved pair by pair.
    """
    return spline(ti.max(distance, spacing) * inverse_support)


def cohesion_stress(support_in_spacings: float) -> float:
    """Stress with which this cohesion pulls a filled lattice together, over rho kappa/d: sum_j |x_ij|² W_ij d/6 [-].

    0.15 at the usual support, four times that at twice the support, where the farther neighbours pull as well.
    """
    distances = _neighbor_distances(support_in_spacings)
    return float((distances**2 * evaluate(distances, support_in_spacings)).sum()) / 6.0


def cohesion_rate(support_in_spacings: float) -> float:
    """Square of a particle's frequency on the springs that its neighbours are, over kappa/d³: sum_j W_ij d³ [-]."""
    return float(evaluate(_neighbor_distances(support_in_spacings), support_in_spacings).sum())


def _neighbor_distances(support_in_spacings: float) -> np.ndarray:
    """Of the neighbours in a filled lattice [spacings]; none is nearer than the lower limit."""
    distances = np.linalg.norm(lattice_offsets(support_in_spacings), axis=1)
    return distances[distances > 0.0]
