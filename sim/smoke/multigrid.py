"""A multigrid V-cycle for the pressure equation, as a preconditioner (McAdams, Sifakis & Teran 2010).

As in the paper, nothing is assembled: each level applies its stencil to arrays. Different from it: finite-volume
coefficients instead of cell types (see `multigrid_levels`), a polynomial smoother instead of damped Jacobi with extra
sweeps along the boundary, and cell-centred transfers: restriction adds up the children, prolongation is trilinear.
These are not each other's transpose, so the conjugate gradients around it must be the flexible ones.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import bundle, func
from sim.core.host_access import put
from sim.core.launch import kernel
from sim.smoke.arrays import new_floats
from sim.smoke.lanes import (
    RUN,
    Grid,
    fill_row,
    lane_items,
    lane_place,
    new_run,
    rest_items,
    rest_place,
    row_start,
)
from sim.smoke.multigrid_levels import Coefficients, Operator, operator_matrix
from sim.smoke.obstacles import Obstacles

SMOOTHED_SPECTRUM = (0.4, 2.0)
"""Eigenvalues of D^-1 A that the smoother has to damp: 2 is the largest that a stencil of this kind has; modes below
1/3 to 1/2 are smooth enough for the coarse grid. The lower end was chosen by counting iterations."""

FEW_CELLS = 4096  # of a level that one thread of a CPU has done before the host has launched a loop for all


def chebyshev_weights(count: int, spectrum: tuple[float, float]) -> tuple[float, ...]:
    """Damping factors of `count` Jacobi sweeps whose error polynomial is smallest over a spectrum (Young 1954)."""
    low, high = spectrum
    centre, radius = 0.5 * (high + low), 0.5 * (high - low)
    return tuple(1.0 / (centre + radius * math.cos(math.pi * (n + 0.5) / count)) for n in range(count))


@bundle
class Equation(NamedTuple):
    """A z = r on all levels, one after another in flat arrays; r and z are 0 in ghosts."""

    operator: Operator  # A
    right_hand_side: Floats  # r
    solution: Floats  # z
    spare: Floats  # holds iterates and residuals in between
    coarsest_inverse: Floats  # of the coarsest level, row by row
    coarsest_count: ti.i32  # its cells
    first_weight: ti.f32  # of the smoother's sweeps
    second_weight: ti.f32


class MultigridVCycle:
    """One V-cycle: an approximate solution of A z = r, from z = 0.

    Attributes:
        equation: r of its finest level is set by the caller, 0 in solid cells and ghosts.
        coefficients: of the operator on all levels.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        self.coefficients = Coefficients(obstacles)
        levels = self.coefficients.levels
        total = sum(level.size for level in levels)
        # From the first small one on by one thread; the coarsest always is, on a CPU.
        self._large = sum(math.prod(level.cells) > FEW_CELLS for level in levels)
        self._grids = ti.ndarray(ti.i32, 4 * len(levels))
        self._grids.from_numpy(np.array([(level.offset, *level.cells) for level in levels], np.int32).ravel())
        coarsest_count = math.prod(levels[-1].cells)
        self.equation = Equation(
            self.coefficients.operator,
            *(new_floats(total) for _ in range(3)),
            new_floats(coarsest_count**2),
            coarsest_count,
            *chebyshev_weights(2, SMOOTHED_SPECTRUM),
        )
        self._coarsest_conductance = self.coefficients.coarsest_conductance()
        self._invert_coarsest()

    def update(self) -> None:
        """Follow the obstacles."""
        self.coefficients.update()
        conductance = self.coefficients.coarsest_conductance()
        if not np.array_equal(conductance, self._coarsest_conductance):
            self._coarsest_conductance = conductance
            self._invert_coarsest()

    def apply(self) -> None:
        """Set the solution to the V-cycle's answer for the right-hand side."""
        boxes = self.coefficients.boxes
        if boxes[0].lanes > 1:
            _cycle(self.equation, self._grids, len(boxes), boxes[0].lanes)
            return
        descents = list(pairwise(boxes))[: self._large]
        for fine, coarse in descents:
            _descend(self.equation, fine, coarse)
        _cycle_short(self.equation, self._grids, len(descents), len(boxes) - 1)
        for fine, coarse in reversed(descents):
            _ascend(self.equation, fine, coarse)

    def _invert_coarsest(self) -> None:
        # The pseudo-inverse also serves regions without an open side, where A has the constants as its null space.
        matrix = operator_matrix(tuple(self._coarsest_conductance))
        inverse = np.linalg.pinv(matrix, rcond=1.0e-10, hermitian=True)
        put(self.equation.coarsest_inverse, inverse.ravel())


