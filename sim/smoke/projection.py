"""Make a velocity field free of divergence: flexible conjugate gradients with a multigrid preconditioner.

With density 1 and the impulse q = p dt / h as unknown, the projected velocity is u - c (q_i - q_(i-1)) on a face of
conductance c, and A q = -h div u. The residual of that equation is then minus h times the divergence that is left, so
the solver stops by what is asked for: max|div u| h / max|u|.

Where solids cut cells the open part A of a face counts, and with it its conductance; its velocity is that in the open
part (Batty, Bertails & Bridson 2007; Ng, Min & Gibou 2009). What moves with the velocity u_solid on the closed part
drives the air: the flux through a face is A u + (1 - A) u_solid. Gas that burns expands
(`sim.smoke.combustion`): there div u is what that asks for. A closed region has a solution only if no volume flows into
it in sum. What obstacles press into it all the same, as a piston does, is spread evenly over its air: it is
compressed, or expands, at the same rate everywhere. Rigid bodies that are free give way to the pressure within the
solve (`free_bodies`).

Flexible conjugate gradients (Notay 2000) because the preconditioner is not symmetric. When the recursion has reached
its goal the velocity is corrected and its divergence measured anew; if rounding kept it above the goal, another solve
starts from there.
"""

from dataclasses import dataclass
from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.smoke.arrays import Faces, new_floats
from sim.smoke.cut_cells import CHANGES, NEAR_SOLIDS
from sim.smoke.free_bodies import Carried, FreeBodies, flux_of_answer
from sim.smoke.lanes import Grid, clear_ghosts, fill_row, lane_items, lane_place, row_start
from sim.smoke.multigrid import Equation, MultigridVCycle, laplacian
from sim.smoke.obstacles import Obstacles, Solids, flux_part, mean_volume, wall_flux
from sim.smoke.reductions import Pair, Rows, find_maxima, new_rows, partial_place, sum_up, with_nodes_of_its_own
from sim.smoke.regions import ClosedRegions

SAFETY = 0.7  # the recursion aims below the tolerance, as correcting the velocity adds rounding errors


@dataclass(frozen=True)
class ProjectionReport:
    """What one projection took."""

    iterations: int  # applications of the preconditioner
    residual: float  # max|div u - c| h / max|u| that was reached, with the compression c of each region; 0 at rest
    divergence: float  # max|div u - c| that was reached [1/s]
    compression: float  # largest |c|, the rate at which obstacles change the volume of a closed region [1/s]
    converged: bool  # whether the tolerance was met


ALPHA, BETA, R_Z = range(3)  # numbers of the conjugate gradients that stay on the device


@bundle
class Search(NamedTuple):
    """Arrays of the conjugate gradients."""

    equation: Equation
    correction: Floats  # q
    direction: Floats  # p
    image: Floats  # A p
    numbers: Floats  # by ALPHA, BETA, R_Z
    rows: Rows
    largest: Rows  # of what is reduced second in a kernel: a result that was read once is not read again


