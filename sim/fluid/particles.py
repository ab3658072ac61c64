"""The arrays of a particle fluid: physically sorted by cell, compacted when particles leave."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.neighbors import CellGrid, CellSort, Floats, Integers, NeighborList, Vectors

EXPECTED_NEIGHBORS = 40
"""First capacity of the neighbour list per particle; it grows when it must."""


class ParticleSet:
    """Positions, velocities and ids of the particles, with their neighbours.

    Attributes:
        count: particles that are still there; the arrays are longer after some have left.
        position: (capacity,) of 3-vectors [m].
        velocity: (capacity,) of 3-vectors [m/s].
        particle_id: (capacity,), int32, distinct; stays with a particle for good.
        reference: x, y and z when the neighbours were last found [m]; within half a skin of where particles are.
        cells: the sort of the last rebuild.
        neighbors: fluid and boundary neighbours within support + skin.
    """

    def __init__(self, positions: NDArray[np.float32], velocities: NDArray[np.float32], grid: CellGrid) -> None:
        capacity = len(positions)
        self.count = capacity
        self.position, self._position_out = _vectors(capacity), _vectors(capacity)
        self.velocity, self._velocity_out = _vectors(capacity), _vectors(capacity)
        self.particle_id, self._particle_id_out = _integers(capacity), _integers(capacity)
        self.reference = (_floats(capacity), _floats(capacity), _floats(capacity))
        self.cells = CellSort(grid, capacity)
        self.neighbors = NeighborList(grid, capacity, EXPECTED_NEIGHBORS)
        self.load(positions, velocities, np.arange(capacity, dtype=np.int32))

    @property
    def capacity(self) -> int:
        """Particles that the arrays have room for."""
        return self.position.shape[0]

    def load(self, positions: NDArray[np.float32], velocities: NDArray[np.float32], ids: NDArray[np.int32]) -> None:
        """Take particles from host arrays, (n, 3), (n, 3) and (n,); n is at most the capacity."""
        self.count = len(positions)
        self.position.from_numpy(_padded(positions, self.capacity))
        self.velocity.from_numpy(_padded(velocities, self.capacity))
        self.particle_id.from_numpy(_padded(ids, self.capacity))

    def sort(self, keep_low: tuple[float, float, float], keep_high: tuple[float, float, float]) -> int:
        """Sort the particles by cell and id and drop those outside; returns how many were dropped."""
        before = self.count
        self.count = self.cells.sort(self.position, self.particle_id, before, keep_low, keep_high)
        reorder_particles(
            self.cells.order, self.count,
            self.position, self.velocity, self.particle_id,
            self._position_out, self._velocity_out, self._particle_id_out, *self.reference,
        )  # fmt: skip
        self.position, self._position_out = self._position_out, self.position
        self.velocity, self._velocity_out = self._velocity_out, self.velocity
        self.particle_id, self._particle_id_out = self._particle_id_out, self.particle_id
        return before - self.count

    def host(self, array: ti.Ndarray) -> NDArray[np.generic]:
        """A copy of one of the arrays on the host, without the room for particles that have left."""
        return array.to_numpy()[: self.count]


def _vectors(length: int) -> ti.Ndarray:
    return ti.Vector.ndarray(3, ti.f32, max(length, 1))


def _floats(length: int) -> ti.Ndarray:
    return ti.ndarray(ti.f32, max(length, 1))


def _integers(length: int) -> ti.Ndarray:
    return ti.ndarray(ti.i32, max(length, 1))


def _padded(rows: NDArray[np.generic], length: int) -> NDArray[np.generic]:
    padded = np.zeros((length, *rows.shape[1:]), dtype=rows.dtype)
    padded[: len(rows)] = rows
    return padded


@ti.kernel
def reorder_particles(
    order: Integers, count: ti.i32,
    position: Vectors, velocity: Vectors, particle_id: Integers,
    position_out: Vectors, velocity_out: Vectors, particle_id_out: Integers,
    reference_x: Floats, reference_y: Floats, reference_z: Floats,
):  # fmt: skip
    """Move particles to where the sort puts them, and note their positions."""
    for k in range(count):
        i = order[k]
        x_i = position[i]
        position_out[k] = x_i
        velocity_out[k] = velocity[i]
        particle_id_out[k] = particle_id[i]
        reference_x[k] = x_i[0]
        reference_y[k] = x_i[1]
        reference_z[k] = x_i[2]
