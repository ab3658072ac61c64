"""The pressure equation on ever coarser grids, as coefficients.

Finite volumes on a rectilinear grid: the flux between two cells is (open area / distance of their centres) times the
difference of their pressures. A coarse cell is two fine ones along each axis, or one at the end of an odd axis, and its
faces add up the open area of the fine faces in them. So any size of grid works without padding, and small openings
stay open on coarse grids.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats
from sim.core.bundles import bundle, func
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.smoke.arrays import Faces, new_faces, new_floats
from sim.smoke.grid import Index3, SmokeGrid
from sim.smoke.lanes import Grid, cell_counts, device_grid, lane_items, lane_place, row_start, steps
from sim.smoke.obstacles import Obstacles, Solids, flux_part

COARSEST_CELLS = 64  # at most this many cells are solved directly, by a dense inverse
LARGEST_INDEX = 2**31 - 1  # flat indices in kernels are 32 bits wide
DIRICHLET_GHOST = -1.0  # mark in the ghosts of `inverse_diagonal`: beyond this side pressure changes sign


@dataclass(frozen=True)
class Level:
    """One of the grids; the arrays of all levels stand one after another in one flat array."""

    cells: Index3  # how many cells along x, y, z
    offset: int  # where its flat arrays, with ghosts, begin
    widths: tuple[NDArray[np.float64], ...]  # of its cells along each axis, in units of the finest cell
    distance_offsets: Index3  # by axis, where the distances of its centres across its faces begin

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

    It is over the cells in C order; conductances are by axis, padded, as the arrays of `Coefficients`.
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


@bundle
class Operator(NamedTuple):
    """Coefficients of the pressure equation on all levels, one after another."""

    faces: Faces  # conductance of each face
    inverse_diagonal: Floats


class Coefficients:
    """Coefficients of the operator on all levels, for the obstacles as they are.

    Attributes:
        levels: the grids, finest first.
        boxes: the same for kernels.
        operator: `faces` has open area over distance of each face, in units of the finest cell; 0 where closed, and 2
            on an open side of the box, where pressure is 0 half a cell away, or less on the finest level where air
            comes in (`sides`). `inverse_diagonal` is 0 in cells without an open face, `DIRICHLET_GHOST` beyond open
            sides.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        cells = obstacles.grid.cells
        self.levels = plan_levels(cells)
        self.boxes = [device_grid(level.cells, offset=level.offset) for level in self.levels]
        self._obstacles = obstacles
        total = sum(level.size for level in self.levels)
        self.operator = Operator(new_faces(total), new_floats(total))
        distances = np.concatenate([each for level in self.levels for each in level.centre_distances])
        self._distance = new_floats(len(distances))
        self._distance.from_numpy(distances.astype(np.float32))
        marks = [_marks_of_open_sides(obstacles.grid, level) for level in self.levels]
        self.operator.inverse_diagonal.from_numpy(np.concatenate(marks))
        self._coarsest_faces = new_floats(3 * self.levels[-1].size)
        self.update()

    def update(self) -> None:
        """Follow the obstacles."""
        begins = [level.distance_offsets for level in self.levels]
        for axis, faces in enumerate(self.operator.faces):
            sides = tuple(float(self._obstacles.grid.is_open(axis, side)) for side in (0, 1))
            _open_faces(axis, self.boxes[0], self._obstacles.solids, *sides, self._distance, begins[0][axis], faces)
            for (fine, fine_begins), (coarse, coarse_begins) in pairwise(zip(self.boxes, begins, strict=True)):
                _coarsen(axis, faces, self._distance, fine, fine_begins[axis], coarse, coarse_begins[axis])
        for box in self.boxes:
            _invert_diagonal(box, self.operator)

    def coarsest_conductance(self) -> NDArray[np.float32]:
        """Conductances on the coarsest level by axis, (3, nx + 2, ny + 2, nz + 2)."""
        coarsest = self.levels[-1]
        _copy_faces(self.operator.faces, coarsest.offset, coarsest.size, self._coarsest_faces)
        faces: NDArray[np.float32] = copied(self._coarsest_faces).reshape(3, *coarsest.padded)
        return faces


