"""Sums and maxima over the cloths, on the device: what the diagnostics tell of every frame."""

import math
from collections.abc import Sequence

import taichi as ti

from sim.cloth.bundles import Nodes, SpringArrays
from sim.cloth.device_springs import DeviceCells, DeviceSprings, span, sum_over_cells
from sim.cloth.state import ClothState
from sim.core.arrays import Floats, Vectors
from sim.core.launch import kernel
from sim.core.reductions import LaneReduction, Results, Share, is_finite, reduced_tree, runs_on_gpu

NODE_MAXIMA, NODE_SUMS = 1, 7
SPRING_MAXIMA, SPRING_SUMS = 1, 1


class ClothTotals:
    """Momentum, energies and extremes, in float32 and in a fixed order."""

    def __init__(self, state: ClothState, springs: Sequence[DeviceSprings], cells: Sequence[DeviceCells]) -> None:
        self._state, self._springs, self._cells = state, springs, cells
        self._of_nodes = LaneReduction(maxima=NODE_MAXIMA, sums=NODE_SUMS)
        self._of_springs = LaneReduction(maxima=SPRING_MAXIMA, sums=SPRING_SUMS)

    def of_nodes(self, gravity: tuple[float, float, float]) -> dict[str, float]:
        """Momentum, energies but that of springs, largest speed; how many nodes are not finite, and how many lost."""
        state, share = self._state, self._of_nodes.over(self._state.vertex_count)
        results = self._of_nodes.unpack(
            sum_over_nodes(state.nodes, state.position, state.mass, state.vertex_count, state.limit, gravity, share)
        )
        speed_squared, *sums = (float(value) for value in results)
        names = ("momentum_x", "momentum_y", "momentum_z", "kinetic_energy", "potential_energy", "not_finite", "lost")
        return {"max_speed": math.sqrt(speed_squared), **dict(zip(names, sums, strict=True))}

    def of_springs(self) -> dict[str, float]:
        """Elastic energy, and the largest strain along threads and triangles."""
        state, found = self._state, []
        for springs in self._springs:
            springs.contract(state.nodes, state.carry)
            share = self._of_springs.over(springs.count)
            found.append(sum_over_springs(springs.on_device, state.nodes, springs.arity, share))
        for cells in self._cells:
            cells.measure_strains(state.nodes, is_damped=False)
            share = self._of_springs.over(cells.count)
            found.append(sum_over_cells(cells.on_device, state.nodes, cells.arity, share))
        strains, energies = zip(*((float(each[0]), float(each[1])) for each in found), strict=True)
        return {"elastic_energy": sum(energies), "max_strain": max(0.0, *strains)}


@kernel
def sum_over_nodes(
    nodes: Nodes, position: Vectors, mass: Floats, count: ti.i32, limit: ti.i32, gravity: ti.math.vec3, share: Share
) -> Results:
    """Largest squared speed; momentum, kinetic and potential energy; how many are not finite, or at the ends."""
    (tree,) = ti.static((share.tree,))
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(tree.lanes):
        fastest, momentum = 0.0, ti.math.vec3(0.0)
        kinetic, potential, bad, lost = 0.0, 0.0, 0.0, 0.0
        for k in range(share.items):
            i = lane * share.lane_step + k * share.item_step
            if i < count:
                v_i = nodes.velocity[i]
                squared = v_i.dot(v_i)
                if is_finite(squared):
                    fastest = ti.max(fastest, squared)
                    momentum += mass[i] * v_i
                    kinetic += 0.5 * mass[i] * squared
                    potential -= mass[i] * gravity.dot(position[i])
                else:
                    bad += 1.0
                if ti.abs(nodes.lattice[i]).max() >= limit:
                    lost += 1.0
        tree.partial[lane] = fastest
        for axis in ti.static(range(3)):
            tree.partial[(1 + axis) * tree.lanes + lane] = momentum[axis]
        tree.partial[4 * tree.lanes + lane] = kinetic
        tree.partial[5 * tree.lanes + lane] = potential
        tree.partial[6 * tree.lanes + lane] = bad
        tree.partial[7 * tree.lanes + lane] = lost
    return reduced_tree(tree)


@kernel
def sum_over_springs(springs: SpringArrays, nodes: Nodes, arity: ti.template(), share: Share) -> Results:
    """Largest strain of springs with two nodes; elastic energy."""
    (tree,) = ti.static((share.tree,))
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for lane in range(tree.lanes):
        largest = 0.0
        energy = 0.0
        for k in range(share.items):
            s = lane * share.lane_step + k * share.item_step
            if s < springs.count:
                error = span(springs, nodes, nodes.carry, s, arity).norm() - springs.law[s][0]
                energy += 0.5 * springs.law[s][1] * error * (error + springs.shift[s])
                if ti.static(arity == 2):
                    largest = ti.max(largest, error / springs.law[s][0])
        tree.partial[lane] = largest
        tree.partial[tree.lanes + lane] = energy
    return reduced_tree(tree)