@kernel
def _descend(eq: Equation, fine: Grid, coarse: Grid):
    _descend_one(eq, fine, coarse)


@kernel
def _ascend(eq: Equation, fine: Grid, coarse: Grid):
    _ascend_one(eq, fine, coarse)


@kernel
def _cycle(eq: Equation, grids: Integers, levels: ti.template(), lanes: ti.template()):
    """The whole cycle as one launch: on a GPU a launch takes longer than the loops of a coarse level."""
    for level in ti.static(range(levels - 1)):
        fine, coarse = ti.static(_level(grids, level, lanes), _level(grids, level + 1, lanes))
        _descend_one(eq, fine, coarse)
    coarsest = ti.static(_level(grids, levels - 1, lanes))
    for cell in range(eq.coarsest_count):
        _solve_coarsest_cell(eq, coarsest, cell)
    for level in ti.static(range(levels - 2, -1, -1)):
        fine, coarse = ti.static(_level(grids, level, lanes), _level(grids, level + 1, lanes))
        _ascend_one(eq, fine, coarse)


@kernel
def _cycle_short(eq: Equation, grids: Integers, first: ti.i32, last: ti.i32):
    """The part of the cycle from one level to the last and back, by the thread that launches it.

    Grids have by level where its arrays begin, and its cells along x, y, z.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        for level in range(first, last):
            fine, coarse = ti.static(_level(grids, level, 1), _level(grids, level + 1, 1))
            _descend_one(eq, fine, coarse)
        coarsest = ti.static(_level(grids, last, 1))
        for cell in range(eq.coarsest_count):
            _solve_coarsest_cell(eq, coarsest, cell)
        for finer in range(last - first):
            fine, coarse = ti.static(_level(grids, last - 1 - finer, 1), _level(grids, last - finer, 1))
            _ascend_one(eq, fine, coarse)


def _level(grids: Any, level: Any, lanes: int) -> Grid:
    """A level in a kernel, whose numbers are not known before."""
    offset, nx, ny, nz = _grid(grids, level)
    return Grid(offset, nx, ny, nz, (ny + 2) * (nz + 2), nz + 2, lanes)


@func
def _grid(grids: Integers, level: ti.i32):
    return grids[4 * level], grids[4 * level + 1], grids[4 * level + 2], grids[4 * level + 3]


@func
def _descend_one(eq: Equation, fine: Grid, coarse: Grid):
    """Smooth twice from zero, and leave the sum of the children's residuals to the coarser level."""
    for i, j, lane in ti.ndrange((1, fine.nx + 1), (1, fine.ny + 1), fine.lanes):
        row = row_start(fine, i, j)
        fill_row(fine, eq.solution, row, fine.nz, lane, _smoothed_from_zero, ti.static((row, eq, fine)))
    for i, j, lane in ti.ndrange((1, fine.nx + 1), (1, fine.ny + 1), fine.lanes):
        row = row_start(fine, i, j)
        fill_row(fine, eq.spare, row, fine.nz, lane, _residual, ti.static((row, eq, eq.solution, fine)))
    for i, j, lane in ti.ndrange((1, coarse.nx + 1), (1, coarse.ny + 1), coarse.lanes):
        # Children beyond an odd end are ghosts, which hold 0 in `spare`.
        for n in range(lane_items(coarse, coarse.nz, lane)):
            k = lane_place(coarse, n, lane)
            child = row_start(fine, 2 * i - 1, 2 * j - 1) + 2 * k - 1
            total = 0.0
            for di, dj, dk in ti.static(ti.ndrange(2, 2, 2)):
                total += eq.spare[child + di * fine.step_x + dj * fine.step_y + dk]
            eq.right_hand_side[row_start(coarse, i, j) + k] = total


