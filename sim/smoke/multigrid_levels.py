"""The pressure equation on ever coarser grids, as coefficients.

Finite volumes on a rectilinear grid: the flux between two cells is (open area / distance of their centres) times the
difference of their pressures. A coarse cell is two fine ones along each axis, or one at the end of an odd axis, and its
faces add up the open area of the fine faces in them. So any size of grid works without padding, and small openings
stay open on coarse grids.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.smoke.grid import Index3, SmokeGrid
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.obstacles import Obstacles

COARSEST_CELLS = 64
"""At most this many cells are solved directly, by a dense inverse."""

LARGEST_INDEX = 2**31 - 1
"""Flat indices in kernels are 32 bits wide."""

DIRICHLET_GHOST = -1.0
"""Mark in the ghosts of `inverse_diagonal`: beyond this side pressure changes sign."""


@dataclass(frozen=True)
class Level:
    """One of the grids; the arrays of all levels stand one after another in one flat field.

    Attributes:
        cells: how many cells along x, y, z.
        offset: where its flat arrays, with ghosts, begin.
        widths: of its cells along each axis, in units of the finest cell.
        distance_offsets: by axis, where the distances of its centres across its faces begin.
    """

    cells: Index3
    offset: int
    widths: tuple[NDArray[np.float64], ...]
    distance_offsets: Index3

    @property
    def padded(self) -> Index3:
        """Shape of its arrays with ghosts."""
        nx, ny, nz = (n + 2 for n in self.cells)
        return nx, ny, nz

    @property
    def size(self) -> int:
        """Length of a flat array with ghosts."""
        return math.prod(self.padded)

    @property
    def centre_distances(self) -> list[NDArray[np.float64]]:
        """By axis, at face n = 1 .. nx + 1 the distance of the centres on its sides; on the side of the box itself."""
        return [
            0.5 * np.concatenate([[0.0], width, [0.0]]) + 0.5 * np.concatenate([[0.0, 0.0], width])
            for width in self.widths
        ]


def plan_levels(cells: Index3) -> list[Level]:
    """The levels of a grid, finest first; the last has at most `COARSEST_CELLS` cells.

    Raises:
        ValueError: there are more values on all levels together than indices of 32 bits can tell apart.
    """
    levels: list[Level] = []
    widths = tuple(np.ones(n) for n in cells)
    offset, distances = 0, 0
    while not levels or math.prod(levels[-1].cells) > COARSEST_CELLS:
        if levels:
            widths = tuple(np.add.reduceat(width, np.arange(0, len(width), 2)) for width in widths)
        nx, ny, nz = (len(width) for width in widths)
        begins = (distances, distances + nx + 2, distances + nx + ny + 4)
        levels.append(Level((nx, ny, nz), offset, widths, begins))
        offset += levels[-1].size
        distances += nx + ny + nz + 6
    if offset > LARGEST_INDEX:
        raise ValueError(
            f"a smoke of {cells[0]} x {cells[1]} x {cells[2]} cells is too large: with its coarser grids and the layer "
            f"around each it has {offset} values a field, and at most {LARGEST_INDEX} can be counted"
        )
    return levels


def operator_matrix(conductance: tuple[NDArray[np.float32], ...]) -> NDArray[np.float64]:
    """The operator (A p)_i = sum over faces of conductance * (p_i - p_neighbour) as a dense symmetric matrix.

    Args:
        conductance: by axis, padded, as the arrays of `Coefficients`.

    Returns:
        Over the cells in C order.
    """
    cells = tuple(n - 2 for n in conductance[0].shape)
    count = math.prod(cells)
    number = np.full(conductance[0].shape, -1)
    number[1:-1, 1:-1, 1:-1] = np.arange(count).reshape(cells)
    matrix = np.zeros((count, count))
    for axis, padded in enumerate(conductance):
        here, below = number.ravel(), np.roll(number, 1, axis).ravel()
        values = padded.ravel().astype(np.float64)
        for cell, other in ((here, below), (below, here)):
            exists = cell >= 0
            np.add.at(matrix, (cell[exists], cell[exists]), values[exists])
            both = exists & (other >= 0)
            np.subtract.at(matrix, (cell[both], other[both]), values[both])
    return matrix


@ti.data_oriented
class Coefficients:
    """Coefficients of the operator on all levels, for the obstacles as they are.

    Attributes:
        levels: the grids, finest first.
        conductance_x, conductance_y, conductance_z: open area over distance of each face, flat, float32, in units of
            the finest cell; 0 where closed, and 2 on an open side of the box, where pressure is 0 half a cell away,
            or less on the finest level where air comes in (`OpenSides`).
        inverse_diagonal: flat, float32; 0 in cells without an open face, `DIRICHLET_GHOST` beyond open sides.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        self.levels = plan_levels(obstacles.grid.cells)
        self._obstacles = obstacles
        self._lanes = lane_count()
        total = sum(level.size for level in self.levels)
        self.conductance_x, self.conductance_y, self.conductance_z, self.inverse_diagonal = (
            ti.field(ti.f32, shape=total) for _ in range(4)
        )
        distances = np.concatenate([each for level in self.levels for each in level.centre_distances])
        self._distance = ti.field(ti.f32, shape=len(distances))
        self._distance.from_numpy(distances.astype(np.float32))
        marks = [_marks_of_open_sides(obstacles.grid, level) for level in self.levels]
        self.inverse_diagonal.from_numpy(np.concatenate(marks))
        coarsest = self.levels[-1]
        self._coarsest_faces = ti.ndarray(ti.f32, 3 * coarsest.size)
        self.update()

    @property
    def fields(self) -> tuple[ti.Field, ti.Field, ti.Field]:
        """The conductances by axis."""
        return self.conductance_x, self.conductance_y, self.conductance_z

    def update(self) -> None:
        """Follow the obstacles."""
        for axis, field in enumerate(self.fields):
            self._open_faces(axis, field, *self.levels[0].cells, self.levels[0].distance_offsets[axis])
            for fine, coarse in pairwise(self.levels):
                self._coarsen(
                    axis,
                    field,
                    fine.offset,
                    *fine.cells,
                    fine.distance_offsets[axis],
                    coarse.offset,
                    *coarse.cells,
                    coarse.distance_offsets[axis],
                )
        for level in self.levels:
            self._invert_diagonal(level.offset, *level.cells)

    def coarsest_conductance(self) -> NDArray[np.float32]:
        """Conductances on the coarsest level by axis, (3, nx + 2, ny + 2, nz + 2)."""
        coarsest = self.levels[-1]
        self._copy_faces(coarsest.offset, coarsest.size, self._coarsest_faces)
        faces: NDArray[np.float32] = self._coarsest_faces.to_numpy().reshape(3, *coarsest.padded)
        return faces

    @ti.kernel
    def _open_faces(
        self, axis: ti.template(), conductance: ti.template(), nx: ti.i32, ny: ti.i32, nz: ti.i32, distances: ti.i32
    ):
        for i, j, lane in ti.ndrange((1, nx + 1 + (axis == 0)), (1, ny + 1 + (axis == 1)), self._lanes):
            step_x, step_y = (ny + 2) * (nz + 2), nz + 2
            step = ti.static(axis == 0) * step_x + ti.static(axis == 1) * step_y + ti.static(axis == 2)
            for n in range(lane_items(nz + (axis == 2), lane)):
                k = lane_place(n, lane)
                at = i * step_x + j * step_y + k
                distance = self._distance[distances + ti.Vector([i, j, k])[axis]]
                is_closed = self._obstacles.is_solid(at - step) or self._obstacles.is_solid(at)
                conductance[at] = ti.select(is_closed, 0.0, 1.0 / distance)

    @ti.kernel
    def _coarsen(
        self,
        axis: ti.template(),
        conductance: ti.template(),
        fine_offset: ti.i32,
        fine_nx: ti.i32,
        fine_ny: ti.i32,
        fine_nz: ti.i32,
        fine_distances: ti.i32,
        offset: ti.i32,
        nx: ti.i32,
        ny: ti.i32,
        nz: ti.i32,
        distances: ti.i32,
    ):
        """A coarse face takes the open area of its four fine ones; those beyond an odd end are ghosts, and closed."""
        for i, j, lane in ti.ndrange((1, nx + 1 + (axis == 0)), (1, ny + 1 + (axis == 1)), self._lanes):
            fine_step_x, fine_step_y = (fine_ny + 2) * (fine_nz + 2), fine_nz + 2
            for n in range(lane_items(nz + (axis == 2), lane)):
                k = lane_place(n, lane)
                fine_i, fine_j, fine_k = 2 * i - 1, 2 * j - 1, 2 * k - 1
                fine_face, face = 0, 0
                first, second = fine_step_x, fine_step_y
                if ti.static(axis == 0):
                    fine_i = ti.min(fine_i, fine_nx + 1)
                    fine_face, face = fine_i, i
                    first, second = fine_step_y, 1
                elif ti.static(axis == 1):
                    fine_j = ti.min(fine_j, fine_ny + 1)
                    fine_face, face = fine_j, j
                    first, second = fine_step_x, 1
                else:
                    fine_k = ti.min(fine_k, fine_nz + 1)
                    fine_face, face = fine_k, k
                child = fine_offset + fine_i * fine_step_x + fine_j * fine_step_y + fine_k
                total = conductance[child] + conductance[child + first]
                total += conductance[child + second] + conductance[child + first + second]
                area = self._distance[fine_distances + fine_face] * total
                at = offset + (i * (ny + 2) + j) * (nz + 2) + k
                conductance[at] = area / self._distance[distances + face]

    @ti.kernel
    def _invert_diagonal(self, offset: ti.i32, nx: ti.i32, ny: ti.i32, nz: ti.i32):
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            step_x, step_y = (ny + 2) * (nz + 2), nz + 2
            for n in range(lane_items(nz, lane)):
                k = lane_place(n, lane)
                self.invert_diagonal_at(offset + i * step_x + j * step_y + k, step_x, step_y)

    @ti.func
    def invert_diagonal_at(self, at: ti.i32, step_x: ti.i32, step_y: ti.i32):
        """Follow the conductances of a cell's faces; the steps lead to the next cell along x and y."""
        diagonal = self.conductance_x[at] + self.conductance_x[at + step_x]
        diagonal += self.conductance_y[at] + self.conductance_y[at + step_y]
        diagonal += self.conductance_z[at] + self.conductance_z[at + 1]
        self.inverse_diagonal[at] = ti.select(diagonal > 0.0, 1.0 / diagonal, 0.0)

    @ti.kernel
    def _copy_faces(self, offset: ti.i32, size: ti.i32, faces: Floats):
        for at in range(size):
            faces[at] = self.conductance_x[offset + at]
            faces[size + at] = self.conductance_y[offset + at]
            faces[2 * size + at] = self.conductance_z[offset + at]


def _marks_of_open_sides(grid: SmokeGrid, level: Level) -> NDArray[np.float32]:
    """`DIRICHLET_GHOST` in the ghosts beyond open sides, else 0; flat."""
    marks = np.zeros(level.padded, np.float32)
    for axis in range(3):
        for side in (0, 1):
            if grid.is_open(axis, side):
                np.moveaxis(marks, axis, 0)[-side] = DIRICHLET_GHOST
    return marks.ravel()
