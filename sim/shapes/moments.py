"""Volume integrals over a solid that is known by its signed distance."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.shapes.solid import Points

_CELLS_PER_BLOCK = 4


class HasSignedDistance(Protocol):
    """What the integrals need of a solid."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner [m], (2, 3)."""

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,)."""


class VolumeMoments(NamedTuple):
    """Integrals over the inside, about the origin.

    Attributes:
        volume: ∫ dV [m³].
        first: ∫ x dV [m⁴], (3,).
        second: ∫ x xᵀ dV [m⁵], (3, 3).
    """

    volume: float
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def integrate_moments(solid: HasSignedDistance, *, cells: int = 64) -> VolumeMoments:
    """Moments of a solid, second order in the size of the cells.

    A cell cut by the surface counts with the fraction clip(1/2 - distance/edge, 0, 1) of its volume. Blocks of 4³
    cells whose centre is farther from the surface than their corners are in or out as a whole.

    Args:
        solid: what to integrate over.
        cells: cells along the longest edge of its bounds; 64 give a sphere's volume within 0.1 %.
    """
    lower, upper = solid.bounds
    edge = float((upper - lower).max()) / cells
    block_edge = _CELLS_PER_BLOCK * edge
    counts = np.ceil((upper - lower) / block_edge + 0.25).astype(int)  # a cell of margin: half of it on either side
    first_block = 0.5 * (lower + upper) - 0.5 * block_edge * (counts - 1)
    blocks = first_block + block_edge * np.stack(np.indices(counts), axis=-1).reshape(-1, 3)

    distance = solid.signed_distance(blocks)
    near = np.abs(distance) < 0.5 * np.sqrt(3.0) * block_edge + 0.5 * edge
    offsets = (np.indices((_CELLS_PER_BLOCK,) * 3).reshape(3, -1).T - 0.5 * (_CELLS_PER_BLOCK - 1)) * edge
    nodes = (blocks[near][:, None] + offsets).reshape(-1, 3)
    fraction = np.clip(0.5 - solid.signed_distance(nodes) / edge, 0.0, 1.0)
    whole = blocks[~near & (distance < 0.0)]
    of_blocks = _sum_cells(whole, np.ones(len(whole)), block_edge)
    of_nodes = _sum_cells(nodes, fraction, edge)
    return VolumeMoments(*(a + b for a, b in zip(of_blocks, of_nodes, strict=True)))


def _sum_cells(centres: Points, fraction: NDArray[np.float64], edge: float) -> VolumeMoments:
    """Moments of cubes with the given edge, each filled evenly by its fraction."""
    weight = fraction * edge**3
    about_own_centres = np.eye(3) * (weight.sum() * edge**2 / 12.0)
    return VolumeMoments(
        float(weight.sum()), weight @ centres, (centres * weight[:, None]).T @ centres + about_own_centres
    )