@func
def _ascend_one(eq: Equation, fine: Grid, coarse: Grid):
    """Add the coarser level's solution, interpolated between cell centres, and smooth twice."""
    for i, j, lane in ti.ndrange((1, fine.nx + 1), (1, fine.ny + 1), fine.lanes):
        _prolong_row(eq, fine, coarse, i, j, lane)
    for i, j, lane in ti.ndrange((1, fine.nx + 1), (1, fine.ny + 1), fine.lanes):
        row = row_start(fine, i, j)
        given = ti.static((row, eq, eq.solution, fine, eq.second_weight))
        fill_row(fine, eq.spare, row, fine.nz, lane, _smoothed, given)
    for i, j, lane in ti.ndrange((1, fine.nx + 1), (1, fine.ny + 1), fine.lanes):
        row = row_start(fine, i, j)
        given = ti.static((row, eq, eq.spare, fine, eq.first_weight))
        fill_row(fine, eq.solution, row, fine.nz, lane, _smoothed, given)


@func
def laplacian(operator: Operator, x: Floats, at: ti.i32, step_x: ti.i32, step_y: ti.i32):
    """(A x) at a cell; the steps lead to the next cell along x and y."""
    here = x[at]
    return (
        operator.faces.x[at] * (here - x[at - step_x])
        + operator.faces.x[at + step_x] * (here - x[at + step_x])
        + operator.faces.y[at] * (here - x[at - step_y])
        + operator.faces.y[at + step_y] * (here - x[at + step_y])
        + operator.faces.z[at] * (here - x[at - 1])
        + operator.faces.z[at + 1] * (here - x[at + 1])
    )


@func
def _smoothed_from_zero(k: ti.i32, row: ti.i32, eq: Equation, box: Grid):
    # From zero the first sweep gives w r / D, which the second one finds where it needs it.
    at = row + k
    here = _jacobi(eq, at)
    image = (
        eq.operator.faces.x[at] * (here - _jacobi(eq, at - box.step_x))
        + eq.operator.faces.x[at + box.step_x] * (here - _jacobi(eq, at + box.step_x))
        + eq.operator.faces.y[at] * (here - _jacobi(eq, at - box.step_y))
        + eq.operator.faces.y[at + box.step_y] * (here - _jacobi(eq, at + box.step_y))
        + eq.operator.faces.z[at] * (here - _jacobi(eq, at - 1))
        + eq.operator.faces.z[at + 1] * (here - _jacobi(eq, at + 1))
    )
    residual = eq.right_hand_side[at] - eq.first_weight * image
    change = eq.second_weight * eq.operator.inverse_diagonal[at] * residual
    return eq.first_weight * here + change


@func
def _jacobi(eq: Equation, at: ti.i32):
    """r / D; 0 in ghosts, where r is 0."""
    return eq.operator.inverse_diagonal[at] * eq.right_hand_side[at]


@func
def _smoothed(k: ti.i32, row: ti.i32, eq: Equation, x: Floats, box: Grid, weight: ti.f32):
    return x[row + k] + weight * eq.operator.inverse_diagonal[row + k] * _residual(k, row, eq, x, box)


@func
def _residual(k: ti.i32, row: ti.i32, eq: Equation, x: Floats, box: Grid):
    return eq.right_hand_side[row + k] - laplacian(eq.operator, x, row + k, box.step_x, box.step_y)


