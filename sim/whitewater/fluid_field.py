"""The fluid at one moment, sorted into cells: its potentials, and its flow at any points."""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import on_device
from sim.core.cells import CellGrid, CellSort
from sim.whitewater.kernels import Fluid, compute_normals, compute_potentials, sample_flow
from sim.whitewater.motion import FluidState

SUPPORT_IN_SPACINGS = 2.0
"""Support radius h over the lattice spacing, as in the simulation."""

FULL_NEIGHBORHOOD = 4.0 / 3.0 * math.pi * SUPPORT_IN_SPACINGS**3
"""Particles within h of a point in the bulk: 33.5; beside a flat surface half as many."""

# Integrals of W = 1 - r/h over a ball and over a disc: a quarter and a third of their sizes.
_FULL_WEIGHT = FULL_NEIGHBORHOOD / 4.0
_FULL_SURFACE_WEIGHT = math.pi * SUPPORT_IN_SPACINGS**2 / 3.0

_ANYWHERE = (-3.0e38,) * 3, (3.0e38,) * 3


class FluidField:
    """Fluid at one moment after the other; `sim.core.runtime.initialize` must have run.

    Attributes:
        support_radius: h [m].
    """

    def __init__(self, bounds: NDArray[np.floating], particle_radius: float, capacity: int) -> None:
        """Make room for particles of this radius [m] in a box [m], (2, 3), which they may leave a little."""
        self.support_radius = SUPPORT_IN_SPACINGS * 2.0 * particle_radius
        self._grid = CellGrid.covering(bounds[0], bounds[1], self.support_radius)
        self._cells = CellSort(self._grid, capacity)
        self._order = np.zeros(0, np.int32)
        self._fluid: Fluid | None = None

    def update(self, state: FluidState) -> None:
        """Take the fluid's particles as they are now."""
        count = len(state.position)
        self._order, self._fluid = np.zeros(0, np.int32), None
        if not count:
            return
        self._cells.sort(on_device(state.position), on_device(state.particle_id), count, *_ANYWHERE)
        self._order = self._cells.order.to_numpy()[:count]
        self._fluid = Fluid(
            on_device(state.position[self._order]),
            on_device(state.velocity[self._order]),
            count,
            self._cells.cell_start,
            self._grid.on_device,
            self.support_radius,
        )

    def potentials(self, min_speed: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Trapped air [m/s] and wave crest [-] of every particle, (n,) each, in the order of `update`.

        Both are 0 for particles slower than `min_speed` [m/s]. See `sim.whitewater.kernels.compute_potentials`.
        """
        count = len(self._order)
        trapped_air, wave_crest = np.zeros(count, np.float32), np.zeros(count, np.float32)
        if self._fluid is None:
            return trapped_air, wave_crest
        normal = ti.Vector.ndarray(3, ti.f32, count)
        compute_normals(self._fluid, normal)
        air, crest = ti.ndarray(ti.f32, count), ti.ndarray(ti.f32, count)
        compute_potentials(self._fluid, normal, min_speed, _FULL_WEIGHT, _FULL_SURFACE_WEIGHT, air, crest)
        trapped_air[self._order], wave_crest[self._order] = air.to_numpy(), crest.to_numpy()
        return trapped_air, wave_crest

    def sample(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Velocity of the fluid at points (n, 3) [m/s], (n, 3), and the number of its particles within h, (n,)."""
        count = len(points)
        if not count or self._fluid is None:
            return np.zeros((count, 3), np.float32), np.zeros(count, np.int32)
        flow, neighbors = ti.Vector.ndarray(3, ti.f32, count), ti.ndarray(ti.i32, count)
        sample_flow(on_device(points), count, self._fluid, flow, neighbors)
        return flow.to_numpy(), neighbors.to_numpy()
