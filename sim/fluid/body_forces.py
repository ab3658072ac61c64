"""Reaction of a particle fluid on the bodies and sheets that move in it."""

from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import bundle, func
from sim.core.cells import CellGrid, Grid, SortedPoints, cell_of_point, row_of_cell
from sim.core.launch import kernel
from sim.core.neighbors import GROWTH, ROUNDING_MARGIN
from sim.fluid.body_response import BodyResponse, SolveError, weigh_errors
from sim.fluid.boundary import STATE_WIDTH, WRENCH_WIDTH, Bodies, Boundary, NearParticles, Samples
from sim.fluid.kernels import TINY_DISTANCE, spline_slope
from sim.fluid.particles import Particles
from sim.fluid.phases import Materials
from sim.fluid.sheet_forces import SheetForces
from sim.fluid.viscosity import LAPLACIAN_FACTOR, Viscosity, viscous_factor

CHUNK = 64
"""Samples of a body that one node of the sum takes together."""


@bundle
class Exerted(NamedTuple):
    """Forces of the fluid on moving samples, by pressure, by friction or by both."""

    particles: Particles
    pressure_term: Floats  # P_i [Pa]
    materials: Materials
    volume_gradient_factor: ti.f32  # V sigma/h [1/m]
    inverse_support: ti.f32  # 1/h [1/m]
    viscosity: Viscosity
    with_pressure: ti.template()
    with_friction: ti.template()


@bundle
class Chunks(NamedTuple):
    """Runs of samples of one body, the leaves of the sum over a body."""

    count: ti.i32
    start: Integers  # first moving sample of each chunk, (chunks + 1,)
    of_body: Integers  # first chunk of each body, (bodies + 1,)
    wrench: Floats  # force [N] and torque [N m] of each chunk, (chunks * 6,)