class PressureProjection:
    """Projects face velocities onto the divergence-free ones, in place.

    Attributes:
        multigrid: the preconditioner; its coefficients say which faces are open.
        regions: the closed regions of air.
        work: six float32 arrays of at least the grid's size, free between two projections.
    """

    def __init__(
        self,
        obstacles: Obstacles,
        velocity: Faces,
        *,
        tolerance: float,
        max_iterations: int,
        expansion: ti.Ndarray | None = None,
        bodies: FreeBodies | None = None,
    ) -> None:
        """Take what is in the way, the velocity, the divergence that is to be left, times h [m/s], and free bodies."""
        self._bodies = FreeBodies(1) if bodies is None else bodies
        self._tolerance, self._max_iterations = tolerance, max_iterations
        self._cell_size = obstacles.grid.cell_size
        self._box, self._obstacles, self._velocity = obstacles.box, obstacles, velocity
        self._expands, self._expansion = expansion is not None, new_floats(1) if expansion is None else expansion
        self.multigrid = MultigridVCycle(obstacles)
        self.regions = ClosedRegions(obstacles)
        equation, size = self.multigrid.equation, obstacles.grid.size
        correction, direction, image = (new_floats(size) for _ in range(3))
        rows = new_rows(self._box)
        self._search = Search(equation, correction, direction, image, new_floats(3), rows, with_nodes_of_its_own(rows))
        self.work = (correction, direction, image, equation.right_hand_side, equation.solution, equation.spare)

    def update(self) -> None:
        """Follow the obstacles."""
        self.multigrid.update()
        self.regions.find()

    def project(self) -> ProjectionReport:
        """Remove the divergence of the velocity; what is closed to pressure keeps it."""
        self._clear_work()
        self._bodies.begin()
        divergence, speed, compression = self._measure()
        iterations = 0
        while divergence > self._tolerance * speed and iterations < self._max_iterations:
            iterations += self._solve(SAFETY * self._tolerance * speed, self._max_iterations - iterations)
            openness, solids = self.multigrid.coefficients.operator.faces, self._obstacles.solids
            if solids.carries:
                self._bodies.take(self._box, solids, self._search.correction)
            _subtract_gradient(self._box, self._search.correction, openness, solids, self._velocity)
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
        _start_search(self._box, self._search)
        for iteration in range(1, max_iterations):
            residual, advanced = self._advance()
            if residual <= goal or advanced == 0.0:
                return iteration
            self.multigrid.apply()
            _turn_search(self._box, self._search)
        self._advance()
        return max_iterations

    def _advance(self) -> tuple[float, float]:
        solids = self._obstacles.solids
        if solids.carries:
            self._bodies.answer(self._box, solids, self._search.direction)
        residual, advanced = _advance(self._box, solids, self._bodies.carried, self._search)
        return residual, advanced

    def _measure(self) -> tuple[float, float, float]:
        """Set the residual to h (expansion - div u), less its mean in closed regions.

        Returns:
            Its largest magnitude, the largest face velocity, and the largest magnitude of a mean.
        """
        given = self._box, self._obstacles.solids, self._velocity, self._expansion, self._expands, self._search
        largest, speed = _compute_residual(*given)
        mean = self.regions.subtract_means(self._search.equation.right_hand_side, largest)
        if mean > 0.0:
            largest = float(_find_largest_residual(self._box, self._search))
        return largest, speed, mean

    def _clear_work(self) -> None:
        """Ghosts must hold 0, whatever others kept in these arrays; those of coarser levels nobody else has."""
        equation, search = self._search.equation, self._search
        clear_ghosts(self._box, Faces(search.correction, search.direction, search.image))
        clear_ghosts(self._box, Faces(equation.right_hand_side, equation.solution, equation.spare))


@kernel
def _compute_residual(
    box: Grid, solids: Solids, velocity: Faces, expansion: Floats, expands: ti.template(), search: Search
) -> Pair:
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        largest = 0.0
        speed = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            u, v, w = velocity.x[at], velocity.y[at], velocity.z[at]
            u_next, v_next, w_next = velocity.x[at + box.step_x], velocity.y[at + box.step_y], velocity.z[at + 1]
            residual = (u - u_next) + (v - v_next) + (w - w_next)
            if ti.static(solids.cuts):
                residual = flux_part(solids, 0, at) * u - flux_part(solids, 0, at + box.step_x) * u_next
                residual += flux_part(solids, 1, at) * v - flux_part(solids, 1, at + box.step_y) * v_next
                residual += flux_part(solids, 2, at) * w - flux_part(solids, 2, at + 1) * w_next
            if ti.static(expands):
                residual += mean_volume(solids, at) * expansion[at]
            if ti.static(solids.moving):
                if (solids.words[at] & (NEAR_SOLIDS | CHANGES)) != 0:
                    residual += wall_flux(box, solids, at)
                    for component in ti.static((solids.velocity.x, solids.velocity.y, solids.velocity.z)):
                        speed = ti.max(speed, ti.abs(component[at]))
                if mean_volume(solids, at) == 0.0:
                    residual = 0.0
            search.equation.right_hand_side[at] = residual
            largest = ti.max(largest, ti.abs(residual))
            lower = ti.max(ti.abs(u), ti.abs(v), ti.abs(w))
            upper = ti.max(ti.abs(u_next), ti.abs(v_next), ti.abs(w_next))
            speed = ti.max(speed, lower, upper)
        search.rows.partial[partial_place(box, i, j, lane)] = ti.Vector([largest, speed])
    find_maxima(search.rows)
    return search.rows.nodes[0]


@kernel
def _find_largest_residual(box: Grid, search: Search) -> ti.f32:
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        largest = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            largest = ti.max(largest, ti.abs(search.equation.right_hand_side[at]))
        search.rows.partial[partial_place(box, i, j, lane)] = ti.Vector([largest, 0.0])
    find_maxima(search.rows)
    return search.rows.nodes[0][0]


