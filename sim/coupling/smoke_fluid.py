"""Water and soft matter as obstacles for smoke and air."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, LongIntegers, Vectors
from sim.core.bundles import bundle
from sim.core.domain import DomainParameters
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.solver import Coupling
from sim.smoke.arrays import new_floats
from sim.smoke.cut_cells import ROUNDING
from sim.smoke.grid import SmokeGrid, cell_corners
from sim.smoke.lanes import Grid, cell_counts, row_start
from sim.smoke.obstacles import NOBODY, Marks, mark

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.smoke.solver import SmokeSolver
    from sim.soft.solver import SoftSolver

REACH_IN_SPACINGS = (
    2.0  # least half-width of a particle's weight: a lone one fills an eighth of its place, without holes
)
WATER = 0.5  # fraction of water above which a cell is water: where a flat surface cuts the cell's centre
NEVER = 1.0e30  # time in which weightless particles at rest get anywhere [s]
FRACTION_QUANTUM = 2.0**-20  # unit of the sums of volume fractions [-]; they hold up to 2048
MOMENTUM_QUANTUM = 2.0**-40  # unit of the sums of volume fraction times velocity [m/s]; they hold up to 8e6
BEYOND = 1.0e9  # more than any fraction; products of three are still finite
LEAST_ROOM = 0.125  # least part of the weight that counts as free: in the corner of a tank it is that


@bundle
class Sums(NamedTuple):
    """Water in the cells of a smoke, flat; integers, so that their order does not matter."""

    fraction: Integers  # of volume, in units of `FRACTION_QUANTUM`
    momentum_x: LongIntegers  # volume fraction times velocity, in units of `MOMENTUM_QUANTUM`
    momentum_y: LongIntegers
    momentum_z: LongIntegers
    inside: Floats  # part of the weight at a cell's centre that walls and static bodies leave


@bundle
class Reach(NamedTuple):
    """The box of a smoke, and how far from a particle the weight of its water goes."""

    low: ti.math.vec3  # corner of the box [m]
    high: ti.math.vec3
    cell_size: ti.f32  # [m]
    in_cells: ti.f32  # half-width R of the weight [cells]
    volume: ti.f32  # of a particle over R³


class SmokeFluidCoupling(Coupling):
    """Air cannot enter water or soft matter, which is meant by water here, and moves with its surface.

    A coupled step of the smoke: the fluid takes its own, shorter steps; then the cells that hold water are marked as
    obstacles with the velocity of the water in them, as wholes, and the smoke steps around them. One way: water does
    not feel air, which weighs a thousandth of it.

    The volume fraction of water at the centre of a cell is

        phi = sum_i d³ prod_a w((x - x_i)_a / R) / R,   w(q) = max(0, 1 - |q|),

    with R twice the spacing d of particles, or a cell's edge if that is longer: then it is a mean over the cell and
    half of each of its neighbours. For a lattice of particles it is 1 inside, and 1/2 on a flat surface. What it lacks
    beside closed faces of the domain and static bodies is made up for by dividing by the part of the weight that is
    free of them. A lone drop
    blocks no air, nor does a sheet of one layer of particles; two layers do where cells are as fine as particles.

    Steps are cut so that no particle gets farther than a cell within its reach of the box, with its velocity and
    gravity. What pressure gives it in a step of the smoke is not foreseen, nor are particles that an emitter has yet to
    let in: they count from the next step on.

    """

    is_loose = True

    def __init__(self, fluid: "SPHFluid | SoftSolver", smoke: "SmokeSolver", *, domain: DomainParameters) -> None:
        """Couple the two; the first water is marked, and is there once the smoke has moved its obstacles."""
        self.bodies = (fluid.name, smoke.name)
        self._fluid, self._smoke = fluid, smoke
        grid = smoke.grid
        reach = max(REACH_IN_SPACINGS * fluid.spacing, grid.cell_size)
        corners, volume = (ti.math.vec3(grid.origin), ti.math.vec3(grid.upper)), (fluid.spacing / reach) ** 3
        self._reach = Reach(*corners, grid.cell_size, reach / grid.cell_size, volume)
        momentum = (ti.ndarray(ti.i64, grid.size) for _ in range(3))
        self._sums = Sums(ti.ndarray(ti.i32, grid.size), *momentum, new_floats(grid.size))
        self._sums.inside.from_numpy(grid.pad(room_for_water(grid, domain, reach)).astype(np.float32).ravel())
        self._shortest_time = new_floats(1)
        self._gravity = float(np.linalg.norm(fluid.gravity))
        smoke.obstacles.movers.append(self)
        self.exchange(0.0)

    def stable_dt(self) -> float:
        """Largest step [s] in which no particle gets farther than a cell in the box, as far as is foreseen."""
        particles = self._fluid.particles
        moving = particles.position, particles.velocity, particles.count
        _find_shortest_time(self._reach, self._gravity, *moving, self._shortest_time)
        time_s = float(copied(self._shortest_time)[0])
        return time_s if time_s < NEVER else math.inf

    def reach(self, duration_s: float) -> list[NDArray[np.float64]]:  # noqa: ARG002  (the protocol of movers)
        """None: the air pushes no fluid."""
        return []

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Mark the cells that hold water now, after the steps of the fluid."""
        box, marks = self._smoke.obstacles.box, self._smoke.obstacles.marks
        particles = self._fluid.particles
        _splat(self._reach, box, self._sums, particles.position, particles.velocity, particles.count)
        _mark_water(box, self._sums, marks)


