"""A multigrid V-cycle for the pressure equation, as a preconditioner (McAdams, Sifakis & Teran 2010).

As in the paper, nothing is assembled: each level applies its stencil to arrays. Different from it: finite-volume
coefficients instead of cell types (see `multigrid_levels`), a polynomial smoother instead of damped Jacobi with extra
sweeps along the boundary, and cell-centred transfers: restriction adds up the children, prolongation is trilinear.
These are not each other's transpose, so the conjugate gradients around it must be the flexible ones.
"""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Integers
from sim.core.launch import fast_launch
from sim.core.scheduling import is_short
from sim.smoke.lanes import (
    RUN,
    has_runs,
    lane_count,
    lane_items,
    lane_place,
    lane_runs,
    new_run,
    rest_items,
    rest_place,
    run_start,
)
from sim.smoke.multigrid_levels import Coefficients, operator_matrix, plan_levels
from sim.smoke.obstacles import Obstacles

SMOOTHED_SPECTRUM = (0.4, 2.0)
"""Eigenvalues of D^-1 A that the smoother has to damp: 2 is the largest that a stencil of this kind has; modes below
1/3 to 1/2 are smooth enough for the coarse grid. The lower end was chosen by counting iterations."""

CELL_NS = 2.5
"""Work of one loop over a level a cell [ns], roughly."""


def chebyshev_weights(count: int, spectrum: tuple[float, float]) -> tuple[float, ...]:
    """Damping factors of `count` Jacobi sweeps whose error polynomial is smallest over a spectrum (Young 1954)."""
    low, high = spectrum
    centre, radius = 0.5 * (high + low), 0.5 * (high - low)
    return tuple(1.0 / (centre + radius * math.cos(math.pi * (n + 0.5) / count)) for n in range(count))


