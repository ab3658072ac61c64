"""The reaction of a particle fluid on the bodies and sheets that move in it."""

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Vectors
from sim.cells import CellGrid, Cells, SortedPoints, cell_of_point, row_of_cell
from sim.fluid.body_response import BodyResponse, weigh_errors
from sim.fluid.boundary import Boundary
from sim.fluid.boundary_kernels import STATE_WIDTH, WRENCH_WIDTH
from sim.fluid.kernels import TINY_DISTANCE, spline_slope
from sim.fluid.sheet_forces import SheetForces
from sim.fluid.viscosity import LAPLACIAN_FACTOR, viscous_factor
from sim.launch import fast_launch
from sim.neighbor_kernels import ROUNDING_MARGIN

CHUNK = 64
"""Samples of a body that one node of the sum takes together."""

GROWTH = 1.25


class BodyForces:
    """Forces and torques of the fluid on each moving body, and their impulses in a step.

    The force on sample b is the opposite of what b does to its particles, pair by pair (Akinci et al. 2012, eq. 10):

        f_b = sum_i V V_b (P_i - mu_ib) grad_i W_ib,     F = sum_b f_b,     M = sum_b (x_b - x_com) x f_b

    with the wall friction mu_ib of the fluid's own sum. Pair forces point along x_i - x_b, so that fluid and bodies
    together keep their linear and their angular momentum to rounding.

    Every sample gathers over a list of its particles in the order of the sorted particles, and the samples of a body
    are summed in a tree of fixed shape: the same bits whatever the number of threads.

    Attributes:
        response: lets the bodies' samples answer to forces within the step; None where they wait for its end.
        sheets: takes the forces on the samples of sheets; None where there are none.
    """

    def __init__(self, boundary: Boundary, grid: CellGrid, search_radius: float) -> None:
        """Prepare the sums.

        Args:
            boundary: holds the samples of the bodies.
            grid: cells that the particles are sorted by.
            search_radius: of the list; reaches the neighbour list's skin beyond the support [m].
        """
        self._boundary, self._grid, self._search_radius = boundary, grid, search_radius
        samples, bodies = max(boundary.moving_count, 1), max(boundary.body_count, 1)
        chunks = [
            np.arange(first, last, CHUNK)
            for first, last in zip(boundary.body_start[:-1], boundary.body_start[1:], strict=True)
        ]
        chunk_of_body = np.concatenate([[0], np.cumsum([len(each) for each in chunks])]).astype(np.int32)
        self._chunk_count = int(chunk_of_body[-1])
        starts = np.concatenate([*chunks, [boundary.body_sample_count]]).astype(np.int32)
        self._chunk_start = _integers(starts)
        self._chunk_of_body = _integers(chunk_of_body)
        self._near_start = ti.ndarray(ti.i32, samples + 1)
        self._near_count = ti.ndarray(ti.i32, samples)
        self._near = ti.ndarray(ti.i32, 1)
        self._force = ti.Vector.ndarray(3, ti.f32, samples)
        self._partial = ti.ndarray(ti.f32, max(self._chunk_count, 1) * WRENCH_WIDTH)
        self._wrench = ti.ndarray(ti.f32, bodies * WRENCH_WIDTH)
        self._impulse: NDArray[np.float64] = np.zeros((boundary.body_count, WRENCH_WIDTH))
        self.response: BodyResponse | None = None
        self.sheets: SheetForces | None = None

    @property
    def answer(self) -> bool:
        """Whether any moving samples answer to forces within the step."""
        return (self.response is not None and self.response.is_needed) or (
            self.sheets is not None and self.sheets.answers
        )

    @property
    def near(self) -> tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray]:
        """Particles near each moving sample, `count[b]` entries from `start[b]` on: start, count, list."""
        return self._near_start, self._near_count, self._near

    def find_particles(self, points: SortedPoints) -> None:
        """List the particles near each sample; particles and samples are where they are at a neighbour search."""
        boundary, grid = self._boundary, self._grid
        if boundary.moving_count == 0:
            return
        search = (
            boundary.position, boundary.fixed_count, boundary.moving_count, *points.coordinates, points.cell_start,
            ti.math.vec3(*grid.origin), 1.0 / grid.cell_size, Cells(*grid.shape), grid.reach, self._search_radius**2,
            self._near_count,
        )  # fmt: skip
        count_particles_near_samples(*search)
        starts = np.zeros(boundary.moving_count + 1, dtype=np.int32)
        np.cumsum(self._near_count.to_numpy(), out=starts[1:])
        self._near_start.from_numpy(starts)
        if starts[-1] > self._near.shape[0]:
            self._near = ti.ndarray(ti.i32, int(starts[-1] * GROWTH))
        list_particles_near_samples(*search, self._near_start, self._near)

    def let_bodies_respond(self, gravity: tuple[float, float, float], spacing: float) -> None:
        """From now on the bodies' samples, if there are any, answer to forces within the step.

        Args:
            gravity: [m/s²].
            spacing: of the particles [m].
        """
        if self._boundary.moving_count > 0 and self.response is None:
            self.response = BodyResponse(self._boundary, gravity, spacing)

    def gather(self, *terms: Any, dt: float, sample_velocity: ti.Ndarray | None = None) -> None:
        """Add the impulses of a step, from forces that the fluid has just felt.

        Args:
            terms: what `gather_sample_forces` takes of the fluid, from `position` on.
            dt: the step [s].
            sample_velocity: of the boundary samples, as the fluid felt them [m/s]; their present ones if omitted.
        """
        if self._boundary.moving_count == 0:
            return
        self._gather(self._boundary.velocity if sample_velocity is None else sample_velocity, terms)
        if self._boundary.body_count:
            self._impulse += dt * self._host_wrenches()
        if self.response is not None:
            self.response.push_samples(self._wrench, dt)
        if self.sheets is not None:
            self.sheets.count_forces(self._force, dt)

    def respond(self, *terms: Any) -> ti.Ndarray:
        """Acceleration of each boundary sample by forces that are only tried [m/s²]; their impulses do not count.

        Args:
            terms: as for `gather`.
        """
        assert self.response is not None
        self._gather(self._boundary.velocity, terms)
        acceleration = self.response.accelerate_samples(self._wrench)
        if self.sheets is not None and self.sheets.answers:
            self.sheets.accelerate(self._force, acceleration)
        return acceleration

    def measure(self, sample_velocity: ti.Ndarray, *terms: Any) -> NDArray[np.float64]:
        """Forces [N] and torques [N m] on each body that are only tried, (bodies, 6).

        Args:
            sample_velocity: of the boundary samples [m/s].
            terms: as for `gather`.
        """
        self._gather(sample_velocity, terms)
        return self._host_wrenches()

    def worst_mean_near_bodies(self, remaining: ti.Ndarray, pressure: ti.Ndarray, *terms: Any) -> float:
        """Mean error of a pressure solve among the particles near a body, weighted by its kernel; the largest of all.

        Args:
            remaining: compression that is left of each particle [-].
            pressure: P of each particle [Pa].
            terms: what `weigh_errors` takes after them, up to `inverse_support`.
        """
        boundary = self._boundary
        weigh_errors(
            boundary.position, boundary.volume, boundary.fixed_count, boundary.moving_count, *self.near,
            remaining, pressure, *terms, self._force,
        )  # fmt: skip
        self._sum_over_bodies()
        error, weight = self._host_wrenches()[:, :2].T
        return float(np.divide(error, weight, out=np.zeros_like(error), where=weight > 0.0).max(initial=0.0))

    def take_impulses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The impulses on the bodies since they were taken last, linear [N s] and about the centres of mass [N m s].

        Both are (bodies, 3).
        """
        taken, self._impulse = self._impulse, np.zeros_like(self._impulse)
        return taken[:, :3], taken[:, 3:]

    def _gather(self, sample_velocity: ti.Ndarray, terms: tuple[Any, ...]) -> None:
        boundary = self._boundary
        gather_sample_forces(
            boundary.position, sample_velocity, boundary.volume, boundary.fixed_count, boundary.moving_count,
            *self.near, *terms, self._force,
        )  # fmt: skip
        self._sum_over_bodies()

    def _host_wrenches(self) -> NDArray[np.float64]:
        entries = self._boundary.body_count * WRENCH_WIDTH
        return self._wrench.to_numpy()[:entries].astype(np.float64).reshape(-1, WRENCH_WIDTH)

    def _sum_over_bodies(self) -> None:
        boundary = self._boundary
        sum_sample_forces(
            boundary.position, boundary.fixed_count, self._force, boundary.body, boundary.states,
            self._chunk_start, self._chunk_count, self._chunk_of_body, boundary.body_count,
            self._partial, self._wrench,
        )  # fmt: skip


def _integers(values: NDArray[np.integer]) -> ti.Ndarray:
    array = ti.ndarray(ti.i32, len(values))
    array.from_numpy(np.ascontiguousarray(values, dtype=np.int32))
    return array


@ti.kernel
def count_particles_near_samples(
    sample_position: Vectors, first: ti.i32, sample_count: ti.i32, x: Floats, y: Floats, z: Floats,
    cell_start: Integers, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.i32,
    radius_squared: ti.f32, near_count: Integers,
):  # fmt: skip
    """How many particles may be within the radius of each sample; a distance may be rounded differently later."""
    for b in range(sample_count):
        x_b = sample_position[first + b]
        cell = cell_of_point(x_b, origin, inverse_cell_size, shape, reach)
        found = 0
        for dz in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                row = row_of_cell(cell, dy, dz, shape)
                for i in range(cell_start[row - reach], cell_start[row + reach + 1]):
                    if is_near(x_b, x[i], y[i], z[i], radius_squared * (1.0 + ROUNDING_MARGIN)):
                        found += 1
        near_count[b] = found


@ti.kernel
def list_particles_near_samples(
    sample_position: Vectors, first: ti.i32, sample_count: ti.i32, x: Floats, y: Floats, z: Floats,
    cell_start: Integers, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.i32,
    radius_squared: ti.f32, near_count: Integers, near_start: Integers, near: Integers,
):  # fmt: skip
    """Write the particles near each moving sample, in their order; there is room for as many as were counted."""
    for b in range(sample_count):
        x_b = sample_position[first + b]
        cell = cell_of_point(x_b, origin, inverse_cell_size, shape, reach)
        place = near_start[b]
        for dz in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                row = row_of_cell(cell, dy, dz, shape)
                for i in range(cell_start[row - reach], cell_start[row + reach + 1]):
                    if is_near(x_b, x[i], y[i], z[i], radius_squared):
                        near[place] = i
                        place += 1
        near_count[b] = place - near_start[b]


@ti.func
def is_near(x_b: ti.math.vec3, x: ti.f32, y: ti.f32, z: ti.f32, radius_squared: ti.f32) -> ti.i32:
    """Whether a particle is within the radius of a sample."""
    return ti.cast((x_b - ti.math.vec3(x, y, z)).norm_sqr() < radius_squared, ti.i32)


@fast_launch
@ti.kernel
def gather_sample_forces(
    sample_position: Vectors, sample_velocity: Vectors, sample_volume: Floats, first: ti.i32, sample_count: ti.i32,
    near_start: Integers, near_count: Integers, near: Integers,
    position: Vectors, velocity: Vectors, phase: Integers, density: Floats, pressure_term: Floats,
    rest_density: Floats, dynamic_viscosity: Floats, volume_gradient_factor: ti.f32, inverse_support: ti.f32,
    softening: ti.f32, artificial: ti.f32, wall_friction: ti.f32,
    with_pressure: ti.template(), with_wall_friction: ti.template(), force: Vectors,
):  # fmt: skip
    """The opposite of what each moving sample does to its particles [N]; terms as in the fluid's own sum.

    `dynamic_viscosity` is mu without its 2 (d + 2), `artificial` is alpha c_s h/2, `volume_gradient_factor` V sigma/h.
    """
    for b in range(sample_count):
        x_b, v_b = sample_position[first + b], sample_velocity[first + b]
        total = ti.math.vec3(0.0)
        for k in range(near_start[b], near_start[b] + near_count[b]):
            i = near[k]
            x_ib = position[i] - x_b
            r_squared = x_ib.norm_sqr()
            r = ti.sqrt(r_squared)
            scale = 0.0
            if ti.static(with_pressure):
                scale += pressure_term[i]
            if ti.static(with_wall_friction):
                own = phase[i]
                mu, rho0 = LAPLACIAN_FACTOR * dynamic_viscosity[own], rest_density[own]
                v_dot_x = (velocity[i] - v_b).dot(x_ib)
                viscous = viscous_factor(v_dot_x, r_squared, softening, mu, artificial * rho0)
                scale -= wall_friction * viscous / density[i]
            total += scale * spline_slope(r * inverse_support) / (r + TINY_DISTANCE) * x_ib
        force[b] = volume_gradient_factor * sample_volume[first + b] * total


@fast_launch
@ti.kernel
def sum_sample_forces(
    sample_position: Vectors, first: ti.i32, force: Vectors, body: Integers, states: Floats,
    chunk_start: Integers, chunk_count: ti.i32, chunk_of_body: Integers, body_count: ti.i32,
    partial: Floats, wrench: Floats,
):  # fmt: skip
    """Force and torque about the centre of mass of each body, chunk by chunk, always in the same order."""
    for chunk in range(chunk_count):
        s = body[chunk_start[chunk]] * STATE_WIDTH
        centre = ti.math.vec3(states[s], states[s + 1], states[s + 2])
        total = ti.math.vec3(0.0)
        torque = ti.math.vec3(0.0)
        for b in range(chunk_start[chunk], chunk_start[chunk + 1]):
            total += force[b]
            torque += (sample_position[first + b] - centre).cross(force[b])
        for axis in ti.static(range(3)):
            partial[chunk * WRENCH_WIDTH + axis] = total[axis]
            partial[chunk * WRENCH_WIDTH + 3 + axis] = torque[axis]
    for entry in range(body_count * WRENCH_WIDTH):
        of_body = entry // WRENCH_WIDTH
        total = 0.0
        for chunk in range(chunk_of_body[of_body], chunk_of_body[of_body + 1]):
            total += partial[chunk * WRENCH_WIDTH + entry % WRENCH_WIDTH]
        wrench[entry] = total