@kernel
def _find_shortest_time(
    reach: Reach, gravity: ti.f32, position: Vectors, velocity: Vectors, count: ti.i32, shortest: Floats
):
    """Least time in which a particle comes to the box and a cell into it, v t + g t² = d (`time_of_travel`)."""
    margin = reach.in_cells * reach.cell_size
    shortest[0] = NEVER
    for n in range(count):
        x_n = position[n]
        outside = ti.max(reach.low - margin - x_n, x_n - (reach.high + margin), 0.0)
        distance = outside.norm() + reach.cell_size
        speed = velocity[n].norm()
        root = speed + ti.sqrt(speed * speed + 4.0 * gravity * distance)
        if root > 0.0:
            ti.atomic_min(shortest[0], 2.0 * distance / root)


@kernel
def _splat(reach: Reach, box: Grid, sums: Sums, position: Vectors, velocity: Vectors, count: ti.i32):
    """Add every particle to the cells whose centres it reaches, in sums that begin at zero."""
    for at in range(sums.fraction.shape[0]):
        sums.fraction[at] = 0
        for momentum in ti.static((sums.momentum_x, sums.momentum_y, sums.momentum_z)):
            momentum[at] = ti.cast(0, ti.i64)
    for n in range(count):
        cells, width = cell_counts(box), reach.in_cells
        # In cells, such that the centre of cell i, counted from 1, is at i.
        x_n = (position[n] - reach.low) / reach.cell_size + 0.5
        if (x_n > 1.0 - width).all() and (x_n < ti.cast(cells, ti.f32) + width).all():
            low = ti.max(ti.cast(ti.floor(x_n - width), ti.i32) + 1, 1)
            high = ti.min(ti.cast(ti.ceil(x_n + width), ti.i32) - 1, cells)
            for i in range(low[0], high[0] + 1):
                weight_x = reach.volume * (1.0 - ti.abs(float(i) - x_n[0]) / width)
                for j in range(low[1], high[1] + 1):
                    weight_xy = weight_x * (1.0 - ti.abs(float(j) - x_n[1]) / width)
                    for k in range(low[2], high[2] + 1):
                        weight = weight_xy * (1.0 - ti.abs(float(k) - x_n[2]) / width)
                        at = row_start(box, i, j) + k
                        ti.atomic_add(sums.fraction[at], ti.round(weight / FRACTION_QUANTUM, ti.i32))
                        for axis, momentum in ti.static(enumerate((sums.momentum_x, sums.momentum_y, sums.momentum_z))):
                            share = weight * velocity[n][axis]
                            ti.atomic_add(momentum[at], ti.round(share / MOMENTUM_QUANTUM, ti.i64))