@ti.data_oriented
class MultigridVCycle:
    """One V-cycle: an approximate solution of A z = r, from z = 0.

    All levels of an array stand one after another in one flat field, so that each kernel is compiled once.

    Attributes:
        right_hand_side: r, flat, float32; its finest level is set by the caller, 0 in solid cells and ghosts.
        solution: z, flat, float32.
        spare: holds iterates and residuals in between.
        coefficients: of the operator on all levels.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        levels = plan_levels(obstacles.grid.cells)
        self._cells = [level.cells for level in levels]
        self._offsets = [level.offset for level in levels]
        total = sum(level.size for level in levels)
        self.right_hand_side = ti.field(ti.f32, shape=total)
        self.solution = ti.field(ti.f32, shape=total)
        self.spare = ti.field(ti.f32, shape=total)
        # From this one on by one thread; the coarsest always is, on a CPU.
        self._first_short = next(
            (n for n, level in enumerate(levels) if is_short(math.prod(level.cells), CELL_NS)), None
        )
        self._grids = ti.ndarray(ti.i32, 4 * len(levels))
        self._grids.from_numpy(np.array([(level.offset, *level.cells) for level in levels], np.int32).ravel())
        self._coarsest_count = math.prod(levels[-1].cells)
        self._coarsest_inverse = ti.field(ti.f32, shape=(self._coarsest_count, self._coarsest_count))
        self.coefficients = Coefficients(obstacles)
        self._coarsest_conductance = self.coefficients.coarsest_conductance()
        self._invert_coarsest()
        self._lanes, self._in_runs = lane_count(), has_runs(obstacles.grid.cells)
        self._first_weight, self._second_weight = chebyshev_weights(2, SMOOTHED_SPECTRUM)

    def update(self) -> None:
        """Follow the obstacles."""
        self.coefficients.update()
        conductance = self.coefficients.coarsest_conductance()
        if not np.array_equal(conductance, self._coarsest_conductance):
            self._coarsest_conductance = conductance
            self._invert_coarsest()

    def apply(self) -> None:
        """Set `solution` to the V-cycle's answer for `right_hand_side`."""
        last = len(self._cells) - 1
        short = self._first_short
        descents = list(zip(self._offsets, self._cells, self._offsets[1:], self._cells[1:], strict=False))[:short]
        weights = self._first_weight, self._second_weight
        for offset, cells, coarse_offset, coarse_cells in descents:
            self._descend(offset, *cells, coarse_offset, *coarse_cells, *weights)
        if short is None:
            _, coarsest_ny, coarsest_nz = self._cells[-1]
            self._solve_coarsest(self._offsets[-1], coarsest_ny, coarsest_nz)
        else:
            self._cycle_short(self._grids, short, last, *weights)
        for offset, cells, coarse_offset, coarse_cells in reversed(descents):
            self._ascend(offset, *cells, coarse_offset, *coarse_cells[1:], *weights)

    def _invert_coarsest(self) -> None:
        # The pseudo-inverse also serves regions without an open side, where A has the constants as its null space.
        matrix = operator_matrix(tuple(self._coarsest_conductance))
        inverse = np.linalg.pinv(matrix, rcond=1.0e-10, hermitian=True)
        self._coarsest_inverse.from_numpy(inverse.astype(np.float32))

    @ti.func
    def laplacian(self, x: ti.template(), at: ti.i32, step_x: ti.i32, step_y: ti.i32):
        """(A x) at a cell; the steps lead to the next cell along x and y."""
        here = x[at]
        return (
            self.coefficients.conductance_x[at] * (here - x[at - step_x])
            + self.coefficients.conductance_x[at + step_x] * (here - x[at + step_x])
            + self.coefficients.conductance_y[at] * (here - x[at - step_y])
            + self.coefficients.conductance_y[at + step_y] * (here - x[at + step_y])
            + self.coefficients.conductance_z[at] * (here - x[at - 1])
            + self.coefficients.conductance_z[at + 1] * (here - x[at + 1])
        )

    @ti.func
    def _laplacian_of_jacobi(self, at: ti.i32, step_x: ti.i32, step_y: ti.i32):
        """(A D^-1 r) at a cell."""
        here = self._jacobi(at)
        return (
            self.coefficients.conductance_x[at] * (here - self._jacobi(at - step_x))
            + self.coefficients.conductance_x[at + step_x] * (here - self._jacobi(at + step_x))
            + self.coefficients.conductance_y[at] * (here - self._jacobi(at - step_y))
            + self.coefficients.conductance_y[at + step_y] * (here - self._jacobi(at + step_y))
            + self.coefficients.conductance_z[at] * (here - self._jacobi(at - 1))
            + self.coefficients.conductance_z[at + 1] * (here - self._jacobi(at + 1))
        )

    @fast_launch
    @ti.kernel
    def _descend(
        self, offset: ti.i32, nx: ti.i32, ny: ti.i32, nz: ti.i32,
        coarse_offset: ti.i32, coarse_nx: ti.i32, coarse_ny: ti.i32, coarse_nz: ti.i32,
        first_weight: ti.f32, second_weight: ti.f32,
    ):  # fmt: skip
        """Smooth twice from zero, and leave the sum of the children's residuals to the coarser level."""
        step_x, step_y = (ny + 2) * (nz + 2), nz + 2
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            row = offset + i * step_x + j * step_y
            self._smooth_row_from_zero(row, nz, lane, step_x, step_y, first_weight, second_weight)
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            self._find_residual_of_row(offset + i * step_x + j * step_y, nz, lane, step_x, step_y)
        for i, j, lane in ti.ndrange((1, coarse_nx + 1), (1, coarse_ny + 1), self._lanes):
            row = coarse_offset + (i * (coarse_ny + 2) + j) * (coarse_nz + 2)
            fine_row = offset + (2 * i - 1) * step_x + (2 * j - 1) * step_y
            self._restrict_row(row, coarse_nz, lane, fine_row, step_x, step_y)

    @fast_launch
    @ti.kernel
    def _ascend(
        self, offset: ti.i32, nx: ti.i32, ny: ti.i32, nz: ti.i32,
        coarse_offset: ti.i32, coarse_ny: ti.i32, coarse_nz: ti.i32,
        first_weight: ti.f32, second_weight: ti.f32,
    ):  # fmt: skip
        """Add the coarser level's solution, interpolated between cell centres, and smooth twice."""
        step_x, step_y = (ny + 2) * (nz + 2), nz + 2
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            row = offset + i * step_x + j * step_y
            self._prolong_row(row, nz, lane, i, j, coarse_offset, coarse_ny, coarse_nz)
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            row = offset + i * step_x + j * step_y
            self._smooth_row(self.solution, self.spare, row, nz, lane, step_x, step_y, second_weight)
        for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), self._lanes):
            row = offset + i * step_x + j * step_y
            self._smooth_row(self.spare, self.solution, row, nz, lane, step_x, step_y, first_weight)

    @fast_launch
    @ti.kernel
    def _cycle_short(
        self, grids: Integers, first: ti.i32, last: ti.i32, first_weight: ti.f32, second_weight: ti.f32
    ):  # fmt: skip
        """The part of the cycle from one level to the last and back, by the thread that launches it.

        Args:
            grids: by level, where its arrays begin and its cells along x, y, z.
            first, last: the levels.
        """
        ti.loop_config(serialize=True)
        for _ in range(1):
            for level in range(first, last):
                offset, nx, ny, nz = self._grid(grids, level)
                step_x, step_y = (ny + 2) * (nz + 2), nz + 2
                for i in range(1, nx + 1):
                    for j in range(1, ny + 1):
                        row = offset + i * step_x + j * step_y
                        self._smooth_row_from_zero(row, nz, 0, step_x, step_y, first_weight, second_weight)
                for i in range(1, nx + 1):
                    for j in range(1, ny + 1):
                        self._find_residual_of_row(offset + i * step_x + j * step_y, nz, 0, step_x, step_y)
                coarse_offset, coarse_nx, coarse_ny, coarse_nz = self._grid(grids, level + 1)
                for i in range(1, coarse_nx + 1):
                    for j in range(1, coarse_ny + 1):
                        row = coarse_offset + (i * (coarse_ny + 2) + j) * (coarse_nz + 2)
                        fine_row = offset + (2 * i - 1) * step_x + (2 * j - 1) * step_y
                        self._restrict_row(row, coarse_nz, 0, fine_row, step_x, step_y)
            coarsest_offset, _coarsest_nx, coarsest_ny, coarsest_nz = self._grid(grids, last)
            for cell in range(self._coarsest_count):
                self._solve_coarsest_cell(cell, coarsest_offset, coarsest_ny, coarsest_nz)
            for finer in range(last - first):
                level = last - 1 - finer
                offset, nx, ny, nz = self._grid(grids, level)
                step_x, step_y = (ny + 2) * (nz + 2), nz + 2
                coarse_offset, coarse_nx, coarse_ny, coarse_nz = self._grid(grids, level + 1)
                for i in range(1, nx + 1):
                    for j in range(1, ny + 1):
                        row = offset + i * step_x + j * step_y
                        self._prolong_row(row, nz, 0, i, j, coarse_offset, coarse_ny, coarse_nz)
                for i in range(1, nx + 1):
                    for j in range(1, ny + 1):
                        row = offset + i * step_x + j * step_y
                        self._smooth_row(self.solution, self.spare, row, nz, 0, step_x, step_y, second_weight)
                for i in range(1, nx + 1):
                    for j in range(1, ny + 1):
                        row = offset + i * step_x + j * step_y
                        self._smooth_row(self.spare, self.solution, row, nz, 0, step_x, step_y, first_weight)

    @ti.func
    def _grid(self, grids: Integers, level: ti.i32):
        return grids[4 * level], grids[4 * level + 1], grids[4 * level + 2], grids[4 * level + 3]

    @ti.func
    def _smooth_row_from_zero(
        self, row: ti.i32, nz: ti.i32, lane: ti.i32, step_x: ti.i32, step_y: ti.i32, first_weight, second_weight
    ):
        if ti.static(self._in_runs):
            for run in range(lane_runs(nz)):
                first = row + run_start(run)
                values = new_run()
                for m in range(RUN):
                    values[m] = self._smoothed_from_zero(first + m, step_x, step_y, first_weight, second_weight)
                for m in range(RUN):
                    self.solution[first + m] = values[m]
        for n in range(rest_items(nz, lane, self._in_runs)):
            at = row + rest_place(nz, n, lane, self._in_runs)
            self.solution[at] = self._smoothed_from_zero(at, step_x, step_y, first_weight, second_weight)

    @ti.func
    def _smoothed_from_zero(self, at: ti.i32, step_x: ti.i32, step_y: ti.i32, first_weight, second_weight):
        # From zero the first sweep gives w r / D, which the second one finds where it needs it.
        residual = self.right_hand_side[at] - first_weight * self._laplacian_of_jacobi(at, step_x, step_y)
        change = second_weight * self.coefficients.inverse_diagonal[at] * residual
        return first_weight * self._jacobi(at) + change

    @ti.func
    def _find_residual_of_row(self, row: ti.i32, nz: ti.i32, lane: ti.i32, step_x: ti.i32, step_y: ti.i32):
        if ti.static(self._in_runs):
            for run in range(lane_runs(nz)):
                first = row + run_start(run)
                values = new_run()
                for m in range(RUN):
                    values[m] = self._residual(self.solution, first + m, step_x, step_y)
                for m in range(RUN):
                    self.spare[first + m] = values[m]
        for n in range(rest_items(nz, lane, self._in_runs)):
            at = row + rest_place(nz, n, lane, self._in_runs)
            self.spare[at] = self._residual(self.solution, at, step_x, step_y)

    @ti.func
    def _residual(self, x: ti.template(), at: ti.i32, step_x: ti.i32, step_y: ti.i32):
        return self.right_hand_side[at] - self.laplacian(x, at, step_x, step_y)

    @ti.func
    def _restrict_row(
        self, row: ti.i32, coarse_nz: ti.i32, lane: ti.i32, fine_row: ti.i32, step_x: ti.i32, step_y: ti.i32
    ):
        # Children beyond an odd end are ghosts, which hold 0 in `spare`.
        for n in range(lane_items(coarse_nz, lane)):
            k = lane_place(n, lane)
            child = fine_row + 2 * k - 1
            total = 0.0
            for di, dj, dk in ti.static(ti.ndrange(2, 2, 2)):
                total += self.spare[child + di * step_x + dj * step_y + dk]
            self.right_hand_side[row + k] = total

    @ti.func
    def _prolong_row(
        self, fine_row: ti.i32, nz: ti.i32, lane: ti.i32, fine_i: ti.i32, fine_j: ti.i32,
        coarse_offset: ti.i32, coarse_ny: ti.i32, coarse_nz: ti.i32,
    ):  # fmt: skip
        """Add to a row what lies above it on the coarser level."""
        i, j = (fine_i + 1) // 2, (fine_j + 1) // 2
        coarse_step_x, coarse_step_y = (coarse_ny + 2) * (coarse_nz + 2), coarse_nz + 2
        row = coarse_offset + i * coarse_step_x + j * coarse_step_y
        # An odd index is the lower child, whose neighbour lies below.
        beside_x = ti.select(fine_i % 2 == 1, -coarse_step_x, coarse_step_x)
        beside_y = ti.select(fine_j % 2 == 1, -coarse_step_y, coarse_step_y)
        # The upper child of the last cell beyond an odd end is a ghost, and stays 0: so that cell is none of a run.
        whole = nz // 2
        if ti.static(self._in_runs):
            for run in range(lane_runs(whole)):
                first = run_start(run)
                lower, upper = new_run(), new_run()
                for m in range(RUN):
                    lower[m], upper[m] = self._interpolated(row + first + m, beside_x, beside_y)
                child = fine_row + 2 * first - 1
                for m in range(RUN):
                    self.solution[child + 2 * m] += lower[m]
                    self.solution[child + 2 * m + 1] += upper[m]
        for n in range(rest_items(whole, lane, self._in_runs)):
            k = rest_place(whole, n, lane, self._in_runs)
            lower, upper = self._interpolated(row + k, beside_x, beside_y)
            child = fine_row + 2 * k - 1
            self.solution[child] += lower
            self.solution[child + 1] += upper
        if whole < coarse_nz and lane == 0:
            lower, _ = self._interpolated(row + coarse_nz, beside_x, beside_y)
            self.solution[fine_row + nz] += lower

    @ti.func
    def _interpolated(self, at: ti.i32, beside_x: ti.i32, beside_y: ti.i32):
        """What a coarse cell gives its lower and its upper child along z.

        Per axis 3/4 parent + 1/4 its neighbour. Where that is a wall or a solid it counts as equal to the parent (no
        flux), beyond an open side as its opposite (zero pressure on the face).
        """
        parent = self.solution[at]
        planes = ti.Vector([0.0, 0.0, 0.0])
        for dk in ti.static(range(3)):
            there = at + dk - 1
            planes[dk] = (
                9.0 * self._value_or_mirror(there, parent)
                + 3.0 * self._value_or_mirror(there + beside_x, parent)
                + 3.0 * self._value_or_mirror(there + beside_y, parent)
                + self._value_or_mirror(there + beside_x + beside_y, parent)
            ) / 16.0
        # Selected, not branched over, so that loops can be vectorized.
        is_air = self.coefficients.inverse_diagonal[at] > 0.0
        lower = ti.select(is_air, 0.75 * planes[1] + 0.25 * planes[0], 0.0)
        upper = ti.select(is_air, 0.75 * planes[1] + 0.25 * planes[2], 0.0)
        return lower, upper

    @ti.func
    def _smooth_row(
        self, x: ti.template(), improved: ti.template(), row: ti.i32, nz: ti.i32, lane: ti.i32, step_x: ti.i32,
        step_y: ti.i32, weight,
    ):  # fmt: skip
        if ti.static(self._in_runs):
            for run in range(lane_runs(nz)):
                first = row + run_start(run)
                values = new_run()
                for m in range(RUN):
                    values[m] = self._smoothed(x, first + m, step_x, step_y, weight)
                for m in range(RUN):
                    improved[first + m] = values[m]
        for n in range(rest_items(nz, lane, self._in_runs)):
            at = row + rest_place(nz, n, lane, self._in_runs)
            improved[at] = self._smoothed(x, at, step_x, step_y, weight)

    @ti.func
    def _smoothed(self, x: ti.template(), at: ti.i32, step_x: ti.i32, step_y: ti.i32, weight):
        return x[at] + weight * self.coefficients.inverse_diagonal[at] * self._residual(x, at, step_x, step_y)

    @ti.func
    def _jacobi(self, at: ti.i32):
        """r / D; 0 in ghosts, where r is 0."""
        return self.coefficients.inverse_diagonal[at] * self.right_hand_side[at]

    @ti.func
    def _value_or_mirror(self, at: ti.i32, parent: ti.f32):
        inverse = self.coefficients.inverse_diagonal[at]
        mirrored = ti.select(inverse < 0.0, -parent, parent)
        return ti.select(inverse > 0.0, self.solution[at], mirrored)

    @fast_launch
    @ti.kernel
    def _solve_coarsest(self, offset: ti.i32, ny: ti.i32, nz: ti.i32):
        for cell in range(self._coarsest_count):
            self._solve_coarsest_cell(cell, offset, ny, nz)

    @ti.func
    def _solve_coarsest_cell(self, cell: ti.i32, offset: ti.i32, ny: ti.i32, nz: ti.i32):
        total = 0.0
        for other in range(self._coarsest_count):
            i, j, k = other // (ny * nz), other // nz % ny, other % nz
            at = offset + ((i + 1) * (ny + 2) + j + 1) * (nz + 2) + k + 1
            total += self._coarsest_inverse[cell, other] * self.right_hand_side[at]
        i, j, k = cell // (ny * nz), cell // nz % ny, cell % nz
        self.solution[offset + ((i + 1) * (ny + 2) + j + 1) * (nz + 2) + k + 1] = total