class BodyForces:
    """Forces and torques of the fluid on each moving body, and their impulses in a step.

    The force on sample b is the opposite of what b does to its particles, pair by pair (Akinci et al. 2012, eq. 10):

        f_b = sum_i V V_b (P_i - mu_ib) grad_i W_ib,     F = sum_b f_b,     M = sum_b (x_b - x_com) x f_b

    with the wall friction mu_ib of the fluid's own sum. Pair forces point along x_i - x_b, so that fluid and bodies
    together keep their linear and their angular momentum to rounding.

    Every sample gathers over a list of its particles in the order of the sorted particles, and the samples of a body
    are summed in a tree of fixed shape: the same bits whatever the number of threads.

    Attributes:
        near: particles near each moving sample.
        response: answer of the bodies' samples to forces within the step; None where they wait for its end.
        sheets: forces on the samples of sheets; None where there are none.
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
        count = int(chunk_of_body[-1])
        self._chunks = Chunks(
            count=count,
            start=_integers(np.concatenate([*chunks, [boundary.body_sample_count]])),
            of_body=_integers(chunk_of_body),
            wrench=ti.ndarray(ti.f32, max(count, 1) * WRENCH_WIDTH),
        )
        self.near = NearParticles(
            first=boundary.fixed_count,
            sample_count=boundary.moving_count,
            start=ti.ndarray(ti.i32, samples + 1),
            count=ti.ndarray(ti.i32, samples),
            particles=ti.ndarray(ti.i32, 1),
        )
        self._force = ti.Vector.ndarray(3, ti.f32, samples)
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

    def find_particles(self, points: SortedPoints) -> None:
        """List the particles near each sample; particles and samples are where they are at a neighbour search."""
        if self._boundary.moving_count == 0:
            return
        samples, grid, radius_squared = self._boundary.samples, self._grid.on_device, self._search_radius**2
        count_particles_near_samples(samples, self.near, points, grid, radius_squared)
        starts = np.zeros(self._boundary.moving_count + 1, dtype=np.int32)
        np.cumsum(self.near.count.to_numpy(), out=starts[1:])
        self.near.start.from_numpy(starts)
        if starts[-1] > self.near.particles.shape[0]:
            self.near = self.near._replace(particles=ti.ndarray(ti.i32, int(starts[-1] * GROWTH)))
        list_particles_near_samples(samples, self.near, points, grid, radius_squared)

    def let_bodies_respond(self, gravity: tuple[float, float, float], spacing: float) -> None:
        """From now on the bodies' samples, if there are any, answer to forces within the step.

        Args:
            gravity: [m/s²].
            spacing: of the particles [m].
        """
        if self._boundary.moving_count > 0 and self.response is None:
            self.response = BodyResponse(self._boundary, gravity, spacing)

    def gather(self, exerted: Exerted, dt: float, *, sample_velocity: ti.Ndarray | None = None) -> None:
        """Add the impulses of a step, from forces that the fluid has just felt.

        Args:
            exerted: the forces.
            dt: the step [s].
            sample_velocity: of the boundary samples, as the fluid felt them [m/s]; their present ones if omitted.
        """
        if self._boundary.moving_count == 0:
            return
        self._gather(exerted, sample_velocity)
        if self._boundary.body_count:
            self._impulse += dt * self._host_wrenches()
        if self.response is not None:
            self.response.push_samples(self._wrench, dt)
        if self.sheets is not None:
            self.sheets.count_forces(self._force, dt)

    def respond(self, exerted: Exerted) -> ti.Ndarray:
        """Acceleration of each boundary sample by forces that are only tried [m/s²]; their impulses do not count."""
        assert self.response is not None
        self._gather(exerted, None)
        acceleration = self.response.accelerate_samples(self._wrench)
        if self.sheets is not None and self.sheets.answers:
            self.sheets.accelerate(self._force, acceleration)
        return acceleration

    def measure(self, exerted: Exerted, sample_velocity: ti.Ndarray) -> NDArray[np.float64]:
        """Forces [N] and torques [N m] on each body that are only tried, (bodies, 6).

        Args:
            exerted: the forces.
            sample_velocity: of the boundary samples [m/s].
        """
        self._gather(exerted, sample_velocity)
        return self._host_wrenches()

    def worst_mean_near_bodies(self, particles: Particles, error: SolveError, inverse_support: float) -> float:
        """Mean error of a pressure solve among the particles near a body, weighted by its kernel; the largest of all.

        Args:
            particles: of the fluid.
            error: what the solve leaves of each of them.
            inverse_support: 1/h [1/m].
        """
        weigh_errors(self._boundary.samples, self.near, particles, error, inverse_support, self._force)
        self._sum_over_bodies()
        total, weight = self._host_wrenches()[:, :2].T
        return float(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0.0).max(initial=0.0))

    def take_impulses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The impulses on the bodies since they were taken last, linear [N s] and about the centres of mass [N m s].

        Both are (bodies, 3).
        """
        taken, self._impulse = self._impulse, np.zeros_like(self._impulse)
        return taken[:, :3], taken[:, 3:]

    def _gather(self, exerted: Exerted, sample_velocity: ti.Ndarray | None) -> None:
        samples = self._boundary.samples
        if sample_velocity is not None:
            samples = samples._replace(velocity=sample_velocity)
        gather_sample_forces(samples, self.near, exerted, self._force)
        self._sum_over_bodies()

    def _host_wrenches(self) -> NDArray[np.float64]:
        entries = self._boundary.body_count * WRENCH_WIDTH
        return self._wrench.to_numpy()[:entries].astype(np.float64).reshape(-1, WRENCH_WIDTH)

    def _sum_over_bodies(self) -> None:
        sum_sample_forces(self._boundary.samples, self._boundary.bodies, self._force, self._chunks, self._wrench)


def _integers(values: NDArray[np.integer]) -> ti.Ndarray:
    array = ti.ndarray(ti.i32, len(values))
    array.from_numpy(np.ascontiguousarray(values, dtype=np.int32))
    return array


@kernel
def count_particles_near_samples(
    samples: Samples, near: NearParticles, points: SortedPoints, grid: Grid, radius_squared: ti.f32
):
    """Bound on the number of particles near each sample; a distance may be rounded differently later."""
    for b in range(near.sample_count):
        x_b = samples.position[near.first + b]
        cell = cell_of_point(x_b, grid)
        found = 0
        for dz in range(-grid.reach, grid.reach + 1):
            for dy in range(-grid.reach, grid.reach + 1):
                row = row_of_cell(cell, dy, dz, grid)
                for i in range(points.cell_start[row - grid.reach], points.cell_start[row + grid.reach + 1]):
                    if is_near(x_b, points, i, radius_squared * (1.0 + ROUNDING_MARGIN)):
                        found += 1
        near.count[b] = found


