"""Make a velocity field free of divergence: flexible conjugate gradients with a multigrid preconditioner.

With density 1 and the impulse q = p dt / h as unknown, the projected velocity is u - c (q_i - q_(i-1)) on a face of
conductance c, and A q = -h div u. The residual of that equation is then minus h times the divergence that is left, so
the solver stops by what is asked for: max|div u| h / max|u|.

Flexible conjugate gradients (Notay 2000) because the preconditioner is not symmetric. When the recursion has reached
its goal the velocity is corrected and its divergence measured anew; if rounding kept it above the goal, another solve
starts from there.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti

from sim.smoke.grid import SmokeGrid
from sim.smoke.multigrid import MultigridVCycle
from sim.smoke.reductions import RowReductions

SAFETY = 0.7
"""The recursion aims below the tolerance, as correcting the velocity adds rounding errors."""

BLOCK = 1024
"""Cells of a closed region that one thread adds up."""


@dataclass(frozen=True)
class ProjectionReport:
    """What one projection took.

    Attributes:
        iterations: applications of the preconditioner.
        residual: max|div u| h / max|u| that was reached; 0 at rest.
        divergence: max|div u| that was reached [1/s].
        converged: whether the tolerance was met.
    """

    iterations: int
    residual: float
    divergence: float
    converged: bool


@ti.data_oriented
class PressureProjection:
    """Projects face velocities onto the divergence-free ones, in place.

    Attributes:
        multigrid: the preconditioner; its coefficients say which faces are open.
        work_fields: six flat float32 fields of at least the grid's size, free between two projections.
    """

    def __init__(self, grid: SmokeGrid, velocity: tuple, *, tolerance: float, max_iterations: int) -> None:
        self._tolerance, self._max_iterations, self._cell_size = tolerance, max_iterations, grid.cell_size
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._size = grid.size
        self._u, self._v, self._w = velocity
        self.multigrid = MultigridVCycle(grid)
        self._correction = ti.field(ti.f32, shape=grid.size)
        self._search = ti.field(ti.f32, shape=grid.size)
        self._search_image = ti.field(ti.f32, shape=grid.size)
        self.work_fields = (
            self._correction,
            self._search,
            self._search_image,
            self.multigrid.right_hand_side,
            self.multigrid.solution,
            self.multigrid.spare,
        )
        self._rows = RowReductions(self._nx, self._ny)
        self._regions = grid.closed_regions
        blocks = max([1, *(-(-len(region) // BLOCK) for region in self._regions)])
        self._region_cells = ti.field(ti.i32, shape=max(1, sum(map(len, self._regions))))
        self._block_sums = ti.field(ti.f32, shape=blocks)
        if self._regions:
            self._region_cells.from_numpy(np.concatenate(self._regions))

    def project(self) -> ProjectionReport:
        """Remove the divergence of the velocity; closed faces must hold 0 before, and do after."""
        self._clear_work()
        divergence, speed = self._measure()
        iterations = 0
        while divergence > self._tolerance * speed and iterations < self._max_iterations:
            iterations += self._solve(SAFETY * self._tolerance * speed, self._max_iterations - iterations)
            self._subtract_gradient()
            divergence, speed = self._measure()
        return ProjectionReport(
            iterations=iterations,
            residual=divergence / speed if speed > 0.0 else 0.0,
            divergence=divergence / self._cell_size,
            converged=divergence <= self._tolerance * speed,
        )

    def _solve(self, goal: float, max_iterations: int) -> int:
        """Solve A q = r for the current residual until max|r| <= goal; returns the iterations it took."""
        self._remove_region_means()
        self.multigrid.apply()
        self._start_search()
        r_z, _ = self._dot_solution()
        for iteration in range(1, max_iterations + 1):
            self._apply_operator()
            p_Ap, _ = self._rows.sums()
            # Both vanish together once the residual does; written so that NaN ends the solve as well.
            if not (p_Ap > 0.0 and r_z > 0.0):
                return iteration
            alpha = r_z / p_Ap
            self._advance(alpha)
            residual, _ = self._rows.maxima()
            if residual <= goal:
                return iteration
            self.multigrid.apply()
            r_z_new, z_Ap = self._dot_solution()
            self._turn_search(-alpha * z_Ap / r_z)
            r_z = r_z_new
        return max_iterations

    def _measure(self) -> tuple[float, float]:
        """Set the residual to -h div u; returns its largest magnitude and the largest face velocity."""
        self._compute_residual()
        return self._rows.maxima()

    def _dot_solution(self) -> tuple[float, float]:
        self._compute_dots()
        return self._rows.sums()

    def _remove_region_means(self) -> None:
        """Take the mean off the residual of each closed region; it is rounding alone, as walls let nothing pass."""
        start = 0
        for region in self._regions:
            self._sum_blocks(start, len(region))
            blocks = -(-len(region) // BLOCK)
            mean = self._block_sums.to_numpy()[:blocks].sum(dtype=np.float64) / len(region)
            self._shift_region(start, len(region), mean)
            start += len(region)

    @ti.kernel
    def _clear_work(self):
        """Ghosts must hold 0, whatever others kept in these arrays."""
        for at in range(self._size):
            self._correction[at] = 0.0
            self._search[at] = 0.0
            self.multigrid.solution[at] = 0.0
            self.multigrid.spare[at] = 0.0
            self.multigrid.right_hand_side[at] = 0.0

    @ti.kernel
    def _compute_residual(self):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            largest = 0.0
            speed = 0.0
            for k in range(1, self._nz + 1):
                at = row + k
                u, v, w = self._u[at], self._v[at], self._w[at]
                u_next, v_next, w_next = self._u[at + self._step_x], self._v[at + self._step_y], self._w[at + 1]
                residual = (u - u_next) + (v - v_next) + (w - w_next)
                self.multigrid.right_hand_side[at] = residual
                largest = ti.max(largest, ti.abs(residual))
                lower = ti.max(ti.abs(u), ti.abs(v), ti.abs(w))
                upper = ti.max(ti.abs(u_next), ti.abs(v_next), ti.abs(w_next))
                speed = ti.max(speed, lower, upper)
            self._rows.row[i - 1, j - 1] = ti.Vector([largest, speed])

    @ti.kernel
    def _start_search(self):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 1):
                self._search[row + k] = self.multigrid.solution[row + k]
                self._correction[row + k] = 0.0

    @ti.kernel
    def _apply_operator(self):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            total = 0.0
            for k in range(1, self._nz + 1):
                image = self.multigrid.laplacian(self._search, row + k, self._step_x, self._step_y)
                self._search_image[row + k] = image
                total += image * self._search[row + k]
            self._rows.row[i - 1, j - 1] = ti.Vector([total, 0.0])

    @ti.kernel
    def _advance(self, alpha: ti.f32):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            largest = 0.0
            for k in range(1, self._nz + 1):
                at = row + k
                self._correction[at] += alpha * self._search[at]
                residual = self.multigrid.right_hand_side[at] - alpha * self._search_image[at]
                self.multigrid.right_hand_side[at] = residual
                largest = ti.max(largest, ti.abs(residual))
            self._rows.row[i - 1, j - 1] = ti.Vector([largest, 0.0])

    @ti.kernel
    def _compute_dots(self):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            z_r = 0.0
            z_Ap = 0.0
            for k in range(1, self._nz + 1):
                z = self.multigrid.solution[row + k]
                z_r += z * self.multigrid.right_hand_side[row + k]
                z_Ap += z * self._search_image[row + k]
            self._rows.row[i - 1, j - 1] = ti.Vector([z_r, z_Ap])

    @ti.kernel
    def _turn_search(self, beta: ti.f32):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 1):
                self._search[row + k] = self.multigrid.solution[row + k] + beta * self._search[row + k]

    @ti.kernel
    def _subtract_gradient(self):
        # The last planes of faces belong to ghost cells, whose pressure is 0 and whose other faces are closed.
        for i, j in ti.ndrange((1, self._nx + 2), (1, self._ny + 2)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 2):
                at = row + k
                here = self._correction[at]
                self._u[at] -= self.multigrid.conductance_x[at] * (here - self._correction[at - self._step_x])
                self._v[at] -= self.multigrid.conductance_y[at] * (here - self._correction[at - self._step_y])
                self._w[at] -= self.multigrid.conductance_z[at] * (here - self._correction[at - 1])

    @ti.kernel
    def _sum_blocks(self, start: ti.i32, count: ti.i32):
        for block in range((count + BLOCK - 1) // BLOCK):
            total = 0.0
            for n in range(block * BLOCK, ti.min((block + 1) * BLOCK, count)):
                total += self.multigrid.right_hand_side[self._region_cells[start + n]]
            self._block_sums[block] = total

    @ti.kernel
    def _shift_region(self, start: ti.i32, count: ti.i32, mean: ti.f32):
        for n in range(count):
            self.multigrid.right_hand_side[self._region_cells[start + n]] -= mean
