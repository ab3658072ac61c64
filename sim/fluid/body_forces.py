"""Reaction of a particle fluid on the bodies and sheets that move in it."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.cells import CellGrid, Grid, SortedPoints, cell_of_point, row_of_cell
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.neighbors import GROWTH, ROUNDING_MARGIN
from sim.core.parameters import Vector3
from sim.core.scan import scan_in_parallel, scan_scratch_length
from sim.fluid.body_response import BodyResponse, accelerate, push
from sim.fluid.boundary import STATE_WIDTH, WRENCH_WIDTH, Bodies, Boundary, NearParticles, Samples, Sheets, to_particle
from sim.fluid.kernels import TINY_DISTANCE, Discretization, spline_slope
from sim.fluid.particles import Fluid
from sim.fluid.sheets import SheetForces, SheetReaction, answer_of_sheets, react_of_sheets
from sim.fluid.viscosity import LAPLACIAN_FACTOR, Viscosity, viscous_factor

FillForces = Callable[[NearParticles, Bodies, ti.Ndarray], None]
"""Fills the forces on all moving samples [N], given the particles near each and which samples are of bodies."""

CHUNK = 64  # samples of a body that one node of the sum takes together
KEPT = 8  # forces on the bodies that wait on the device until the host asks for all of them


@bundle
class Exerted(NamedTuple):
    """Forces of the fluid on moving samples, by pressure, by friction or by both."""

    fluid: Fluid
    pressure_term: Floats  # P_i [Pa]
    volume_gradient_factor: ti.f32  # V sigma/h [1/m]
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


@bundle
class Summed(NamedTuple):
    """Forces on the samples, and their sums over the bodies."""

    force: Vectors  # on each moving sample [N], (moving,)
    wrench: Floats  # force [N] and torque [N m] on each body and all that moves with it, (bodies * 6,)
    own: Floats  # those on each body alone, about the same centre, (bodies * 6,)
    chunks: Chunks


class BodyForces:
    """Forces and torques of the fluid on each moving body, and their impulses in a step.

    The force on sample b is the opposite of what b does to its particles, pair by pair (Akinci et al. 2012, eq. 10):

        f_b = sum_i V V_b (P_i - mu_ib) grad_i W_ib,     F = sum_b f_b,     M = sum_b (x_b - x_com) x f_b

    with the wall friction mu_ib of the fluid's own sum. Every sample gathers over its particles in their order, and the
    samples of a body are summed in a tree of fixed shape: the same bits whatever the number of threads.

    Attributes:
        near: particles near each moving sample.
        are_alone: whether no particle is near any moving sample, so that no forces act; until the next search.
            Not said in the first step, which compiles what the first touch needs.
        response: answer of the bodies' samples to forces within the step; None where they wait for its end.
        sheets: forces on the samples of sheets; None where there are none.
    """

    def __init__(self, boundary: Boundary, grid: CellGrid, search_radius: float) -> None:
        """Prepare for the samples of a boundary; lists of particles reach the search radius [m]."""
        self._boundary, self._grid, self._search_radius = boundary, grid, search_radius
        samples, bodies = max(boundary.moving_count, 1), max(boundary.body_count, 1)
        chunks = [
            np.arange(first, last, CHUNK)
            for first, last in zip(boundary.body_start[:-1], boundary.body_start[1:], strict=True)
        ]
        chunk_of_body = np.concatenate([[0], np.cumsum([len(each) for each in chunks])]).astype(np.int32)
        count = int(chunk_of_body[-1])
        samples_of = Chunks(
            count=count,
            start=on_device(np.concatenate([*chunks, [boundary.body_sample_count]])),
            of_body=on_device(chunk_of_body),
            wrench=ti.ndarray(ti.f32, max(count, 1) * WRENCH_WIDTH),
        )
        self.near = NearParticles(
            first=boundary.fixed_count,
            sample_count=boundary.moving_count,
            start=ti.ndarray(ti.i32, samples + 1),
            count=ti.ndarray(ti.i32, samples),
            particles=ti.ndarray(ti.i32, 1),
        )
        self._scratch = ti.ndarray(ti.i32, scan_scratch_length(samples))
        self.are_alone = self._are_compiled = False
        self.summed = Summed(
            ti.Vector.ndarray(3, ti.f32, samples),
            ti.ndarray(ti.f32, bodies * WRENCH_WIDTH),
            ti.ndarray(ti.f32, bodies * WRENCH_WIDTH),
            samples_of,
        )
        self._kept = ti.ndarray(ti.f32, KEPT * bodies * WRENCH_WIDTH)
        self._kept_dt: list[float] = []
        self._impulse: NDArray[np.float64] = np.zeros((boundary.body_count, WRENCH_WIDTH))
        self.response: BodyResponse | None = None
        self.sheets: SheetForces | None = None

    @property
    def answer(self) -> bool:
        """Whether any moving samples answer to forces within the step."""
        free_bodies = self.response is not None and self.response.is_needed
        return free_bodies or (self.sheets is not None and self.sheets.answers)

    def find_particles(self, points: SortedPoints) -> None:
        """List the particles near each sample; particles and samples are where they are at a neighbour search."""
        if self._boundary.moving_count == 0:
            return
        samples, grid, radius_squared = self._boundary.samples, self._grid.on_device, self._search_radius**2
        # The margin is for distances that are rounded differently when they are listed.
        bounds = radius_squared * (1.0 + ROUNDING_MARGIN), radius_squared
        while True:
            entries = find_particles_near_samples(samples, self.near, self._scratch, points, grid, *bounds)
            if entries <= self.near.particles.shape[0]:
                break
            self.near = self.near._replace(particles=ti.ndarray(ti.i32, int(entries * GROWTH)))
        self.are_alone = entries == 0 and self._are_compiled

    def let_bodies_respond(self, gravity: Vector3, discretization: Discretization) -> None:
        """From now on the bodies' samples, if there are any, answer to forces within the step."""
        if self._boundary.moving_count > 0 and self.response is None:
            self.response = BodyResponse(self._boundary, gravity, discretization)

    def gather(self, exerted: Exerted, dt: float) -> None:
        """Add the impulses of a step of dt [s], from forces that the fluid has just felt."""
        if self._boundary.moving_count == 0 or self.are_alone:
            return
        if len(self._kept_dt) == KEPT:
            self._count_impulses()
        response, sheets, boundary = self.response, self.sheets, self._boundary
        react_to_forces(
            self.near,
            exerted,
            boundary.bodies,
            self.summed.wrench if response is None else response.mobility,
            boundary.sheets,
            self._no_reaction if sheets is None else sheets.reaction,
            self.summed,
            self._kept,
            len(self._kept_dt) * boundary.body_count * WRENCH_WIDTH,
            dt,
            response is not None,
            sheets is not None,
            sheets is not None and sheets.answers,
        )
        self._kept_dt.append(dt)
        self._are_compiled = True

    def gather_others(self, fill_forces: FillForces, samples: Samples, dt: float) -> None:
        """Add the impulses on bodies of a step of dt [s] by forces on their samples other than `Exerted`."""
        if self._boundary.body_sample_count == 0 or self.are_alone:
            return
        if len(self._kept_dt) == KEPT:
            self._count_impulses()
        response, bodies = self.response, self._boundary.bodies
        fill_forces(self.near, bodies, self.summed.force)
        react_to_others(
            samples,
            bodies,
            self.summed.wrench if response is None else response.mobility,
            self.summed,
            self._kept,
            len(self._kept_dt) * self._boundary.body_count * WRENCH_WIDTH,
            dt,
            response is not None,
        )
        self._kept_dt.append(dt)

    def respond(self, exerted: Exerted) -> ti.Ndarray:
        """Acceleration of each boundary sample by forces that are only tried [m/s²]; their impulses do not count."""
        assert self.response is not None
        if self.are_alone:
            return self.response.no_acceleration
        response, boundary = self.response, self._boundary
        sheets = self.sheets if self.sheets is not None and self.sheets.answers else None
        answer_forces(
            self.near,
            exerted,
            boundary.bodies,
            response.mobility,
            boundary.sheets,
            self.summed.wrench if sheets is None else sheets.reaction.mass,
            self.summed,
            response.acceleration,
            sheets is not None,
        )
        return response.acceleration

    def measure(self, exerted: Exerted) -> NDArray[np.float64]:
        """Forces [N] and torques [N m] on each body that are only tried, (bodies, 6)."""
        if self.are_alone:
            return np.zeros((self._boundary.body_count, WRENCH_WIDTH))
        measure_forces(self.near, exerted, self._boundary.bodies, self.summed)
        return self._rows(copied(self.summed.wrench))

    def take_impulses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Impulses on the bodies since the last call [N s], and angular ones [N m s], (bodies, 3) each.

        The latter are about the centre of mass of what each moves with.
        """
        self._count_impulses()
        taken, self._impulse = self._impulse, np.zeros_like(self._impulse)
        return taken[:, :3], taken[:, 3:]

    def _count_impulses(self) -> None:
        """Add the impulses of all forces that wait on the device."""
        if self._kept_dt and self._boundary.body_count:
            kept = copied(self._kept).reshape(KEPT, -1)
            for dt, wrenches in zip(self._kept_dt, kept, strict=False):
                self._impulse += dt * self._rows(wrenches)
        self._kept_dt = []

    def _rows(self, wrenches: NDArray[np.generic]) -> NDArray[np.float64]:
        entries = self._boundary.body_count * WRENCH_WIDTH
        return wrenches[:entries].astype(np.float64).reshape(-1, WRENCH_WIDTH)

    @property
    def _no_reaction(self) -> SheetReaction:
        """Stands for that of sheets where there are none; kernels do not read it."""
        force = self.summed.force
        return SheetReaction(self.summed.wrench, force, force, force)


@func
def near_one_sample(
    near: NearParticles,
    b: ti.i32,
    x_b: ti.math.vec3,
    points: SortedPoints,
    grid: Grid,
    radius_squared: ti.f32,
    is_listing: ti.template(),
) -> ti.i32:
    """Number of particles near a moving sample, and, where they are listed and there is room, these in their order."""
    cell = cell_of_point(x_b, grid)
    found = 0
    for dz in range(-grid.reach, grid.reach + 1):
        for dy in range(-grid.reach, grid.reach + 1):
            row = row_of_cell(cell, dy, dz, grid)
            for i in range(points.cell_start[row - grid.reach], points.cell_start[row + grid.reach + 1]):
                x_i = ti.math.vec3(points.x[i], points.y[i], points.z[i])
                if (x_b - x_i).norm_sqr() < radius_squared:
                    if ti.static(is_listing):
                        place = near.start[b] + found
                        if place < near.particles.shape[0]:
                            near.particles[place] = i
                    found += 1
    return found


@kernel
def find_particles_near_samples(
    samples: Samples,
    near: NearParticles,
    scratch: Integers,
    points: SortedPoints,
    grid: Grid,
    bound: ti.f32,
    radius_squared: ti.f32,
) -> ti.i32:
    """List the particles near each moving sample; returns for how many there has to be room, else the list is cut.

    They are counted within the bound, on a squared radius, a little more than that within which they are listed.
    """
    for b in range(near.sample_count):
        near.count[b] = near_one_sample(near, b, samples.position[near.first + b], points, grid, bound, False)
    entries = scan_in_parallel(near.count, near.sample_count, scratch, near.start)
    for b in range(near.sample_count):
        x_b = samples.position[near.first + b]
        near.count[b] = near_one_sample(near, b, x_b, points, grid, radius_squared, True)
    return entries


@func
def gather_forces(near: NearParticles, exerted: Exerted, force: Vectors):
    """The opposite of what each moving sample does to its particles [N]; terms as in the fluid's own sum."""
    fluid, viscosity = ti.static((exerted.fluid, exerted.viscosity))
    particles, samples = ti.static((fluid.particles, fluid.samples))
    for b in range(near.sample_count):
        v_b = samples.velocity[near.first + b]
        total = ti.math.vec3(0.0)
        for k in range(near.start[b], near.start[b] + near.count[b]):
            i = near.particles[k]
            x_ib = to_particle(samples, near.first + b, particles.position[i])
            r_squared = x_ib.norm_sqr()
            r = ti.sqrt(r_squared)
            scale = 0.0
            if ti.static(exerted.with_pressure):
                scale += exerted.pressure_term[i]
            if ti.static(exerted.with_friction):
                own = particles.phase[i]
                rho0 = fluid.materials.rest_density[own]
                mu = LAPLACIAN_FACTOR * fluid.materials.dynamic_viscosity[own]
                v_dot_x = (particles.velocity[i] - v_b).dot(x_ib)
                viscous = viscous_factor(v_dot_x, r_squared, viscosity, mu, rho0)
                scale -= viscosity.wall_friction * viscous / particles.density[i]
            total += scale * spline_slope(r * fluid.inverse_support) / (r + TINY_DISTANCE) * x_ib
        force[b] = exerted.volume_gradient_factor * samples.volume[near.first + b] * total


