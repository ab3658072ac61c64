"""Water as an obstacle for smoke and air."""

from typing import TYPE_CHECKING

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Vectors
from sim.scene import DomainParameters

if TYPE_CHECKING:
    from sim.fluid.forces import SPHFluid
    from sim.smoke.solver import SmokeSolver

REACH_IN_SPACINGS = 2.0
"""Least half-width of the weight of a particle: a lone one then fills an eighth of the place where it is, and leaves no
holes between it and its neighbours, however small the cells."""

WATER = 0.5
"""Fraction of water above which a cell is water: where a flat surface cuts the cell's centre."""

BEYOND = 1.0e9
"""More than any fraction; products of three are still finite."""

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
    beside closed faces of the domain is made up for by dividing by the part of the weight that is inside. A lone drop
    blocks no air, nor does a sheet of one layer of particles; two layers do where cells are as fine as particles.

    Sums are integers, so that their order does not matter.

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
        parts = [parts_inside(grid.origin, grid.cell_size, grid.cells, domain, reach, axis) for axis in range(3)]
        self._inside_x, self._inside_y, self._inside_z = (ti.field(ti.f32, shape=len(part)) for part in parts)
        for field, part in zip((self._inside_x, self._inside_y, self._inside_z), parts, strict=True):
            field.from_numpy(part)
        self._fastest = ti.field(ti.f32, shape=())
        self.exchange(0.0)

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Mark the cells that hold water now, after the steps of the fluid."""
        self._find_water(is_marking=True)

    def follow(self, dt: float) -> None:
        """Water does not feel the air."""

    def resume(self) -> None:
        """Tell the restored smoke how fast the restored water is; its cells it has saved itself."""
        self._find_water(is_marking=False)

    def _find_water(self, *, is_marking: bool) -> None:
        particles = self._fluid.particles
        self._clear_sums()
        self._splat(particles.position, particles.velocity, particles.count)
        self._mark_water(int(is_marking))
        self._smoke.obstacles.expect(self._fluid.name, float(np.sqrt(self._fastest[None])))

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
    def _mark_water(self, is_marking: ti.i32):
        """Mark the cells that are water, and find the largest of their squared speeds."""
        self._fastest[None] = 0.0
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            inside_xy = self._inside_x[i - 1] * self._inside_y[j - 1]
            for k in range(1, self._nz + 1):
                at = i * self._step_x + j * self._step_y + k
                fraction = ti.cast(self._fraction[at], ti.f32) * FRACTION_QUANTUM
                if fraction > WATER * inside_xy * self._inside_z[k - 1]:
                    momentum = ti.Vector(
                        [
                            ti.cast(self._momentum_x[at], ti.f32),
                            ti.cast(self._momentum_y[at], ti.f32),
                            ti.cast(self._momentum_z[at], ti.f32),
                        ]
                    )
                    velocity = momentum * (MOMENTUM_QUANTUM / fraction)
                    ti.atomic_max(self._fastest[None], velocity.norm_sqr())
                    if is_marking:
                        self._smoke.obstacles.mark(i, j, k, velocity)


def parts_inside(
    origin: tuple[float, float, float],
    cell_size: float,
    cells: tuple[int, int, int],
    domain: DomainParameters,
    reach: float,
    axis: int,
) -> NDArray[np.float32]:
    """Part of the weight max(0, 1 - |q|) along an axis that lies within the domain's closed faces, by cell, (n,).

    `BEYOND` where a cell's centre is beyond a closed face: no fraction of water makes it water.

    Args:
        origin: lower corner of the cells [m].
        cell_size: [m].
        cells: how many along each axis.
        domain: whose open faces end nothing.
        reach: half-width of the weight [m].
        axis: 0, 1 or 2.
    """
    centres = origin[axis] + (np.arange(cells[axis]) + 0.5) * cell_size
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
