"""Memory of a particle fluid."""

from __future__ import annotations

from sim.core.neighbors import GROWTH
from sim.fluid.kernels import SUPPORT_IN_SPACINGS

EXPECTED_NEIGHBORS = 48
"""Places in the neighbour list per particle, with the skin, and on a GPU the padding of its slices, at the usual
support radius; they grow with its cube."""


def estimate_bytes(
    particle_count: int,
    boundary_count: int,
    cell_count: int,
    *,
    support_in_spacings: float = SUPPORT_IN_SPACINGS,
    extra_bytes: int = 0,
) -> int:
    """Memory of a particle fluid on its device [bytes], for planning.

    Args:
        particle_count: most particles that there can be.
        boundary_count: samples of walls and bodies.
        cell_count: cells of the search for neighbours, which cover the whole domain.
        support_in_spacings: support radius of the kernel.
        extra_bytes: of a particle, as the solver's `SolverTraits` have them.
    """
    vector, number = 12, 4
    state = 2 * (2 * vector + 2 * number) + vector  # position, velocity, id and phase, sorted from and to; reference
    results = vector + 2 * number  # acceleration, density, pressure
    entries = EXPECTED_NEIGHBORS * (support_in_spacings / SUPPORT_IN_SPACINGS) ** 3
    search = 5 * number + entries * GROWTH * number  # cell, order, start, two counts; the list itself
    boundary = 3 * vector + 4 * number  # position, coordinates and velocity; volume, that of friction, cell, order
    cell = 3 * number  # where its particles and its samples start; the cursor of the sort
    return int(
        particle_count * (state + results + search + extra_bytes) + boundary_count * boundary + cell_count * cell
    )
