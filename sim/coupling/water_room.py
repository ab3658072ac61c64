"""How much of the weight of particles at a cell's centre is where water can be."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.smoke.grid import SmokeGrid

BEYOND = 1.0e9
"""More than any fraction; products of three are still finite."""

LEAST_ROOM = 0.125
"""Least part of the weight that counts as free: in the corner of a tank it is that."""


def room_for_water(grid: SmokeGrid, domain: DomainParameters, reach: float) -> NDArray[np.float64]:
    """Part of the weight prod_a max(0, 1 - |q_a|) at each cell's centre that walls and static bodies leave, `cells`.

    Walls count exactly, bodies as the cells that they fill. `BEYOND` where a centre is beyond a wall.

    Args:
        grid: the cells.
        domain: whose closed faces are walls.
        reach: half-width of the weight along an axis [m].
    """
    x, y, z = (parts_inside(grid.origin, grid.cell_size, grid.cells, domain, reach, axis) for axis in range(3))
    room: NDArray[np.float64] = x[:, None, None].astype(np.float64) * y[None, :, None] * z[None, None, :]
    is_beyond = room >= BEYOND * LEAST_ROOM
    solid = np.where(is_beyond, 0.0, grid.solid)  # what is behind a wall is missing already
    if solid.any():
        weights = cell_weights(reach / grid.cell_size)
        for axis in range(3):
            solid = _weighted_sum(solid, weights, axis)
        room = np.maximum(room - solid, LEAST_ROOM)
    return np.where(is_beyond, BEYOND, room)


def cell_weights(reach_in_cells: float) -> NDArray[np.float64]:
    """Integrals of the weight max(0, 1 - |x| / R) / R over the cells -n..n around a centre; their sum is 1."""
    last = math.ceil(reach_in_cells + 0.5) - 1
    edges = np.clip((np.arange(-last, last + 2) - 0.5) / reach_in_cells, -1.0, 1.0)
    weights: NDArray[np.float64] = np.diff(edges - 0.5 * edges * np.abs(edges))
    return weights


def _weighted_sum(values: NDArray[np.float64], weights: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Of the neighbours along an axis; nothing is beyond the array."""
    last = len(weights) // 2
    padding = [(last, last) if a == axis else (0, 0) for a in range(3)]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, padding), len(weights), axis=axis)
    total: NDArray[np.float64] = windows @ weights
    return total


def parts_inside(
    origin: tuple[float, float, float],
    cell_size: float,
    cells: tuple[int, int, int],
    domain: DomainParameters,
    reach: float,
    axis: int,
) -> NDArray[np.float32]:
    """Part of the weight max(0, 1 - |q|) along an axis that lies within the domain's closed faces, by cell, (n,).

    `BEYOND` where a cell's centre is beyond a closed face: no fraction of water makes it water.

    Args:
        origin: lower corner of the cells [m].
        cell_size: [m].
        cells: how many along each axis.
        domain: whose open faces end nothing.
        reach: half-width of the weight [m].
        axis: 0, 1 or 2.
    """
    centres = origin[axis] + (np.arange(cells[axis]) + 0.5) * cell_size
    parts, is_beyond = np.ones(len(centres)), np.zeros(len(centres), bool)
    for face, distance in (
        (f"{'xyz'[axis]}-", centres - domain.min[axis]),
        (f"{'xyz'[axis]}+", domain.max[axis] - centres),
    ):
        if face not in domain.open_faces:
            parts -= 0.5 * (1.0 - np.clip(distance / reach, 0.0, 1.0)) ** 2
            is_beyond |= distance < 0.0
    # In a domain narrower than the reach at least half of it is inside: the two halves of the weight overlap.
    return np.where(is_beyond, BEYOND, np.maximum(parts, 0.5)).astype(np.float32)
