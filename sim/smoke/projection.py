"""Make a velocity field free of divergence: flexible conjugate gradients with a multigrid preconditioner.

With density 1 and the impulse q = p dt / h as unknown, the projected velocity is u - c (q_i - q_(i-1)) on a face of
conductance c, and A q = -h div u. The residual of that equation is then minus h times the divergence that is left, so
the solver stops by what is asked for: max|div u| h / max|u|.

Closed faces hold the velocity of the solid behind them, which drives the air: u.n = u_solid.n. A closed region has a
solution only if no volume flows into it in sum. What obstacles press into it all the same, as a piston does, is spread
evenly over its cells: the air there is compressed, or expands, at the same rate everywhere.

Flexible conjugate gradients (Notay 2000) because the preconditioner is not symmetric. When the recursion has reached
its goal the velocity is corrected and its divergence measured anew; if rounding kept it above the goal, another solve
starts from there.
"""

from dataclasses import dataclass

import taichi as ti

from sim.smoke.multigrid import MultigridVCycle
from sim.smoke.obstacles import Obstacles
from sim.smoke.reductions import RowReductions
from sim.smoke.regions import ClosedRegions

SAFETY = 0.7
"""The recursion aims below the tolerance, as correcting the velocity adds rounding errors."""


@dataclass(frozen=True)
class ProjectionReport:
    """What one projection took.

    Attributes:
        iterations: applications of the preconditioner.
        residual: max|div u - c| h / max|u| that was reached, with the compression c of each region; 0 at rest.
        divergence: max|div u - c| that was reached [1/s].
        compression: largest |c|, the rate at which obstacles change the volume of a closed region [1/s].
        converged: whether the tolerance was met.
    """

    iterations: int
    residual: float
    divergence: float
    compression: float
    converged: bool


@ti.data_oriented
class PressureProjection:
    """Projects face velocities onto the divergence-free ones, in place.

    Attributes:
        multigrid: the preconditioner; its coefficients say which faces are open.
        regions: the closed regions of air.
        work_fields: six flat float32 fields of at least the grid's size, free between two projections.
    """

    def __init__(self, obstacles: Obstacles, velocity: tuple, *, tolerance: float, max_iterations: int) -> None:
        grid = obstacles.grid
        self._tolerance, self._max_iterations, self._cell_size = tolerance, max_iterations, grid.cell_size
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._size = grid.size
        self._u, self._v, self._w = velocity
        self._obstacles = obstacles
        self.multigrid = MultigridVCycle(obstacles)
        self.regions = ClosedRegions(obstacles)
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

    def update(self) -> None:
        """Follow the obstacles."""
        self.multigrid.update()
        self.regions.find()

    def project(self) -> ProjectionReport:
        """Remove the divergence of the velocity; closed faces must hold that of their solids, and keep it."""
        self._clear_work()
        divergence, speed, compression = self._measure()
        iterations = 0
        while divergence > self._tolerance * speed and iterations < self._max_iterations:
            iterations += self._solve(SAFETY * self._tolerance * speed, self._max_iterations - iterations)
            self._subtract_gradient()
            divergence, speed, _ = self._measure()
        return ProjectionReport(
            iterations=iterations,
            residual=divergence / speed if speed > 0.0 else 0.0,
            divergence=divergence / self._cell_size,
            compression=compression / self._cell_size,
            converged=divergence <= self._tolerance * speed,
        )

    def _solve(self, goal: float, max_iterations: int) -> int:
        """Solve A q = r for the current residual until max|r| <= goal; returns the iterations it took."""
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

    def _measure(self) -> tuple[float, float, float]:
        """Set the residual to -h div u, less its mean in closed regions.

        Returns:
            Its largest magnitude, the largest face velocity, and the largest magnitude of a mean.
        """
        self._compute_residual()
        largest, speed = self._rows.maxima()
        mean = self.regions.subtract_means(self.multigrid.right_hand_side, largest)
        if mean > 0.0:
            self._find_largest_residual()
            largest, _ = self._rows.maxima()
        return largest, speed, mean

    def _dot_solution(self) -> tuple[float, float]:
        self._compute_dots()
        return self._rows.sums()

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
                if self._obstacles.is_solid(at):
                    residual = 0.0
                self.multigrid.right_hand_side[at] = residual
                largest = ti.max(largest, ti.abs(residual))
                lower = ti.max(ti.abs(u), ti.abs(v), ti.abs(w))
                upper = ti.max(ti.abs(u_next), ti.abs(v_next), ti.abs(w_next))
                speed = ti.max(speed, lower, upper)
            self._rows.row[i - 1, j - 1] = ti.Vector([largest, speed])

    @ti.kernel
    def _find_largest_residual(self):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            largest = 0.0
            for k in range(1, self._nz + 1):
                largest = ti.max(largest, ti.abs(self.multigrid.right_hand_side[row + k]))
            self._rows.row[i - 1, j - 1] = ti.Vector([largest, 0.0])

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
        open_x, open_y, open_z = ti.static(self.multigrid.coefficients.fields)
        # The last planes of faces belong to ghost cells, whose pressure is 0 and whose other faces are closed.
        for i, j in ti.ndrange((1, self._nx + 2), (1, self._ny + 2)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 2):
                at = row + k
                here = self._correction[at]
                self._u[at] -= open_x[at] * (here - self._correction[at - self._step_x])
                self._v[at] -= open_y[at] * (here - self._correction[at - self._step_y])
                self._w[at] -= open_z[at] * (here - self._correction[at - 1])
