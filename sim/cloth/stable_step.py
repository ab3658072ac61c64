"""How long the steps of explicit springs may be."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sim.cloth.cells import Cells
from sim.cloth.springs import Springs

Floats = NDArray[np.float64]

STEP_SAFETY = 0.7
"""Share of the linear limit that counts as stable, omega dt < 1.4: springs that turn are not linear, and modes that
swing once in three or four steps (omega dt = 3^(1/2) and 2^(1/2)) resonate (Schlick et al. 1998, "Nonlinear resonance
artifacts in molecular dynamics simulations")."""

ACCURATE_SHARE = 0.34
"""Share of the longest stable step that explicit springs take if no number of substeps is given: the energy of a sheet
that swings undamped for 10 s then stays within 0.3 %, and the error falls with the square of the step."""


def longest_explicit_step(
    families: Iterable[tuple[Springs, Floats, Floats]], cells: Iterable[tuple[Cells, Floats]], inverse_mass: Floats
) -> float:
    """Longest stable step of symplectic Euler [s]; infinite without springs.

    A mode of frequency omega with damping tau omega² is stable up to dt² omega² + 2 dt tau omega² = 4. Largest row sums
    bound the eigenvalues of M^-1 K and M^-1 D: with blocks k c_a c_b, as what a spring adds to its direction (n n^T,
    and 1 - rest/|d| across) is at most the identity while it is longer than half its rest length,

        omega² <= max_i w_i sum_s k_s |c_i| sum_b |c_b|.

    Args:
        families: springs, their stiffness k [N/m], (m,), and damping over stiffness tau [s], (m,).
        cells: cells and their law, (m, 4).
        inverse_mass: of all nodes [1/kg], (n,); 0 where a node is held.
    """
    rows = np.zeros((2, len(inverse_mass)))
    for springs, spring_stiffness, spring_damping in families:
        size = np.abs(springs.coefficients)
        row = size * size.sum(axis=1, keepdims=True) * spring_stiffness[:, None]
        nodes = springs.nodes.ravel()
        for number, values in enumerate((row, row * spring_damping[:, None])):
            rows[number] += np.bincount(nodes, weights=values.ravel(), minlength=rows.shape[1])
    for group, law in cells:
        stretch, shear, poisson, tau = law.T
        u, v = np.abs(group.along), np.abs(group.across)
        row = (stretch * (1.0 + poisson))[:, None] * (
            u * u.sum(axis=1, keepdims=True) + v * v.sum(axis=1, keepdims=True)
        )
        row += shear[:, None] * (u + v) * (u + v).sum(axis=1, keepdims=True)
        for number, values in enumerate((row, row * tau[:, None])):
            rows[number] += np.bincount(group.nodes.ravel(), weights=values.ravel(), minlength=rows.shape[1])
    stiffness, damping = (float(rate) for rate in (rows * inverse_mass).max(axis=1))
    if stiffness == 0.0:
        return math.inf
    return STEP_SAFETY * (math.sqrt(damping**2 + 4.0 * stiffness) - damping) / stiffness


def too_few_substeps(substeps: int, frame_dt: float, stable_dt: float) -> str | None:
    """Why so many steps a frame of `frame_dt` [s] are too few for explicit springs, or None."""
    if frame_dt / substeps <= stable_dt:
        return None
    return (
        f"{substeps} substeps a frame are {frame_dt / substeps:.3g} s each, and explicit springs of this stiffness and "
        f"mass are stable up to {stable_dt:.3g} s; give substeps = {math.ceil(frame_dt / stable_dt)} or more, omit it, "
        'or use integrator = "xpbd"'
    )