@func
def invert_diagonal_at(operator: Operator, at: ti.i32, step_x: ti.i32, step_y: ti.i32):
    """Follow the conductances of a cell's faces; the steps lead to the next cell along x and y."""
    diagonal = operator.faces.x[at] + operator.faces.x[at + step_x]
    diagonal += operator.faces.y[at] + operator.faces.y[at + step_y]
    diagonal += operator.faces.z[at] + operator.faces.z[at + 1]
    operator.inverse_diagonal[at] = ti.select(diagonal > 0.0, 1.0 / diagonal, 0.0)


@kernel
def _open_faces(
    axis: ti.template(),
    box: Grid,
    solids: Solids,
    low_side: ti.f32,
    high_side: ti.f32,
    distance: Floats,
    distance_begin: ti.i32,
    conductance: Floats,
):
    """Conductance of the faces across an axis; sides of the box are 1 if they are open, else 0."""
    extra_x, extra_y, extra_z = ti.static(int(axis == 0), int(axis == 1), int(axis == 2))
    for i, j, lane in ti.ndrange((1, box.nx + 1 + extra_x), (1, box.ny + 1 + extra_y), box.lanes):
        for n in range(lane_items(box, box.nz + extra_z, lane)):
            k = lane_place(box, n, lane)
            at, p = row_start(box, i, j) + k, ti.Vector([i, j, k])[axis]
            area = flux_part(solids, axis, at)
            area *= ti.select(p == 1, low_side, ti.select(p == cell_counts(box)[axis] + 1, high_side, 1.0))
            conductance[at] = area / distance[distance_begin + p]


@kernel
def _coarsen(
    axis: ti.template(),
    conductance: Floats,
    distance: Floats,
    fine: Grid,
    fine_begin: ti.i32,
    coarse: Grid,
    coarse_begin: ti.i32,
):
    """A coarse face takes the open area of its four fine ones; those beyond an odd end are ghosts, and closed."""
    extra_x, extra_y, extra_z = ti.static(int(axis == 0), int(axis == 1), int(axis == 2))
    for i, j, lane in ti.ndrange((1, coarse.nx + 1 + extra_x), (1, coarse.ny + 1 + extra_y), coarse.lanes):
        first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
        along, across = steps(fine)[first], steps(fine)[second]
        for n in range(lane_items(coarse, coarse.nz + extra_z, lane)):
            k = lane_place(coarse, n, lane)
            face = ti.Vector([i, j, k])
            fine_face = 2 * face - 1
            fine_face[axis] = ti.min(fine_face[axis], cell_counts(fine)[axis] + 1)
            child = row_start(fine, fine_face[0], fine_face[1]) + fine_face[2]
            total = conductance[child] + conductance[child + along]
            total += conductance[child + across] + conductance[child + along + across]
            area = distance[fine_begin + fine_face[axis]] * total
            conductance[row_start(coarse, i, j) + k] = area / distance[coarse_begin + face[axis]]


@kernel
def _invert_diagonal(box: Grid, operator: Operator):
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            invert_diagonal_at(operator, row_start(box, i, j) + lane_place(box, n, lane), box.step_x, box.step_y)


@kernel
def _copy_faces(conductance: Faces, offset: ti.i32, size: ti.i32, faces: Floats):
    for at in range(size):
        faces[at] = conductance.x[offset + at]
        faces[size + at] = conductance.y[offset + at]
        faces[2 * size + at] = conductance.z[offset + at]


def _marks_of_open_sides(grid: SmokeGrid, level: Level) -> NDArray[np.float32]:
    """`DIRICHLET_GHOST` in the ghosts beyond open sides, else 0; flat."""
    marks = np.zeros(level.padded, np.float32)
    for axis, side in grid.open_sides:
        np.moveaxis(marks, axis, 0)[-side] = DIRICHLET_GHOST
    return marks.ravel()
