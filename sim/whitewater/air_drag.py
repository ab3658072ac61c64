"""Drag of still air on drops (Gissler, Band, Peer, Ihmsen & Teschner 2017, "Generalized Drag Force for Particle-based
Simulations", section 3).

Of a drop alone in the air: F = -rho_air/2 |v| v C_D pi r², with C_D of a sphere that the air flattens.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

AIR_VISCOSITY = 1.81e-5
"""Dynamic, at 20 °C [Pa s]."""
SURFACE_TENSION = 0.072
"""Of water [N/m]; other liquids' are a third of it to equal."""

_TURBULENT_REYNOLDS, _TURBULENT_COEFFICIENT = 1000.0, 0.424
_FLATTENING = 2.632
"""What a drop as flat as a disc adds to the coefficient of a sphere, relative to it (Liu, Mather & Reitz 1993)."""
_WEBER_OF_A_DISC = 12.0
"""Weber number of the radius at which the steady deformation is 1: C_k C_b / C_F = 8 x 0.5 x 3 (Taylor's analogy)."""

Float64Array = NDArray[np.float64]


def drag_coefficient(speed: Float64Array, radius: Float64Array, air_density: float) -> Float64Array:
    """C_D of drops of these radii [m] at these speeds [m/s], (n,) each, of any density of the air above 0 [kg/m³]."""
    reynolds = np.maximum(2.0 * air_density * speed * radius / AIR_VISCOSITY, 1e-6)
    laminar = 24.0 / reynolds * (1.0 + np.cbrt(reynolds) ** 2 / 6.0)
    sphere = np.where(reynolds <= _TURBULENT_REYNOLDS, laminar, _TURBULENT_COEFFICIENT)
    flatness = np.minimum(air_density * speed**2 * radius / SURFACE_TENSION / _WEBER_OF_A_DISC, 1.0)
    return np.asarray(sphere * (1.0 + _FLATTENING * flatness))


def drag_rate(velocity: Float64Array, radius: Float64Array, *, air_density: float, rest_density: float) -> Float64Array:
    """k of dv/dt = g - k v at this velocity [1/s], (n,); 0 in a vacuum.

    Velocities are (n, 3) [m/s], radii (n,) [m], densities those of air and liquid [kg/m³].
    """
    if air_density == 0.0:
        return np.zeros(len(velocity))
    speed = np.linalg.norm(velocity, axis=1)
    coefficient = drag_coefficient(speed, radius, air_density)
    return np.asarray(0.375 * air_density / rest_density * coefficient * speed / radius)
