"""Springs as explicit forces: symplectic Euler, the reference mode, with the longest step that is stable."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.sparse import coo_array

from sim.cloth.bundles import Nodes, SpringArrays
from sim.cloth.device_cells import DeviceCells, compute_cell_forces
from sim.cloth.device_springs import TINY_LENGTH, DeviceSprings, coefficient, span
from sim.cloth.springs import longest_explicit_step
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.launch import kernel


class ExplicitSprings:
    """Forces -k (C + tau dC/dt) c_a d/|d| on the velocities, before nodes move.

    Energy does not drift without damping: symplectic Euler keeps a nearby one. Forces of springs are stored, and each
    node gathers its own in a fixed order.
    """

    def __init__(self, state: ClothState, springs: Sequence[DeviceSprings], cells: Sequence[DeviceCells]) -> None:
        self._state, self._springs, self._cells = state, springs, cells
        counts = [family.count for family in springs] + [2 * family.count for family in cells]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        acting = [(family.host.nodes, family.host.coefficients) for family in springs]
        for host in (family.host for family in cells):  # two forces each, which act along d_u and d_v
            both = np.stack([host.along, host.across], axis=1).reshape(-1, host.arity)
            acting.append((np.repeat(host.nodes, 2, axis=0), both))
        numbered = zip(self._first[:-1], acting, strict=True)
        forces = [np.repeat(first + np.arange(len(nodes)), nodes.shape[1]) for first, (nodes, _) in numbered]
        nodes, coefficients = (np.concatenate([each.ravel() for each in part]) for part in zip(*acting, strict=True))
        shape = state.vertex_count, int(self._first[-1])
        gathered = coo_array((coefficients, (nodes, np.concatenate(forces))), shape=shape).tocsr()
        self._start, self._spring, self._coefficient = (
            on_device(each) for each in (gathered.indptr, gathered.indices, gathered.data)
        )
        self._force = ti.Vector.ndarray(3, ti.f32, int(self._first[-1]))

    def take_parameters(self) -> None:
        """Springs hold their own stiffness."""

    def excess(self, dt: float) -> Callable[[], NDArray[np.float64]]:  # noqa: ARG002  (the integrators' protocol)
        """None: springs are as long as their forces make them."""
        return lambda: np.zeros(len(self._state.names))

    def diagnostics(self) -> Mapping[str, float]:
        """None of its own."""
        return {}

    def stable_dt(self, cloths: NDArray[np.bool_] | None = None) -> float:
        """Longest step that is stable for some of the cloths, or all [s]."""
        families = [(each.host, (1.0 + each.poisson) * each.stiffness, each.damping) for each in self._springs]
        cells = [(each.host, each.law) for each in self._cells]
        inverse_mass = self._state.inverse_mass.to_numpy()
        if cloths is not None:
            inverse_mass[~cloths[self._state.host.body]] = 0.0
        return longest_explicit_step(families, cells, inverse_mass)

    def accelerate(self, dt: float) -> None:
        """Give the springs' impulses of a step of dt [s] to the velocities."""
        state = self._state
        for first, springs in zip(self._first, self._springs, strict=False):
            springs.contract(state.nodes, state.carry)
            compute_spring_forces(springs.on_device, state.nodes, int(first), springs.arity, self._force)
        for first, cells in zip(self._first[len(self._springs) :], self._cells, strict=False):
            cells.measure_strains(state.nodes, is_damped=True)
            compute_cell_forces(cells.on_device, state.nodes, int(first), cells.arity, self._force)
        gather_spring_forces(
            self._start, self._spring, self._coefficient, self._force, state.inverse_mass, dt, state.velocity
        )

    def displace(self, dt: float, sweeps: NDArray[np.int64]) -> None:
        """Displacements follow from velocities alone."""

    def sweep(self, dt: float, cloths: NDArray[np.bool_]) -> None:
        """Nor do they follow contacts."""


@kernel
def compute_spring_forces(springs: SpringArrays, nodes: Nodes, first: ti.i32, arity: ti.template(), force: Vectors):
    """-k (C + tau dC/dt) d/|d| of each spring [N]."""
    for s in range(springs.count):
        d, rate = span(springs, nodes, nodes.carry, s, arity), ti.math.vec3(0.0)
        for a in ti.static(range(arity)):
            rate += coefficient(springs, s, arity, a) * nodes.velocity[springs.nodes[arity * s + a]]
        length = d.norm()
        value = ti.math.vec3(0.0)
        if length > TINY_LENGTH:
            direction = d / length
            stretch = length - springs.law[s][0] + springs.shift[s]
            value = -springs.law[s][1] * (stretch + springs.law[s][2] * direction.dot(rate)) * direction
        force[first + s] = value


@kernel
def gather_spring_forces(
    start: Integers,
    spring: Integers,
    coefficients: Floats,
    force: Vectors,
    inverse_mass: Floats,
    dt: ti.f32,
    velocity: Vectors,
):
    """Accelerate every node by its springs."""
    for i in range(velocity.shape[0]):
        total = ti.math.vec3(0.0)
        for k in range(start[i], start[i + 1]):
            total += coefficients[k] * force[spring[k]]
        velocity[i] += dt * inverse_mass[i] * total