@func
def sum_over_bodies(samples: Samples, bodies: Bodies, summed: Summed):
    """Force and torque about the centre of mass of what each body moves with, chunk by chunk, in the same order."""
    chunks, force = ti.static((summed.chunks, summed.force))
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
        summed.own[entry] = total
    for entry in range(bodies.count * WRENCH_WIDTH):
        mover = entry // WRENCH_WIDTH
        total = 0.0
        for member in range(bodies.first_member[mover], bodies.first_member[mover + 1]):
            total += summed.own[bodies.members[member] * WRENCH_WIDTH + entry % WRENCH_WIDTH]
        summed.wrench[entry] = total


@kernel
def measure_forces(near: NearParticles, exerted: Exerted, bodies: Bodies, summed: Summed):
    """Forces on the samples and their sums over the bodies."""
    gather_forces(near, exerted, summed.force)
    sum_over_bodies(exerted.fluid.samples, bodies, summed)


@kernel
def answer_forces(
    near: NearParticles,
    exerted: Exerted,
    bodies: Bodies,
    mobility: Floats,
    sheets: Sheets,
    sheet_mass: Floats,
    summed: Summed,
    acceleration: Vectors,
    with_sheets: ti.template(),
):
    """Accelerations of all moving samples by forces that are tried."""
    gather_forces(near, exerted, summed.force)
    sum_over_bodies(exerted.fluid.samples, bodies, summed)
    accelerate(exerted.fluid.samples, bodies, summed.wrench, mobility, acceleration)
    if ti.static(with_sheets):
        answer_of_sheets(summed.force, sheets, sheet_mass, acceleration)


