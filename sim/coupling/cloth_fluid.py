"""Two-way coupling of cloths and the particle fluid that they are in."""

import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.load import NodeLoad
from sim.cloth.solver import ClothSolver
from sim.coupling.cloth_samples import ClothSamples
from sim.fluid.forces import SPHFluid
from sim.launch import fast_launch
from sim.reductions import LaneReduction, Results, reduced

MAXIMA = 3


class ClothFluidCoupling:
    """The fluid pushes the cloths and is held by them, and moves along where it touches.

    A coupled step (`sim.fluid.sheet_forces` says why): the fluid steps, its samples of the cloths answering as if they
    had the mass of the fluid that touches them; nodes take the impulses, and in their own step have the mass of the
    touching fluid m_b as well, of velocity u_b where their own is v_b = sum_n beta_bn v_n,

        (m_n + m_a,n) v_n += J_n + sum_b beta_bn m_b (u_b - v_b),   m_a,n = sum_b beta_bn m_b,

    with the barycentric coordinates beta of the samples; the touching fluid gets the difference between what became of
    the samples and u_b. With sum_n beta_bn = 1 linear momentum of fluid and free cloth is kept to rounding. Angular
    momentum is not quite: masses are lumped into nodes, and fluid takes part at some distance from the samples.

    Attributes:
        bodies: names of the fluid's and of the cloth solver.
    """

    is_loose = False

    def __init__(self, fluid: SPHFluid, cloth: ClothSolver, samples: ClothSamples) -> None:
        """Couple the two; places the fluid's samples where the cloths are.

        Args:
            fluid: made with the sheets of these samples.
            cloth: of the same cloths.
            samples: of the cloths.
        """
        sheets = fluid.body_forces.sheets
        assert sheets is not None
        self.bodies = (fluid.name, cloth.name)
        self._fluid, self._cloth, self._sheets = fluid, cloth, sheets
        count, node_count = len(samples.nodes), cloth.state.vertex_count
        self._nodes = ti.Vector.ndarray(3, ti.i32, count)
        self._nodes.from_numpy(samples.nodes)
        self._weights = ti.Vector.ndarray(3, ti.f32, count)
        self._weights.from_numpy(samples.weights.astype(np.float32))
        order = np.argsort(samples.nodes.ravel(), kind="stable")
        start = np.searchsorted(samples.nodes.ravel()[order], np.arange(node_count + 1))
        self._start, self._entries = _integers(start), _integers(order)
        self._change = ti.Vector.ndarray(3, ti.f32, count)
        self._reduction = LaneReduction(maxima=MAXIMA, sums=0)
        self._load = NodeLoad(node_count)
        cloth.load = self._load
        self.follow(0.0)

    def impulse(self) -> NDArray[np.float64]:
        """Of the fluid on all cloths in the last step, once `follow` was called [N s], (3,)."""
        pushed = self._sheets.impulse.to_numpy().sum(axis=0, dtype=np.float64)
        mass, change = (array.to_numpy().astype(np.float64) for array in (self._sheets.mass, self._change))
        total: NDArray[np.float64] = pushed - mass @ change
        return total

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Lay the fluid's impulses of its substep, and the fluid that touches, onto the nodes."""
        gather_loads(
            self._start, self._entries, self._weights, self._sheets.mass, self._sheets.impulse, self._sheets.push,
            self._load.mass, self._load.impulse,
        )  # fmt: skip

    def follow(self, dt: float) -> None:
        """Let the touching fluid move along, and put the samples where the cloths are; dt [s] is 0 at the start."""
        state, boundary, reduction = self._cloth.state, self._fluid.boundary, self._reduction
        lanes, count = reduction.lanes, boundary.sheet_count
        results = measure_sheets(
            self._nodes, self._weights, state.position, state.carry, state.velocity, boundary.position,
            boundary.velocity, boundary.first_sheet, count, self._change,
            lanes.items(count), lanes.lane_step(count), lanes.item_step(), *reduction.tree,
        )  # fmt: skip
        change, way, speed = (math.sqrt(value) for value in reduction.unpack(results)[:MAXIMA].tolist())
        if dt > 0.0:
            self._fluid.take_sheet_motion(self._change, change, dt)
        place_sheets(
            self._nodes, self._weights, state.position, state.carry, state.velocity, boundary.first_sheet, count,
            boundary.position, boundary.velocity,
        )  # fmt: skip
        self._fluid.sheets_moved(way, speed, elapsed_s=dt)

    def resume(self) -> None:
        """Nothing to make up for: the fluid saves where the samples are, and what it expects of them."""