@kernel
def _start_search(box: Grid, search: Search):
    """p = z, and r.z."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        r_z = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            z = search.equation.solution[at]
            search.direction[at] = z
            search.correction[at] = 0.0
            r_z += z * search.equation.right_hand_side[at]
        search.rows.partial[partial_place(box, i, j, lane)] = ti.Vector([r_z, 0.0])
    sum_up(search.rows)
    search.numbers[R_Z] = search.rows.nodes[0][0]


@kernel
def _advance(box: Grid, solids: Solids, carried: Carried, search: Search) -> Pair:
    """Go along p to the smallest error: alpha = r.z / p.Ap, q += alpha p, r -= alpha Ap.

    Bodies have answered to p.

    Returns:
        max|r|, and 1, or 0 where there was no way to go: p.Ap and r.z vanish together once the residual does.
    """
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        row = row_start(box, i, j)
        fill_row(box, search.image, row, box.nz, lane, _image, ti.static((row, box, search)))
        p_Ap = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row + lane_place(box, n, lane)
            if ti.static(solids.carries):
                search.image[at] -= flux_of_answer(box, solids, carried, i, j, lane_place(box, n, lane))
            p_Ap += search.image[at] * search.direction[at]
        search.rows.partial[partial_place(box, i, j, lane)] = ti.Vector([p_Ap, 0.0])
    sum_up(search.rows)
    search.numbers[ALPHA] = 0.0
    # Written so that NaN ends the solve as well.
    if search.rows.nodes[0][0] > 0.0 and search.numbers[R_Z] > 0.0:
        search.numbers[ALPHA] = search.numbers[R_Z] / search.rows.nodes[0][0]
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        row, alpha = row_start(box, i, j), search.numbers[ALPHA]
        given = ti.static((row, search.correction, alpha, search.direction))
        fill_row(box, search.correction, row, box.nz, lane, _plus, given)
        residual = ti.static(search.equation.right_hand_side)
        fill_row(box, residual, row, box.nz, lane, _plus, ti.static((row, residual, -alpha, search.image)))
        largest = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            largest = ti.max(largest, ti.abs(residual[row + lane_place(box, n, lane)]))
        search.largest.partial[partial_place(box, i, j, lane)] = ti.Vector([largest, 0.0])
    find_maxima(search.largest)
    return Pair(search.largest.nodes[0][0], ti.select(search.numbers[ALPHA] > 0.0, 1.0, 0.0))


@kernel
def _turn_search(box: Grid, search: Search):
    """p = z + beta p with beta = -alpha z.Ap / r.z of the last direction, and the new r.z (Notay 2000)."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        r_z = 0.0
        z_Ap = 0.0
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            z = search.equation.solution[at]
            r_z += z * search.equation.right_hand_side[at]
            z_Ap += z * search.image[at]
        search.rows.partial[partial_place(box, i, j, lane)] = ti.Vector([r_z, z_Ap])
    sum_up(search.rows)
    search.numbers[BETA] = -search.numbers[ALPHA] * search.rows.nodes[0][1] / search.numbers[R_Z]
    search.numbers[R_Z] = search.rows.nodes[0][0]
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        row = row_start(box, i, j)
        given = ti.static((row, search.equation.solution, search.numbers[BETA], search.direction))
        fill_row(box, search.direction, row, box.nz, lane, _plus, given)


@func
def _image(k: ti.i32, row: ti.i32, box: Grid, search: Search):
    return laplacian(search.equation.operator, search.direction, row + k, box.step_x, box.step_y)


@func
def _plus(k: ti.i32, row: ti.i32, first: Floats, factor: ti.f32, second: Floats):
    return first[row + k] + factor * second[row + k]


@kernel
def _subtract_gradient(box: Grid, correction: Floats, openness: Faces, solids: Solids, velocity: Faces):
    # The last planes of faces belong to ghost cells, whose pressure is 0 and whose other faces are closed.
    for i, j, lane in ti.ndrange((1, box.nx + 2), (1, box.ny + 2), box.lanes):
        row = row_start(box, i, j)
        for axis, face, is_open, step in ti.static(
            (
                (0, velocity.x, openness.x, box.step_x),
                (1, velocity.y, openness.y, box.step_y),
                (2, velocity.z, openness.z, 1),
            )
        ):
            given = ti.static((row, axis, face, is_open, solids, step, correction))
            fill_row(box, face, row, box.nz + 1, lane, _less_gradient, given)


@func
def _less_gradient(
    k: ti.i32,
    row: ti.i32,
    axis: ti.template(),
    face: Floats,
    openness: Floats,
    solids: Solids,
    step: ti.i32,
    correction: Floats,
):
    at = row + k
    per_distance = openness[at]
    if ti.static(solids.cuts):
        # Closed faces have a conductance of 0 to be divided by anything.
        per_distance /= ti.max(flux_part(solids, axis, at), 1.0e-30)
    return face[at] - per_distance * (correction[at] - correction[at - step])