@kernel
def _mark_water(box: Grid, sums: Sums, marks: Marks):
    """Mark the corners of the cells that are water: on their surface, or inside where all cells around are."""
    for i, j in ti.ndrange((1, box.nx + 2), (1, box.ny + 2)):
        for k in range(1, box.nz + 2):
            beside, count, velocity = 0, 0, ti.math.vec3(0.0)
            for di, dj, dk in ti.static(ti.ndrange(2, 2, 2)):
                x, y, z = i - di, j - dj, k - dk
                if 0 < x <= box.nx and 0 < y <= box.ny and 0 < z <= box.nz:
                    beside += 1
                    at = row_start(box, x, y) + z
                    fraction = ti.cast(sums.fraction[at], ti.f32) * FRACTION_QUANTUM
                    if fraction > WATER * sums.inside[at]:
                        count += 1
                        for axis, momentum in ti.static(enumerate((sums.momentum_x, sums.momentum_y, sums.momentum_z))):
                            velocity[axis] += ti.cast(momentum[at], ti.f32) * (MOMENTUM_QUANTUM / fraction)
            if count > 0:
                distance = ti.select(count == beside, -1.0, 0.0)
                mark(marks, row_start(box, i, j) + k, distance, velocity / float(count), NOBODY)


def room_for_water(grid: SmokeGrid, domain: DomainParameters, reach: float) -> NDArray[np.float64]:
    """Part of the weight prod_a max(0, 1 - |q_a|) at each cell's centre that walls and static bodies leave, `cells`.

    Walls count exactly, bodies about as they fill cells. `BEYOND` where a centre is beyond a wall. The half-width of
    the weight along an axis is `reach` [m].
    """
    x, y, z = (parts_inside(grid, domain, reach, axis) for axis in range(3))
    room: NDArray[np.float64] = x[:, None, None].astype(np.float64) * y[None, :, None] * z[None, None, :]
    is_beyond = room >= BEYOND * LEAST_ROOM
    if grid.has_solids:
        solid = np.where(is_beyond, 0.0, _solid_parts(grid))  # what is behind a wall is missing already
        weights = cell_weights(reach / grid.cell_size)
        for axis in range(3):
            solid = _weighted_sum(solid, weights, axis)
        room = np.maximum(room - solid, LEAST_ROOM)
    return np.where(is_beyond, BEYOND, room)


def _solid_parts(grid: SmokeGrid) -> NDArray[np.float64]:
    """About how much of each cell static bodies fill."""
    inside, total = np.zeros(grid.cells), np.zeros(grid.cells)
    for corner in range(8):
        distance = cell_corners(grid.distance, corner)
        inside += np.maximum(-distance, 0.0)
        total += np.abs(distance)
    return np.where(grid.solid, 1.0, inside / np.maximum(total, ROUNDING))


def cell_weights(reach_in_cells: float) -> NDArray[np.float64]:
    """Integrals of the weight max(0, 1 - |x| / R) / R over the cells -n..n around a centre; their sum is 1."""
    last = math.ceil(reach_in_cells + 0.5) - 1
    edges = np.clip((np.arange(-last, last + 2) - 0.5) / reach_in_cells, -1.0, 1.0)
    weights: NDArray[np.float64] = np.diff(edges - 0.5 * edges * np.abs(edges))
    return weights


def _weighted_sum(values: NDArray[np.float64], weights: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Of the neighbours along an axis; nothing is beyond the array."""
    last = len(weights) // 2
    padding = [(last, last) if a == axis else (0, 0) for a in range(3)]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, padding), len(weights), axis=axis)
    total: NDArray[np.float64] = windows @ weights
    return total


def parts_inside(grid: SmokeGrid, domain: DomainParameters, reach: float, axis: int) -> NDArray[np.float32]:
    """Part of the weight max(0, 1 - |q|) along an axis that lies within the domain's closed faces, by cell, (n,).

    `BEYOND` where a cell's centre is beyond a closed face: no fraction of water makes it water.
    """
    centres = grid.origin[axis] + (np.arange(grid.cells[axis]) + 0.5) * grid.cell_size
    parts, is_beyond = np.ones(len(centres)), np.zeros(len(centres), bool)
    for face, distance in (
        (f"{'xyz'[axis]}-", centres - domain.min[axis]),
        (f"{'xyz'[axis]}+", domain.max[axis] - centres),
    ):
        if face not in domain.open_faces:
            parts -= 0.5 * (1.0 - np.clip(distance / reach, 0.0, 1.0)) ** 2
            is_beyond |= distance < 0.0
    # In a domain narrower than the reach at least half of it is inside: the two halves of the weight overlap.
    return np.where(is_beyond, BEYOND, np.maximum(parts, 0.5)).astype(np.float32)