@kernel
def list_particles_near_samples(
    samples: Samples, near: NearParticles, points: SortedPoints, grid: Grid, radius_squared: ti.f32
):
    """The particles near each moving sample, in their order; there is room for as many as were counted."""
    for b in range(near.sample_count):
        x_b = samples.position[near.first + b]
        cell = cell_of_point(x_b, grid)
        place = near.start[b]
        for dz in range(-grid.reach, grid.reach + 1):
            for dy in range(-grid.reach, grid.reach + 1):
                row = row_of_cell(cell, dy, dz, grid)
                for i in range(points.cell_start[row - grid.reach], points.cell_start[row + grid.reach + 1]):
                    if is_near(x_b, points, i, radius_squared):
                        near.particles[place] = i
                        place += 1
        near.count[b] = place - near.start[b]


@func
def is_near(x_b: ti.math.vec3, points: SortedPoints, i: ti.i32, radius_squared: ti.f32) -> ti.i32:
    """Whether a particle is within the radius of a sample."""
    return ti.cast((x_b - ti.math.vec3(points.x[i], points.y[i], points.z[i])).norm_sqr() < radius_squared, ti.i32)


@kernel
def gather_sample_forces(samples: Samples, near: NearParticles, exerted: Exerted, force: Vectors):
    """The opposite of what each moving sample does to its particles [N]; terms as in the fluid's own sum."""
    for b in range(near.sample_count):
        x_b, v_b = samples.position[near.first + b], samples.velocity[near.first + b]
        total = ti.math.vec3(0.0)
        for k in range(near.start[b], near.start[b] + near.count[b]):
            i = near.particles[k]
            x_ib = exerted.particles.position[i] - x_b
            r_squared = x_ib.norm_sqr()
            r = ti.sqrt(r_squared)
            scale = 0.0
            if ti.static(exerted.with_pressure):
                scale += exerted.pressure_term[i]
            if ti.static(exerted.with_friction):
                own = exerted.particles.phase[i]
                rho0 = exerted.materials.rest_density[own]
                mu = LAPLACIAN_FACTOR * exerted.materials.dynamic_viscosity[own]
                v_dot_x = (exerted.particles.velocity[i] - v_b).dot(x_ib)
                viscous = viscous_factor(
                    v_dot_x, r_squared, exerted.viscosity.softening, mu, exerted.viscosity.artificial * rho0
                )
                scale -= exerted.viscosity.wall_friction * viscous / exerted.particles.density[i]
            total += scale * spline_slope(r * exerted.inverse_support) / (r + TINY_DISTANCE) * x_ib
        force[b] = exerted.volume_gradient_factor * samples.volume[near.first + b] * total


@kernel
def sum_sample_forces(samples: Samples, bodies: Bodies, force: Vectors, chunks: Chunks, wrench: Floats):
    """Force and torque about the centre of mass of each body, chunk by chunk, always in the same order."""
    for chunk in range(chunks.count):
        s = bodies.body[chunks.start[chunk]] * STATE_WIDTH
        centre = ti.math.vec3(bodies.states[s], bodies.states[s + 1], bodies.states[s + 2])
        total = ti.math.vec3(0.0)
        torque = ti.math.vec3(0.0)
        for b in range(chunks.start[chunk], chunks.start[chunk + 1]):
            total += force[b]
            torque += (samples.position[bodies.first + b] - centre).cross(force[b])
        for axis in ti.static(range(3)):
            chunks.wrench[chunk * WRENCH_WIDTH + axis] = total[axis]
            chunks.wrench[chunk * WRENCH_WIDTH + 3 + axis] = torque[axis]
    for entry in range(bodies.count * WRENCH_WIDTH):
        of_body = entry // WRENCH_WIDTH
        total = 0.0
        for chunk in range(chunks.of_body[of_body], chunks.of_body[of_body + 1]):
            total += chunks.wrench[chunk * WRENCH_WIDTH + entry % WRENCH_WIDTH]
        wrench[entry] = total
