"""The particles of a tank: sorted by cell, compacted when particles leave, and of one material or several."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle
from sim.core.cells import CellGrid, CellSort, SortedPoints
from sim.core.host_access import copied
from sim.core.launch import kernel
from sim.core.neighbors import NeighborList, Neighbors, list_stride
from sim.core.parameters import Vector3
from sim.fluid.boundary import Samples
from sim.fluid.parameters import FluidParameters

HOST_NAMES = ("position", "velocity", "particle_id", "phase")


@bundle
class Particles(NamedTuple):
    """Particles as kernels read them, (capacity,) each."""

    position: Vectors  # [m]
    velocity: Vectors  # [m/s]
    particle_id: Integers  # distinct; stays with a particle for good
    phase: Integers  # number of its fluid
    density: Floats  # relative to the rest density [-]; of the positions at which it was computed last
    count: ti.i32  # particles that are there


@bundle
class Layer(NamedTuple):
    """Particles that may come, (n,) each."""

    places: Vectors  # where they are [m]
    velocities: Vectors  # [m/s]
    count: ti.i32
    phase: ti.i32  # number of their fluid
    free: Integers  # 1 for the places to take, else 0
    order: Integers  # number of taken places before each, (n + 1,)
    first_id: ti.i32  # id of the first particle


class ParticleSet:
    """Positions, velocities, phases and ids of the particles, with their neighbours.

    Solvers keep quantities of their own from step to step in `carried`: they move with the particles when those are
    sorted, and are part of every checkpoint.

    Attributes:
        arrays: the particles as kernels read them; other ones after every sort.
        carried: scalars by name, (capacity,) each, float32.
        sorted_points: where the particles were when they were last sorted, within half a skin of where they are.
        cells: the sort of the last rebuild.
        neighbors: fluid and boundary neighbours within support + skin.
    """

    def __init__(self, grid: CellGrid, capacity: int, *, carried: tuple[str, ...] = ()) -> None:
        places = max(capacity, 1)
        density = ti.ndarray(ti.f32, places)
        self.arrays, self._spare = (
            Particles(
                *(ti.Vector.ndarray(3, ti.f32, places) for _ in range(2)),
                *(ti.ndarray(ti.i32, places) for _ in range(2)),
                density,
                0,
            )
            for _ in range(2)
        )
        self.carried = {name: ti.ndarray(ti.f32, places) for name in carried}
        self._carried_out = ti.ndarray(ti.f32, places)
        self.cells = CellSort(grid, capacity)
        self.sorted_points = SortedPoints(*(ti.ndarray(ti.f32, places) for _ in range(3)), self.cells.cell_start)
        self.neighbors = NeighborList(grid, capacity, stride=list_stride())

    @property
    def count(self) -> int:
        """Particles that are there; the arrays are longer where some have left or may still come."""
        return self.arrays.count

    @property
    def capacity(self) -> int:
        """Particles that the arrays have room for."""
        return int(self.position.shape[0])

    @property
    def position(self) -> ti.Ndarray:
        """Positions [m], (capacity,) of 3-vectors."""
        return self.arrays.position

    @property
    def velocity(self) -> ti.Ndarray:
        """Velocities [m/s], (capacity,) of 3-vectors."""
        return self.arrays.velocity

    @property
    def density(self) -> ti.Ndarray:
        """Densities relative to the rest density [-], (capacity,)."""
        return self.arrays.density

    def load(self, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Take `position` and `velocity` (n, 3), `particle_id` and `phase` (n,) from the host, n at most the capacity.

        Carried scalars (n,) by name, too; 0 where there is none of the name.
        """
        count = len(arrays["particle_id"])
        self.arrays = self.arrays._replace(count=count)
        for name in HOST_NAMES:
            getattr(self.arrays, name).from_numpy(_padded(arrays[name], self.capacity))
        for name, array in self.carried.items():
            array.from_numpy(_padded(arrays.get(name, np.zeros(count, dtype=np.float32)), self.capacity))

    def append(self, layer: Layer, added: int, carried: Mapping[str, float]) -> None:
        """Add the particles of the places to take, as many as `added`; without neighbours before the next sort.

        Carried scalars are those given by name, and 0 where there is none of the name.
        """
        append_particles(layer, self.arrays)
        for name, values in self.carried.items():
            fill_scalars(values, self.count, added, carried.get(name, 0.0))
        self.arrays = self.arrays._replace(count=self.count + added)

    def host_arrays(self) -> dict[str, NDArray[np.generic]]:
        """Copies of what `load` takes, in the order of the particles."""
        arrays = {name: getattr(self.arrays, name) for name in HOST_NAMES} | self.carried
        return {name: self.host(array) for name, array in arrays.items()}

    def sort(self, keep_low: Vector3, keep_high: Vector3) -> int:
        """Sort the particles by cell and id and drop those outside; returns how many were dropped."""
        before = self.arrays
        count = self.cells.sort(before.position, before.particle_id, before.count, keep_low, keep_high)
        self.arrays, self._spare = self._spare._replace(count=count), before
        reorder_particles(self.cells.order, before, self.arrays, self.sorted_points)
        for name, values in self.carried.items():
            reorder_scalars(self.cells.order, count, values, self._carried_out)
            self.carried[name], self._carried_out = self._carried_out, values
        return before.count - count

    def host(self, array: ti.Ndarray) -> NDArray[np.generic]:
        """Copy of an array (capacity,) on the host, without the room for particles that are not there."""
        return copied(array)[: self.count]

    def order_by_id(self) -> NDArray[np.int64]:
        """Indices of the particles by ascending id, (n,)."""
        return np.argsort(self.host(self.arrays.particle_id))


