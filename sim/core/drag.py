"""Drag of a sphere, for whatever flies."""

import taichi as ti

from sim.core.bundles import func

LEAST_REYNOLDS = 1.0e-6  # keeps the coefficient finite at rest; drag is linear in speed far above


@func
def drag_coefficient(reynolds: ti.f32) -> ti.f32:
    """C_D of a sphere at a Reynolds number by its diameter [-], for the force 1/2 rho v² C_D pi r².

    24/Re (1 + Re^(2/3)/6) up to Re = 1000, from there on 0.424 (Putnam 1961; Liu, Mather & Reitz 1993, eq. 5).
    """
    re = ti.max(reynolds, LEAST_REYNOLDS)
    slow = 24.0 / re * (1.0 + re ** (2.0 / 3.0) / 6.0)
    return ti.select(re > 1000.0, 0.424, slow)