@kernel
def react_to_others(
    samples: Samples,
    bodies: Bodies,
    mobility: Floats,
    summed: Summed,
    kept: Floats,
    first: ti.i32,
    dt: ti.f32,
    bodies_answer: ti.template(),
):
    """Forces on samples of bodies that count, for dt [s]: kept from `first` on, and samples that answer move on."""
    sum_over_bodies(samples, bodies, summed)
    for entry in range(bodies.count * WRENCH_WIDTH):
        kept[first + entry] = summed.own[entry]
    if ti.static(bodies_answer):
        push(samples, bodies, summed.wrench, mobility, ti.math.vec3(0.0), dt)


@kernel
def react_to_forces(
    near: NearParticles,
    exerted: Exerted,
    bodies: Bodies,
    mobility: Floats,
    sheets: Sheets,
    reaction: SheetReaction,
    summed: Summed,
    kept: Floats,
    first: ti.i32,
    dt: ti.f32,
    bodies_answer: ti.template(),
    with_sheets: ti.template(),
    sheets_answer: ti.template(),
):
    """Forces that count, for dt [s]: those on bodies are kept from `first` on, and samples that answer move on."""
    gather_forces(near, exerted, summed.force)
    sum_over_bodies(exerted.fluid.samples, bodies, summed)
    for entry in range(bodies.count * WRENCH_WIDTH):
        kept[first + entry] = summed.own[entry]
    if ti.static(bodies_answer):
        push(exerted.fluid.samples, bodies, summed.wrench, mobility, ti.math.vec3(0.0), dt)
    if ti.static(with_sheets):
        react_of_sheets(summed.force, sheets, dt, reaction, exerted.fluid.samples, sheets_answer)