def _padded(rows: NDArray[np.generic], length: int) -> NDArray[np.generic]:
    padded = np.zeros((length, *rows.shape[1:]), dtype=rows.dtype)
    padded[: len(rows)] = rows
    return padded


@kernel
def reorder_particles(order: Integers, before: Particles, after: Particles, reference: SortedPoints):
    """Particles where the sort puts them, and their positions as the search reads them."""
    for k in range(after.count):
        i = order[k]
        x_i = before.position[i]
        after.position[k] = x_i
        after.velocity[k] = before.velocity[i]
        after.particle_id[k] = before.particle_id[i]
        after.phase[k] = before.phase[i]
        reference.x[k] = x_i[0]
        reference.y[k] = x_i[1]
        reference.z[k] = x_i[2]


@kernel
def reorder_scalars(order: Integers, count: ti.i32, values: Floats, values_out: Floats):
    """One carried quantity where the sort puts the particles."""
    for k in range(count):
        values_out[k] = values[order[k]]


@kernel
def append_particles(layer: Layer, particles: Particles):
    """Particles of the free places behind all others."""
    for k in range(layer.count):
        if layer.free[k] != 0:
            i = particles.count + layer.order[k]
            particles.position[i] = layer.places[k]
            particles.velocity[i] = layer.velocities[k]
            particles.particle_id[i] = layer.first_id + layer.order[k]
            particles.phase[i] = layer.phase


@kernel
def fill_scalars(values: Floats, first: ti.i32, count: ti.i32, value: ti.f32):
    """One value for a carried quantity of new particles."""
    for i in range(first, first + count):
        values[i] = value


@bundle
class Materials(NamedTuple):
    """Materials by number, (k,) each."""

    rest_density: Floats  # rho0 [kg/m³]
    dynamic_viscosity: Floats  # mu = rho0 nu [Pa s]
    surface_tension: Floats  # coefficient, in the unit of its model
    several: ti.template()  # whether there is more than one


class Phases:
    """Materials by number, one of which each particle has as its `phase`.

    Attributes:
        parameters: of each fluid.
        names: of each fluid.
        rest_densities: rho0 of each [kg/m³], (k,), float64, on the host.
        viscosities: nu of each [m²/s], (k,), float64, on the host.
        materials: of all of them on the device, float32.
    """

    def __init__(self, parameters: Sequence[FluidParameters]) -> None:
        self.parameters = tuple(parameters)
        self.names = tuple(fluid.name for fluid in parameters)
        self.rest_densities = np.array([fluid.rest_density for fluid in parameters])
        self.viscosities = np.array([fluid.viscosity for fluid in parameters])
        self.materials = Materials(
            rest_density=on_device(self.rest_densities),
            dynamic_viscosity=on_device(self.rest_densities * self.viscosities),
            surface_tension=on_device(np.array([fluid.surface_tension for fluid in parameters])),
            several=len(self.parameters) > 1,
        )

    def set_viscosities(self, viscosities: NDArray[np.float64]) -> None:
        """Change nu of each fluid [m²/s], (k,), in the arrays that solvers hold."""
        self.viscosities[:] = viscosities
        self.materials.dynamic_viscosity.from_numpy((self.rest_densities * viscosities).astype(np.float32))

    def __len__(self) -> int:
        return len(self.parameters)

    @property
    def shared(self) -> FluidParameters:
        """The first fluid, for what all fluids of a tank have in common: solver, particle radius, time step."""
        return self.parameters[0]

    @property
    def density_contrast(self) -> float:
        """Largest rest density over the smallest."""
        return float(self.rest_densities.max() / self.rest_densities.min())


@bundle
class Fluid(NamedTuple):
    """Particles with their neighbours, and the kernel over them: what sums over neighbours read."""

    particles: Particles
    near: Neighbors
    samples: Samples  # of the boundary
    materials: Materials
    volume: ti.f32  # V of a particle [m³]
    sigma: ti.f32  # factor of the kernel, 8/(pi h³) [1/m³]
    inverse_support: ti.f32  # 1/h [1/m]
