"""Drag of the air on a drop, a sphere that it flattens (Gissler, Band, Peer, Ihmsen & Teschner 2017, section 3)."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.bundles import func
from sim.core.water import TENSION_OF_WATER

AIR_VISCOSITY = 1.82e-5  # dynamic, at 20 degrees C [Pa s]
AIR_DENSITY = 1.2  # likewise [kg/m³]
FLATTENING = 1.0 / 12.0  # y over the Weber number of the radius, in a steady stream (TAB model, O'Rourke & Amsden 1987)
FLAT_DRAG = 2.632  # growth of C_D with the flattening (Liu, Mather & Reitz 1993, eq. 7) [-]
LEAST_REYNOLDS = 1.0e-6  # keeps the coefficient finite at rest; drag is linear in speed far above
TURBULENT_REYNOLDS, TURBULENT_DRAG = 1000.0, 0.424

Float64Array = NDArray[np.float64]


@func
def drag_coefficient(reynolds: ti.f32) -> ti.f32:
    """C_D of a sphere at a Reynolds number by its diameter [-], for the force 1/2 rho v² C_D pi r².

    24/Re (1 + Re^(2/3)/6) up to Re = 1000, from there on 0.424 (Putnam 1961; Liu, Mather & Reitz 1993, eq. 5).
    """
    re = ti.max(reynolds, LEAST_REYNOLDS)
    slow = 24.0 / re * (1.0 + re ** (2.0 / 3.0) / 6.0)
    return ti.select(re > TURBULENT_REYNOLDS, TURBULENT_DRAG, slow)


def drag_coefficients(reynolds: Float64Array) -> Float64Array:
    """`drag_coefficient` of many spheres on the host, of any shape."""
    re = np.maximum(reynolds, LEAST_REYNOLDS)
    slow = 24.0 / re * (1.0 + np.cbrt(re) ** 2 / 6.0)
    return np.where(re > TURBULENT_REYNOLDS, TURBULENT_DRAG, slow)


def drag_rate(velocity: Float64Array, radius: Float64Array, *, air_density: float, rest_density: float) -> Float64Array:
    """k of dv/dt = g - k v of drops of water alone in still air [1/s], (n,); 0 in a vacuum.

    F = -1/2 rho_air |v| v C_D (1 + 2.632 y) pi r², y = We/12, at most 1, We = rho_air |v|² r/sigma.

    Args:
        velocity: (n, 3) [m/s].
        radius: (n,) [m].
        air_density: [kg/m³].
        rest_density: of the liquid [kg/m³].
    """
    speed = np.linalg.norm(velocity, axis=1)
    flat = np.minimum(FLATTENING * air_density * speed**2 * radius / TENSION_OF_WATER, 1.0)
    coefficient = drag_coefficients(2.0 * air_density * speed * radius / AIR_VISCOSITY) * (1.0 + FLAT_DRAG * flat)
    return np.asarray(0.375 * air_density / rest_density * coefficient * speed / radius)
