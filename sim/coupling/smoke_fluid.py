"""Water as an obstacle for smoke and air."""

import math
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.core.arrays import Vectors
from sim.core.domain import DomainParameters
from sim.coupling.water_room import room_for_water

if TYPE_CHECKING:
    from sim.fluid.fluid import SPHFluid
    from sim.smoke.solver import SmokeSolver

REACH_IN_SPACINGS = 2.0
"""Least half-width of the weight of a particle: a lone one then fills an eighth of the place where it is, and leaves no
holes between it and its neighbours, however small the cells."""

WATER = 0.5
"""Fraction of water above which a cell is water: where a flat surface cuts the cell's centre."""

NEVER = 1.0e30
"""Time in which weightless particles at rest get anywhere [s]."""

FRACTION_QUANTUM = 2.0**-20
"""Unit of the sums of volume fractions [-]; they hold up to 2048."""

MOMENTUM_QUANTUM = 2.0**-40
"""Unit of the sums of volume fraction times velocity [m/s]; they hold up to 8e6."""


@ti.data_oriented
class SmokeFluidCoupling:
    """Air cannot enter water, and moves with its surface.

    A coupled step of the smoke: the fluid takes its own, shorter steps; then the cells that hold water are marked as
    obstacles with the velocity of the water in them, and the smoke steps around them. One way: water does not feel
    air, which weighs a thousandth of it.

    The volume fraction of water at the centre of a cell is

        phi = sum_i d³ prod_a w((x - x_i)_a / R) / R,   w(q) = max(0, 1 - |q|),

    with R twice the spacing d of particles, or a cell's edge if that is longer: then it is a mean over the cell and
    half of each of its neighbours. For a lattice of particles it is 1 inside, and 1/2 on a flat surface. What it lacks
    beside closed faces of the domain and static bodies is made up for by dividing by the part of the weight that is
    free of them, of static bodies as the cells have them. A lone drop
    blocks no air, nor does a sheet of one layer of particles; two layers do where cells are as fine as particles.

    Sums are integers, so that their order does not matter.

    Steps are cut so that no particle gets farther than a cell within its reach of the box, with its velocity and
    gravity. What pressure gives it in a step of the smoke is not foreseen, nor are particles that an emitter has yet to
    let in: they count from the next step on.

    Attributes:
        bodies: names of the fluid's solver and of the smoke.
    """

    is_loose = True

    def __init__(self, fluid: "SPHFluid", smoke: "SmokeSolver", *, domain: DomainParameters) -> None:
        """Couple the two; the first water is marked, and is there once the smoke has moved its obstacles.

        Args:
            fluid: all fluids of the tank.
            smoke: made for obstacles that move.
            domain: its closed faces hold the fluid.
        """
        self.bodies = (fluid.name, smoke.name)
        self._fluid, self._smoke = fluid, smoke
        grid = smoke.grid
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y, self._size = grid.padded[1] * grid.padded[2], grid.padded[2], grid.size
        reach = max(REACH_IN_SPACINGS * fluid.spacing, grid.cell_size)
        self._reach_in_cells = reach / grid.cell_size
        self._volume_over_reach = (fluid.spacing / reach) ** 3
        self._fraction = ti.field(ti.i32, shape=grid.size)
        self._momentum_x, self._momentum_y, self._momentum_z = (ti.field(ti.i64, shape=grid.size) for _ in range(3))
        self._inside = ti.field(ti.f32, shape=grid.size)
        self._inside.from_numpy(grid.pad(room_for_water(grid, domain, reach)).astype(np.float32).ravel())
        self._shortest_time = ti.field(ti.f32, shape=())
        self._gravity = float(np.linalg.norm(fluid.gravity))
        smoke.obstacles.movers.append(self)
        self.exchange(0.0)

    def stable_dt(self) -> float:
        """Largest step [s] in which no particle gets farther than a cell in the box, as far as is foreseen."""
        particles = self._fluid.particles
        self._find_shortest_time(particles.position, particles.velocity, particles.count)
        time_s = float(self._shortest_time[None])
        return time_s if time_s < NEVER else math.inf

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Mark the cells that hold water now, after the steps of the fluid."""
        particles = self._fluid.particles
        self._clear_sums()
        self._splat(particles.position, particles.velocity, particles.count)
        self._mark_water()

    def follow(self, dt: float) -> None:
        """Water does not feel the air."""

    def resume(self) -> None:
        """Which cells were water the smoke has saved itself."""

    @ti.kernel
    def _find_shortest_time(self, position: Vectors, velocity: Vectors, count: ti.i32):
        """Least time in which a particle comes to the box and a cell into it, v t + g t² = d (`time_of_travel`)."""
        size = ti.static(self._smoke.grid.cell_size)
        low = ti.Vector(ti.static(self._smoke.grid.origin)) - ti.static(self._reach_in_cells) * size
        high = ti.Vector(ti.static(self._smoke.grid.upper)) + ti.static(self._reach_in_cells) * size
        gravity = ti.static(self._gravity)
        self._shortest_time[None] = NEVER
        for n in range(count):
            x_n = position[n]
            distance = ti.max(low - x_n, x_n - high, 0.0).norm() + size
            speed = velocity[n].norm()
            root = speed + ti.sqrt(speed * speed + 4.0 * gravity * distance)
            if root > 0.0:
                ti.atomic_min(self._shortest_time[None], 2.0 * distance / root)

    @ti.kernel
    def _clear_sums(self):
        for at in range(self._size):
            self._fraction[at] = 0
            for momentum in ti.static((self._momentum_x, self._momentum_y, self._momentum_z)):
                momentum[at] = ti.cast(0, ti.i64)

    @ti.kernel
    def _splat(self, position: Vectors, velocity: Vectors, count: ti.i32):
        """Add every particle to the cells whose centres it reaches."""
        origin, size = ti.static(self._smoke.grid.origin, self._smoke.grid.cell_size)
        reach = ti.static(self._reach_in_cells)
        cells = ti.Vector([self._nx, self._ny, self._nz])
        for n in range(count):
            # In cells, such that the centre of cell i, counted from 1, is at i.
            x_n = (position[n] - ti.Vector(origin)) / size + 0.5
            if (x_n > 1.0 - reach).all() and (x_n < ti.cast(cells, ti.f32) + reach).all():
                low = ti.max(ti.cast(ti.floor(x_n - reach), ti.i32) + 1, 1)
                high = ti.min(ti.cast(ti.ceil(x_n + reach), ti.i32) - 1, cells)
                for i in range(low[0], high[0] + 1):
                    weight_x = self._volume_over_reach * (1.0 - ti.abs(float(i) - x_n[0]) / reach)
                    for j in range(low[1], high[1] + 1):
                        weight_xy = weight_x * (1.0 - ti.abs(float(j) - x_n[1]) / reach)
                        for k in range(low[2], high[2] + 1):
                            weight = weight_xy * (1.0 - ti.abs(float(k) - x_n[2]) / reach)
                            at = i * self._step_x + j * self._step_y + k
                            ti.atomic_add(self._fraction[at], ti.round(weight / FRACTION_QUANTUM, ti.i32))
                            for axis, momentum in ti.static(
                                enumerate((self._momentum_x, self._momentum_y, self._momentum_z))
                            ):
                                share = weight * velocity[n][axis]
                                ti.atomic_add(momentum[at], ti.round(share / MOMENTUM_QUANTUM, ti.i64))

    @ti.kernel
    def _mark_water(self):
        """Mark the cells that are water."""
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            for k in range(1, self._nz + 1):
                at = i * self._step_x + j * self._step_y + k
                fraction = ti.cast(self._fraction[at], ti.f32) * FRACTION_QUANTUM
                if fraction > WATER * self._inside[at]:
                    momentum = ti.Vector(
                        [
                            ti.cast(self._momentum_x[at], ti.f32),
                            ti.cast(self._momentum_y[at], ti.f32),
                            ti.cast(self._momentum_z[at], ti.f32),
                        ]
                    )
                    velocity = momentum * (MOMENTUM_QUANTUM / fraction)
                    self._smoke.obstacles.mark(i, j, k, velocity)
