"""The arrays of a particle fluid: physically sorted by cell, compacted when particles leave."""

from collections.abc import Mapping

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Vectors
from sim.cells import CellGrid, CellSort, SortedPoints
from sim.launch import fast_launch
from sim.neighbors import NeighborList, list_stride

HostArrays = Mapping[str, NDArray[np.generic]]


class ParticleSet:
    """Positions, velocities, phases and ids of the particles, with their neighbours.

    Solvers keep quantities of their own from step to step in `carried`: they move with the particles when those are
    sorted, and are part of every checkpoint.

    Attributes:
        count: particles that are there; the arrays are longer where some have left or may still come.
        position: (capacity,) of 3-vectors [m].
        velocity: (capacity,) of 3-vectors [m/s].
        particle_id: (capacity,), int32, distinct; stays with a particle for good.
        phase: (capacity,), int32, which of the fluids a particle belongs to.
        carried: scalars by name, (capacity,) each, float32.
        reference: x, y and z when the neighbours were last found [m]; within half a skin of where particles are.
        cells: the sort of the last rebuild.
        neighbors: fluid and boundary neighbours within support + skin.
    """

    def __init__(self, grid: CellGrid, capacity: int, *, carried: tuple[str, ...] = ()) -> None:
        self.count = 0
        self.position, self._position_out = _vectors(capacity), _vectors(capacity)
        self.velocity, self._velocity_out = _vectors(capacity), _vectors(capacity)
        self.particle_id, self._particle_id_out = _integers(capacity), _integers(capacity)
        self.phase, self._phase_out = _integers(capacity), _integers(capacity)
        self.carried = {name: _floats(capacity) for name in carried}
        self._carried_out = _floats(capacity) if carried else _floats(1)
        self.reference = (_floats(capacity), _floats(capacity), _floats(capacity))
        self.cells = CellSort(grid, capacity)
        self.neighbors = NeighborList(grid, capacity, stride=list_stride())

    @property
    def capacity(self) -> int:
        """Particles that the arrays have room for."""
        return self.position.shape[0]

    @property
    def sorted_points(self) -> SortedPoints:
        """Where the particles were when they were last sorted."""
        return SortedPoints(self.reference, self.cells.cell_start)

    def load(self, arrays: HostArrays) -> None:
        """Take particles from the host.

        Args:
            arrays: `position` (n, 3), `velocity` (n, 3), `particle_id` (n,) and `phase` (n,), n at most the capacity;
                carried scalars (n,) by name, 0 where there is none of the name.
        """
        self.count = len(arrays["particle_id"])
        for array, name in (
            (self.position, "position"),
            (self.velocity, "velocity"),
            (self.particle_id, "particle_id"),
            (self.phase, "phase"),
        ):
            array.from_numpy(_padded(arrays[name], self.capacity))
        for name, array in self.carried.items():
            values = arrays.get(name, np.zeros(self.count, dtype=np.float32))
            array.from_numpy(_padded(values, self.capacity))

    def append_layer(
        self,
        places: ti.Ndarray,
        moved: ti.math.vec3,
        velocity: ti.math.vec3,
        phase: int,
        free: ti.Ndarray,
        order: ti.Ndarray,
        count: int,
        added: int,
        first_id: int,
    ) -> None:
        """Add particles behind the others, their carried scalars 0; they have no neighbours before the next sort.

        Args:
            places: where they are [m], (count,) of 3-vectors.
            moved: and how far they all have moved from there [m].
            velocity: of all of them [m/s].
            phase: which of the fluids they are of.
            free: 1 for the places to take, else 0, (count,).
            order: number of taken places before each, (count,).
            count: number of places.
            added: number of places taken; there must be room for them.
            first_id: id of the first of them.
        """
        append_particles(
            places, moved, velocity, phase, free, order, count, self.count, first_id,
            self.position, self.velocity, self.particle_id, self.phase,
        )  # fmt: skip
        for values in self.carried.values():
            clear_scalars(values, self.count, added)
        self.count += added

    def host_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Copies of what `load` takes, in the order of the particles."""
        arrays = {
            "position": self.position,
            "velocity": self.velocity,
            "particle_id": self.particle_id,
            "phase": self.phase,
            **self.carried,
        }
        return {name: self.host(array) for name, array in arrays.items()}

    def sort(self, keep_low: tuple[float, float, float], keep_high: tuple[float, float, float]) -> int:
        """Sort the particles by cell and id and drop those outside; returns how many were dropped."""
        before = self.count
        self.count = self.cells.sort(self.position, self.particle_id, before, keep_low, keep_high)
        reorder_particles(
            self.cells.order, self.count,
            self.position, self.velocity, self.particle_id, self.phase,
            self._position_out, self._velocity_out, self._particle_id_out, self._phase_out, *self.reference,
        )  # fmt: skip
        self.position, self._position_out = self._position_out, self.position
        self.velocity, self._velocity_out = self._velocity_out, self.velocity
        self.particle_id, self._particle_id_out = self._particle_id_out, self.particle_id
        self.phase, self._phase_out = self._phase_out, self.phase
        for name, values in self.carried.items():
            reorder_scalars(self.cells.order, self.count, values, self._carried_out)
            self.carried[name], self._carried_out = self._carried_out, values
        return before - self.count

    def host(self, array: ti.Ndarray) -> NDArray[np.generic]:
        """A copy of one of the arrays on the host, without the room for particles that are not there."""
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


@fast_launch
@ti.kernel
def reorder_particles(
    order: Integers, count: ti.i32,
    position: Vectors, velocity: Vectors, particle_id: Integers, phase: Integers,
    position_out: Vectors, velocity_out: Vectors, particle_id_out: Integers, phase_out: Integers,
    reference_x: Floats, reference_y: Floats, reference_z: Floats,
):  # fmt: skip
    """Move particles to where the sort puts them, and note their positions."""
    for k in range(count):
        i = order[k]
        x_i = position[i]
        position_out[k] = x_i
        velocity_out[k] = velocity[i]
        particle_id_out[k] = particle_id[i]
        phase_out[k] = phase[i]
        reference_x[k] = x_i[0]
        reference_y[k] = x_i[1]
        reference_z[k] = x_i[2]


@fast_launch
@ti.kernel
def reorder_scalars(order: Integers, count: ti.i32, values: Floats, values_out: Floats):
    """Move one carried quantity to where the sort puts the particles."""
    for k in range(count):
        values_out[k] = values[order[k]]


@fast_launch
@ti.kernel
def append_particles(
    places: Vectors, moved: ti.math.vec3, inflow: ti.math.vec3, number: ti.i32, free: Integers, order: Integers,
    count: ti.i32, first: ti.i32, first_id: ti.i32,
    position: Vectors, velocity: Vectors, particle_id: Integers, phase: Integers,
):  # fmt: skip
    """Write the particles of the free places behind the first ones."""
    for k in range(count):
        if free[k] != 0:
            i = first + order[k]
            position[i] = places[k] + moved
            velocity[i] = inflow
            particle_id[i] = first_id + order[k]
            phase[i] = number


@fast_launch
@ti.kernel
def clear_scalars(values: Floats, first: ti.i32, count: ti.i32):
    """Set a carried quantity of new particles to 0."""
    for i in range(first, first + count):
        values[i] = 0.0