def _integers(values: NDArray[np.integer]) -> ti.Ndarray:
    array = ti.ndarray(ti.i32, len(values))
    array.from_numpy(values.astype(np.int32))
    return array


Corners = ti.types.ndarray(dtype=ti.math.ivec3, ndim=1)


@ti.func
def mixed(nodes: Corners, weights: Vectors, s: ti.i32, of_nodes: Vectors) -> ti.math.vec3:
    """Value at a sample of what nodes have."""
    n, beta = nodes[s], weights[s]
    return beta[0] * of_nodes[n[0]] + beta[1] * of_nodes[n[1]] + beta[2] * of_nodes[n[2]]


@fast_launch
@ti.kernel
def gather_loads(
    start: Integers, entries: Integers, weights: Vectors, sample_mass: Floats, sample_impulse: Vectors,
    sample_push: Vectors, mass: Floats, impulse: Vectors,
):  # fmt: skip
    """m_a,n = sum_b beta_bn m_b, and sum_b beta_bn (J_b + m_b (u_b - v_b)); entry 3 b + c is corner c of sample b."""
    for n in range(mass.shape[0]):
        total_mass = 0.0
        total = ti.math.vec3(0.0)
        for k in range(start[n], start[n + 1]):
            b = entries[k] // 3
            beta = weights[b][entries[k] % 3]
            total_mass += beta * sample_mass[b]
            total += beta * (sample_impulse[b] + sample_mass[b] * sample_push[b])
        mass[n] = total_mass
        impulse[n] = total


@fast_launch
@ti.kernel
def measure_sheets(
    nodes: Corners, weights: Vectors, node_position: Vectors, node_carry: Vectors, node_velocity: Vectors,
    position: Vectors, velocity: Vectors, first: ti.i32, count: ti.i32, change: Vectors,
    items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, tree: Floats,
) -> Results:  # fmt: skip
    """Change of each sample's velocity; the largest squares of that, of the way to its new place, and of its speed."""
    for lane in range(lanes):
        largest = ti.math.vec3(0.0)
        for k in range(items):
            s = lane * lane_step + k * item_step
            if s < count:
                v_b = mixed(nodes, weights, s, node_velocity)
                x_b = mixed(nodes, weights, s, node_position) + mixed(nodes, weights, s, node_carry)
                dv_b = v_b - velocity[first + s]
                change[s] = dv_b
                way = (x_b - position[first + s]).norm_sqr()
                largest = ti.max(largest, ti.math.vec3(dv_b.norm_sqr(), way, v_b.norm_sqr()))
        for q in ti.static(range(3)):
            partial[q * lanes + lane] = largest[q]
    return reduced(partial, lanes, quantities, maxima, tree)


@fast_launch
@ti.kernel
def place_sheets(
    nodes: Corners, weights: Vectors, node_position: Vectors, node_carry: Vectors, node_velocity: Vectors,
    first: ti.i32, count: ti.i32, position: Vectors, velocity: Vectors,
):  # fmt: skip
    """Samples where their nodes are, as fast as these."""
    for s in range(count):
        position[first + s] = mixed(nodes, weights, s, node_position) + mixed(nodes, weights, s, node_carry)
        velocity[first + s] = mixed(nodes, weights, s, node_velocity)
