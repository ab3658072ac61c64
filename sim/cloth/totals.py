"""Sums and maxima over the cloths, on the device: what the diagnostics tell of every frame.

Loops over lanes are serial on a CPU: one thread has them all either way (`sim.work_sharing`), and none need wake.
"""

import math
from collections.abc import Sequence

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cloth.device_springs import DeviceSprings, Laws, coefficient, separation
from sim.cloth.state import ClothState, Lattice
from sim.launch import fast_launch
from sim.reductions import LaneReduction, Results, is_finite, reduced, runs_on_gpu

NODE_MAXIMA, NODE_SUMS = 1, 7
SPRING_MAXIMA, SPRING_SUMS = 1, 1


class ClothTotals:
    """Momentum, energies and extremes, in float32 and in a fixed order."""

    def __init__(self, state: ClothState, springs: Sequence[DeviceSprings]) -> None:
        self._state, self._springs = state, springs
        self._of_nodes = LaneReduction(maxima=NODE_MAXIMA, sums=NODE_SUMS)
        self._of_springs = LaneReduction(maxima=SPRING_MAXIMA, sums=SPRING_SUMS)

    def of_nodes(self, gravity: tuple[float, float, float]) -> dict[str, float]:
        """Momentum, energies but that of springs, largest speed; how many nodes are not finite, and how many lost."""
        state, lanes = self._state, self._of_nodes.lanes
        results = self._of_nodes.unpack(
            sum_over_nodes(
                state.position, state.lattice, state.velocity, state.mass, state.vertex_count, state.limit,
                ti.math.vec3(*gravity), lanes.items(state.vertex_count),
                lanes.lane_step(state.vertex_count), lanes.item_step(), *self._of_nodes.tree,
            )
        )  # fmt: skip
        speed_squared, *sums = (float(value) for value in results)
        names = ("momentum_x", "momentum_y", "momentum_z", "kinetic_energy", "potential_energy", "not_finite", "lost")
        return {"max_speed": math.sqrt(speed_squared), **dict(zip(names, sums, strict=True))}

    def of_springs(self) -> dict[str, float]:
        """Elastic energy, and the largest strain of springs between two nodes."""
        state, energy, strain = self._state, 0.0, 0.0
        for springs in self._springs:
            lanes = self._of_springs.lanes
            results = self._of_springs.unpack(
                sum_over_springs(
                    springs.nodes, springs.law, springs.coefficients, state.lattice, state.quantum, state.carry,
                    springs.count, springs.arity, lanes.items(springs.count),
                    lanes.lane_step(springs.count), lanes.item_step(), *self._of_springs.tree,
                )
            )  # fmt: skip
            strain, energy = max(strain, float(results[0])), energy + float(results[1])
        return {"elastic_energy": energy, "max_strain": strain}


@fast_launch
@ti.kernel
def sum_over_nodes(
    position: Vectors, lattice: Lattice, velocity: Vectors, mass: Floats, count: ti.i32, limit: ti.i32,
    gravity: ti.math.vec3, items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats,
) -> Results:  # fmt: skip
    """Largest squared speed; momentum, kinetic and potential energy; how many are not finite, or at the ends."""
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(lanes):
        fastest = 0.0
        momentum = ti.math.vec3(0.0)
        kinetic = 0.0
        potential = 0.0
        bad = 0.0
        lost = 0.0
        for k in range(items):
            i = lane * lane_step + k * item_step
            if i < count:
                v_i = velocity[i]
                squared = v_i.dot(v_i)
                if is_finite(squared):
                    fastest = ti.max(fastest, squared)
                    momentum += mass[i] * v_i
                    kinetic += 0.5 * mass[i] * squared
                    potential -= mass[i] * gravity.dot(position[i])
                else:
                    bad += 1.0
                if ti.abs(lattice[i]).max() >= limit:
                    lost += 1.0
        partial[lane] = fastest
        for axis in ti.static(range(3)):
            partial[(1 + axis) * lanes + lane] = momentum[axis]
        partial[4 * lanes + lane] = kinetic
        partial[5 * lanes + lane] = potential
        partial[6 * lanes + lane] = bad
        partial[7 * lanes + lane] = lost
    return reduced(partial, lanes, quantities, maxima, nodes)


@fast_launch
@ti.kernel
def sum_over_springs(
    spring_nodes: Integers, law: Laws, coefficients: Floats, lattice: Lattice, quantum: ti.f32, carry: Vectors,
    count: ti.i32, arity: ti.template(), items: ti.i32, lane_step: ti.i32, item_step: ti.i32,
    partial: Floats, lanes: ti.i32, quantities: ti.i32, maxima: ti.i32, nodes: Floats,
) -> Results:  # fmt: skip
    """Largest strain of springs with two nodes; elastic energy."""
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(lanes):
        largest = 0.0
        energy = 0.0
        for k in range(items):
            s = lane * lane_step + k * item_step
            if s < count:
                d = separation(spring_nodes, coefficients, lattice, quantum, s, arity)
                for a in ti.static(range(arity)):
                    d += coefficient(coefficients, s, arity, a) * carry[spring_nodes[arity * s + a]]
                error = d.norm() - law[s][0]
                energy += 0.5 * law[s][1] * error * error
                if ti.static(arity == 2):
                    largest = ti.max(largest, error / law[s][0])
        partial[lane] = largest
        partial[lanes + lane] = energy
    return reduced(partial, lanes, quantities, maxima, nodes)
