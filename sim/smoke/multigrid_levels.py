"""The pressure equation on ever coarser grids, as coefficients.

Finite volumes on a rectilinear grid: the flux between two cells is (open area / distance of their centres) times the
difference of their pressures. A coarse cell is two fine ones along each axis, or one at the end of an odd axis, and its
faces add up the open area of the fine faces in them. So any size of grid works without padding, and small openings
stay open on coarse grids.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.smoke.grid import Index3, SmokeGrid

COARSEST_CELLS = 64
"""At most this many cells are solved directly, by a dense inverse."""

DIRICHLET_GHOST = -1.0
"""Mark in the ghosts of `inverse_diagonal`: beyond this side pressure changes sign."""


@dataclass(frozen=True)
class Level:
    """The operator (A p)_i = sum over faces of conductance * (p_i - p_neighbour) on one grid.

    Attributes:
        cells: how many cells along x, y, z.
        conductance: by axis, padded (nx + 2, ny + 2, nz + 2), float32, in units of the finest cell; 0 where closed.
        inverse_diagonal: padded, float32; 0 in cells without an open face, `DIRICHLET_GHOST` beyond open sides.
    """

    cells: Index3
    conductance: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    inverse_diagonal: NDArray[np.float32]

    @property
    def size(self) -> int:
        """Length of a flat array with ghosts."""
        return math.prod(n + 2 for n in self.cells)

    def matrix(self) -> NDArray[np.float64]:
        """The operator as a dense symmetric matrix over the cells in C order."""
        count = math.prod(self.cells)
        number = np.full(tuple(n + 2 for n in self.cells), -1)
        number[1:-1, 1:-1, 1:-1] = np.arange(count).reshape(self.cells)
        matrix = np.zeros((count, count))
        for axis, conductance in enumerate(self.conductance):
            below = np.roll(number, 1, axis)
            for upper, lower, value in zip(number.ravel(), below.ravel(), conductance.ravel(), strict=True):
                if value == 0.0:
                    continue
                for cell, other in ((upper, lower), (lower, upper)):
                    if cell >= 0:
                        matrix[cell, cell] += value
                        if other >= 0:
                            matrix[cell, other] -= value
        return matrix


def build_levels(grid: SmokeGrid) -> list[Level]:
    """The levels of a grid, finest first; the last has at most `COARSEST_CELLS` cells."""
    area = list(grid.open_area)
    widths = [np.ones(n) for n in grid.cells]
    levels = [_level(grid, area, widths)]
    while math.prod(levels[-1].cells) > COARSEST_CELLS:
        area = [_coarsen_faces(faces, axis) for axis, faces in enumerate(area)]
        widths = [_add_pairs(width, 0) for width in widths]
        levels.append(_level(grid, area, widths))
    return levels


def _level(grid: SmokeGrid, area: list[NDArray[np.float64]], widths: list[NDArray[np.float64]]) -> Level:
    nx, ny, nz = (len(width) for width in widths)
    padded = (nx + 2, ny + 2, nz + 2)
    conductance = []
    diagonal = np.zeros((nx, ny, nz))
    for axis, (faces, width) in enumerate(zip(area, widths, strict=True)):
        centre_distance = 0.5 * (np.concatenate([[0.0], width]) + np.concatenate([width, [0.0]]))
        shape = [1, 1, 1]
        shape[axis] = -1
        values = faces / centre_distance.reshape(shape)
        diagonal += np.delete(values, 0, axis) + np.delete(values, -1, axis)
        array = np.zeros(padded, np.float32)
        array[tuple(slice(1, 1 + n) for n in values.shape)] = values
        conductance.append(array)
    inverse = np.zeros(padded, np.float32)
    for axis in range(3):
        for side in (0, 1):
            if grid.is_open(axis, side):
                np.moveaxis(inverse, axis, 0)[-side] = DIRICHLET_GHOST
    inverse[1:-1, 1:-1, 1:-1] = np.divide(1.0, diagonal, out=np.zeros_like(diagonal), where=diagonal > 0.0)
    return Level((nx, ny, nz), (conductance[0], conductance[1], conductance[2]), inverse)


def _coarsen_faces(faces: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Every second plane of faces, and the last one; across the other axes, pairs add up."""
    count = faces.shape[axis] - 1
    kept = np.take(faces, [*range(0, count, 2), count], axis=axis)
    for other in range(3):
        if other != axis:
            kept = _add_pairs(kept, other)
    return kept


def _add_pairs(values: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    return np.add.reduceat(values, np.arange(0, values.shape[axis], 2), axis=axis)
