"""The fluid at one moment, sorted into cells, ready to be asked about points and potentials."""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cells import CellGrid, Cells, CellSort
from sim.whitewater.kernels import compute_normals, compute_potentials, sample_flow
from sim.whitewater.motion import FluidState

SUPPORT_IN_SPACINGS = 2.0
"""Support radius h over the lattice spacing, as in the simulation."""

FULL_NEIGHBORHOOD = 4.0 / 3.0 * math.pi * SUPPORT_IN_SPACINGS**3
"""Particles within h of a point in the bulk: 33.5; beside a flat surface half as many."""

# Integrals of W = 1 - r/h over a ball and over a disc: a quarter and a third of their sizes.
_FULL_WEIGHT = FULL_NEIGHBORHOOD / 4.0
_FULL_SURFACE_WEIGHT = math.pi * SUPPORT_IN_SPACINGS**2 / 3.0

_ANYWHERE = (3.0e38, 3.0e38, 3.0e38)


class FluidField:
    """Answers for the fluid of one moment after the other; `sim.runtime.initialize` must have run.

    Attributes:
        support_radius: h [m].
    """

    def __init__(self, bounds: NDArray[np.floating], particle_radius: float, capacity: int) -> None:
        """Make room.

        Args:
            bounds: lower and upper corner of a box about the fluid [m], (2, 3); particles may leave it a little.
            particle_radius: of the fluid [m].
            capacity: most fluid particles.
        """
        self.support_radius = SUPPORT_IN_SPACINGS * 2.0 * particle_radius
        self._grid = CellGrid.covering(bounds[0], bounds[1], self.support_radius)
        self._cells = CellSort(self._grid, capacity)
        self._order = np.zeros(0, np.int32)
        self._position = self._velocity = np.zeros((0, 3), np.float32)

    def update(self, state: FluidState) -> None:
        """Take the fluid's particles as they are now."""
        count = len(state.position)
        self._order = np.zeros(0, np.int32)
        if count:
            nowhere = (-_ANYWHERE[0], -_ANYWHERE[1], -_ANYWHERE[2])
            self._cells.sort(_device(state.position), _device(state.particle_id), count, nowhere, _ANYWHERE)
            self._order = self._cells.order.to_numpy()[:count]
        self._position = state.position[self._order]
        self._velocity = state.velocity[self._order]

    def potentials(self, min_speed: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Trapped air [m/s] and wave crest [-] of every particle, (n,) each, in the order of `update`.

        Both are 0 for particles slower than `min_speed` [m/s]. See `sim.whitewater.kernels.compute_potentials`.
        """
        count = len(self._position)
        trapped_air, wave_crest = np.zeros(count, np.float32), np.zeros(count, np.float32)
        if count == 0:
            return trapped_air, wave_crest
        normal = np.empty((count, 3), np.float32)
        compute_normals(self._position, count, *self._search, self.support_radius, normal)
        sorted_air, sorted_crest = np.empty(count, np.float32), np.empty(count, np.float32)
        compute_potentials(
            self._position, self._velocity, normal, count, *self._search, self.support_radius,
            min_speed, _FULL_WEIGHT, _FULL_SURFACE_WEIGHT, sorted_air, sorted_crest,
        )  # fmt: skip
        trapped_air[self._order], wave_crest[self._order] = sorted_air, sorted_crest
        return trapped_air, wave_crest

    def sample(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Velocity of the fluid at points (n, 3) [m/s], (n, 3), and the number of its particles within h, (n,)."""
        flow, neighbors = np.zeros((len(points), 3), np.float32), np.zeros(len(points), np.int32)
        if len(points) and len(self._position):
            sample_flow(
                np.ascontiguousarray(points, np.float32), len(points), self._position, self._velocity,
                *self._search, self.support_radius, flow, neighbors,
            )  # fmt: skip
        return flow, neighbors

    @property
    def _search(self) -> tuple[object, ...]:
        grid = self._grid
        return self._cells.cell_start, ti.math.vec3(*grid.origin), 1.0 / grid.cell_size, Cells(*grid.shape)


def _device(values: np.ndarray) -> ti.Ndarray:
    vectors = values.ndim == 2
    array = ti.Vector.ndarray(3, ti.f32, len(values)) if vectors else ti.ndarray(ti.i32, len(values))
    array.from_numpy(np.ascontiguousarray(values))
    return array
