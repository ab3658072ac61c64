"""How much memory a particle fluid takes."""

from __future__ import annotations

from sim.neighbors import GROWTH

EXPECTED_NEIGHBORS = 48
"""Places in the neighbour list per particle, with the skin, and on a GPU the padding of its slices."""


def estimate_bytes(particle_count: int, boundary_count: int, cell_count: int) -> int:
    """Memory of a particle fluid on its device [bytes], for planning.

    Args:
        particle_count: most particles that there can be.
        boundary_count: samples of walls and bodies.
        cell_count: cells of the search for neighbours, which cover the whole domain.
    """
    vector, number = 12, 4
    state = 2 * (2 * vector + 2 * number) + vector  # position, velocity, id and phase, sorted from and to; reference
    results = vector + 2 * number  # acceleration, density, pressure
    search = 5 * number + EXPECTED_NEIGHBORS * GROWTH * number  # cell, order, start, two counts; the list itself
    boundary = 3 * vector + 3 * number  # position, coordinates and velocity; volume, cell, order
    cell = 3 * number  # where its particles and its samples start; the cursor of the sort
    return int(particle_count * (state + results + search) + boundary_count * boundary + cell_count * cell)
