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

from sim.core.launch import fast_launch
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.multigrid import MultigridVCycle
from sim.smoke.obstacles import Obstacles
from sim.smoke.reductions import Pair, RowReductions
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
        reductions: what it reduces rows with.
    """

    def __init__(self, obstacles: Obstacles, velocity: tuple, *, tolerance: float, max_iterations: int) -> None:
        grid = obstacles.grid
        self._tolerance, self._max_iterations, self._cell_size = tolerance, max_iterations, grid.cell_size
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._size = grid.size
        self._u, self._v, self._w = velocity
        self._obstacles = obstacles
        # Before the multigrid, which uses its fields: what is made in between shares a group (`sim.core.runtime`).
        self._correction = ti.field(ti.f32, shape=grid.size)
        self._search = ti.field(ti.f32, shape=grid.size)
        self._search_image = ti.field(ti.f32, shape=grid.size)
        self._alpha, self._beta, self._r_z = (ti.field(ti.f32, shape=()) for _ in range(3))
        self._rows = RowReductions(self._nx, self._ny)
        self.multigrid = MultigridVCycle(obstacles)
        self.regions = ClosedRegions(obstacles)
        self.work_fields = (
            self._correction,
            self._search,
            self._search_image,
            self.multigrid.right_hand_side,
            self.multigrid.solution,
            self.multigrid.spare,
        )
        self._lanes = lane_count()
        self.reductions = [self._rows]

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
        """Solve A q = r for the current residual until max|r| <= goal; returns the iterations it took.

        The host waits once an iteration, for that norm; all other numbers stay on the device.
        """
        self.multigrid.apply()
        self._start_search()
        for iteration in range(1, max_iterations):
            residual, advanced = map(float, self._advance())
            if residual <= goal or advanced == 0.0:
                return iteration
            self.multigrid.apply()
            self._turn_search()
        self._advance()
        return max_iterations

    def _measure(self) -> tuple[float, float, float]:
        """Set the residual to -h div u, less its mean in closed regions.

        Returns:
            Its largest magnitude, the largest face velocity, and the largest magnitude of a mean.
        """
        largest, speed = map(float, self._compute_residual())
        mean = self.regions.subtract_means(self.multigrid.right_hand_side, largest)
        if mean > 0.0:
            largest = self._find_largest_residual()
        return largest, speed, mean

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
    def _compute_residual(self) -> Pair:
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            largest = 0.0
            speed = 0.0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
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
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([largest, speed])
        self._rows.find_maxima()
        return self._rows.result[None]

    @ti.kernel
    def _find_largest_residual(self) -> ti.f32:
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            largest = 0.0
            for n in range(lane_items(self._nz, lane)):
                largest = ti.max(largest, ti.abs(self.multigrid.right_hand_side[row + lane_place(n, lane)]))
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([largest, 0.0])
        self._rows.find_maxima()
        return self._rows.result[None][0]

    @ti.kernel
    def _start_search(self):
        """p = z, and r.z."""
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            r_z = 0.0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                z = self.multigrid.solution[at]
                self._search[at] = z
                self._correction[at] = 0.0
                r_z += z * self.multigrid.right_hand_side[at]
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([r_z, 0.0])
        self._rows.sum_up()
        self._r_z[None] = self._rows.result[None][0]

    @fast_launch
    @ti.kernel
    def _advance(self) -> Pair:
        """Go along p to the smallest error: alpha = r.z / p.Ap, q += alpha p, r -= alpha Ap.

        Returns:
            max|r|, and 1, or 0 where there was no way to go: p.Ap and r.z vanish together once the residual does.
        """
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            p_Ap = 0.0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                image = self.multigrid.laplacian(self._search, at, self._step_x, self._step_y)
                self._search_image[at] = image
                p_Ap += image * self._search[at]
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([p_Ap, 0.0])
        self._rows.sum_up()
        self._alpha[None] = 0.0
        # Written so that NaN ends the solve as well.
        if self._rows.result[None][0] > 0.0 and self._r_z[None] > 0.0:
            self._alpha[None] = self._r_z[None] / self._rows.result[None][0]
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            alpha = self._alpha[None]
            largest = 0.0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                self._correction[at] += alpha * self._search[at]
                residual = self.multigrid.right_hand_side[at] - alpha * self._search_image[at]
                self.multigrid.right_hand_side[at] = residual
                largest = ti.max(largest, ti.abs(residual))
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([largest, 0.0])
        self._rows.find_maxima()
        return Pair(self._rows.result[None][0], ti.select(self._alpha[None] > 0.0, 1.0, 0.0))

    @fast_launch
    @ti.kernel
    def _turn_search(self):
        """p = z + beta p with beta = -alpha z.Ap / r.z of the last direction, and the new r.z (Notay 2000)."""
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            r_z = 0.0
            z_Ap = 0.0
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                z = self.multigrid.solution[at]
                r_z += z * self.multigrid.right_hand_side[at]
                z_Ap += z * self._search_image[at]
            self._rows.partial[self._rows.place(i, j, lane)] = ti.Vector([r_z, z_Ap])
        self._rows.sum_up()
        self._beta[None] = -self._alpha[None] * self._rows.result[None][1] / self._r_z[None]
        self._r_z[None] = self._rows.result[None][0]
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            beta = self._beta[None]
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                self._search[at] = self.multigrid.solution[at] + beta * self._search[at]

    @ti.kernel
    def _subtract_gradient(self):
        open_x, open_y, open_z = ti.static(self.multigrid.coefficients.fields)
        # The last planes of faces belong to ghost cells, whose pressure is 0 and whose other faces are closed.
        for i, j, lane in ti.ndrange((1, self._nx + 2), (1, self._ny + 2), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz + 1, lane)):
                at = row + lane_place(n, lane)
                here = self._correction[at]
                self._u[at] -= open_x[at] * (here - self._correction[at - self._step_x])
                self._v[at] -= open_y[at] * (here - self._correction[at - self._step_y])
                self._w[at] -= open_z[at] * (here - self._correction[at - 1])