@func
def _prolong_row(eq: Equation, fine: Grid, coarse: Grid, fine_i: ti.i32, fine_j: ti.i32, lane: ti.i32):
    """Add to a row what lies above it on the coarser level."""
    row, fine_row = row_start(coarse, (fine_i + 1) // 2, (fine_j + 1) // 2), row_start(fine, fine_i, fine_j)
    # An odd index is the lower child, whose neighbour lies below.
    beside_x = ti.select(fine_i % 2 == 1, -coarse.step_x, coarse.step_x)
    beside_y = ti.select(fine_j % 2 == 1, -coarse.step_y, coarse.step_y)
    # The upper child of the last cell beyond an odd end is a ghost, and stays 0: so that cell is none of a run.
    whole = fine.nz // 2
    if ti.static(fine.lanes == 1):
        for run in range(whole // RUN):
            first = run * RUN + 1
            lower, upper = new_run(), new_run()
            for m in range(RUN):
                lower[m], upper[m] = _interpolated(eq, row + first + m, beside_x, beside_y)
            child = fine_row + 2 * first - 1
            for m in range(RUN):
                eq.solution[child + 2 * m] += lower[m]
                eq.solution[child + 2 * m + 1] += upper[m]
    for n in range(rest_items(fine, whole, lane)):
        k = rest_place(fine, whole, n, lane)
        lower, upper = _interpolated(eq, row + k, beside_x, beside_y)
        child = fine_row + 2 * k - 1
        eq.solution[child] += lower
        eq.solution[child + 1] += upper
    if whole < coarse.nz and lane == 0:
        lower, _ = _interpolated(eq, row + coarse.nz, beside_x, beside_y)
        eq.solution[fine_row + fine.nz] += lower


@func
def _interpolated(eq: Equation, at: ti.i32, beside_x: ti.i32, beside_y: ti.i32):
    """What a coarse cell gives its lower and its upper child along z.

    Per axis 3/4 parent + 1/4 its neighbour. Where that is a wall or a solid it counts as equal to the parent (no
    flux), beyond an open side as its opposite (zero pressure on the face).
    """
    parent = eq.solution[at]
    planes = ti.Vector([0.0, 0.0, 0.0])
    for dk in ti.static(range(3)):
        there = at + dk - 1
        planes[dk] = (
            9.0 * _value_or_mirror(eq, there, parent)
            + 3.0 * _value_or_mirror(eq, there + beside_x, parent)
            + 3.0 * _value_or_mirror(eq, there + beside_y, parent)
            + _value_or_mirror(eq, there + beside_x + beside_y, parent)
        ) / 16.0
    # Selected, not branched over, so that loops can be vectorized.
    is_air = eq.operator.inverse_diagonal[at] > 0.0
    lower = ti.select(is_air, 0.75 * planes[1] + 0.25 * planes[0], 0.0)
    upper = ti.select(is_air, 0.75 * planes[1] + 0.25 * planes[2], 0.0)
    return lower, upper


@func
def _value_or_mirror(eq: Equation, at: ti.i32, parent: ti.f32):
    inverse = eq.operator.inverse_diagonal[at]
    mirrored = ti.select(inverse < 0.0, -parent, parent)
    return ti.select(inverse > 0.0, eq.solution[at], mirrored)


@func
def _solve_coarsest_cell(eq: Equation, box: Grid, cell: ti.i32):
    total = 0.0
    for other in range(eq.coarsest_count):
        at = _coarsest_place(box, other)
        total += eq.coarsest_inverse[cell * eq.coarsest_count + other] * eq.right_hand_side[at]
    eq.solution[_coarsest_place(box, cell)] = total


@func
def _coarsest_place(box: Grid, cell: ti.i32):
    """Flat index of a cell, numbered in C order."""
    return row_start(box, cell // (box.ny * box.nz) + 1, cell // box.nz % box.ny + 1) + cell % box.nz + 1
