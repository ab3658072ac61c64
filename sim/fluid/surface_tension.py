"""Surface tension as cohesion between particles."""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.bundles import func
from sim.fluid.discretization import Discretization
from sim.fluid.kernels import evaluate, lattice_offsets, spline
from sim.fluid.parameters import FluidParameters
from sim.fluid.surface_tension_akinci2013 import COHESION_PER_TENSION, RATE_PER_COHESION, cohesion_stress_akinci2013


@dataclass(frozen=True, eq=False)
class Cohesion:
    """Surface tension of the fluids of a tank: its model, its strength, and what it asks of speeds and steps.

    Attributes:
        is_becker_teschner2007: whether there is that of Becker & Teschner 2007.
        is_akinci2013: whether there is that of Akinci et al. 2013.
        akinci2013: its cohesion c of each fluid [m/s²], (k,).
        stress: with which it pulls a filled lattice together, over the density [m²/s²].
        rate: square of the frequency of a particle on the spring that its neighbours' cohesion is [1/s²].
    """

    is_becker_teschner2007: bool
    is_akinci2013: bool
    akinci2013: NDArray[np.float64]
    stress: float
    rate: float

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
