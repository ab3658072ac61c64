"""Thin sheets and threads of particles, filled with samples where they are stretched.

An isotropic kernel opens holes in a film once its particles are about 1.6 spacings apart, and smoothing opens them
earlier, while the particles still act on each other up to twice their spacing. Anisotropic kernels (Yu & Turk 2013)
widen in the sheet's plane instead. Samples half-way between neighbours of a sheet do the same for a mesher whose
kernels are round: splashsurf's colour field weighs each sample by the density there, so that they close gaps without
thickening what is closed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHORTEST_IN_SPACINGS, LONGEST_IN_SPACINGS = 1.2, 2.5
"""Which gaps are filled: those that the contour may not close, between particles that act on each other."""

_CLEAR = 0.98
"""Share of half a gap about its middle without a particle, for both ends to be neighbours in a Gabriel graph."""


def samples_between(positions: NDArray[np.float32], spacing: float) -> NDArray[np.intp]:
    """Pairs of particles of sheets and threads (m, 2), with a gap that needs a sample in its middle.

    The pairs are edges of the Gabriel graph: no third particle is in the ball that a pair spans.

    Args:
        positions: particles that lie in sheets and threads [m], (n, 3).
        spacing: of the particles at rest [m].
    """
    from scipy.spatial import cKDTree

    if len(positions) < 2:
        return np.zeros((0, 2), np.intp)
    tree = cKDTree(positions)
    pairs = tree.query_pairs(LONGEST_IN_SPACINGS * spacing, output_type="ndarray")
    first, second = (positions[pairs[:, end]].astype(np.float64) for end in (0, 1))
    length = np.linalg.norm(second - first, axis=1)
    wide = length > SHORTEST_IN_SPACINGS * spacing
    pairs, length, middle = pairs[wide], length[wide], 0.5 * (first + second)[wide]
    nearest, _ = tree.query(middle)
    chosen = pairs[nearest > _CLEAR * 0.5 * length]
    return np.asarray(chosen[np.lexsort((chosen[:, 1], chosen[:, 0]))], np.intp)
