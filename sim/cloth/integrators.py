"""Steps of springs: compliant ones, XPBD with small steps (Macklin et al. 2019), threads of rectangles and triangles of
meshes as many at once; and explicit forces, the reference.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from scipy.sparse import coo_array

from sim.cloth.bundles import Nodes, SpringArrays
from sim.cloth.device_springs import (
    TINY_LENGTH,
    Bounds,
    DeviceCells,
    DeviceSprings,
    between,
    coefficient,
    compute_cell_forces,
    damp_shears,
    separation,
    solve_shears,
    span,
)
from sim.cloth.springs import TRIANGLE, longest_explicit_step
from sim.cloth.state import ClothState
from sim.cloth.threads import ThreadSolver
from sim.cloth.triangles import TriangleSolver
from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.reductions import BRANCHES, Share, Tree, device_lanes, reduced, runs_on_gpu

QUANTITIES = 13  # mass, its first moments (3) and second moments (6), and angular momentum that the springs gave (3)

LEAST_INERTIA = 1.0e-6
"""About its long axis a cloth counts as no thinner than this, as a share of the sum of its moments of inertia [-]."""


class AngularMomentumCorrection:
    """Takes back the angular momentum that springs gave to free cloths.

    Springs that push along where the step leads them, not along their directions at its start, have a torque. So the
    displacements of each cloth get the rotation t about its centre of mass X that restores the sum over its nodes,

        I t = -sum m (x - X) x e,   e_i += t x (x_i - X),

    with e the displacements by springs and I the moments of inertia. Where pins hold a cloth, they have a torque of
    their own, and nothing is returned; nor to a mesh of several pieces, as what one has lost is not the others'.
    """

    def __init__(self, state: ClothState) -> None:
        self._state = state
        self._lanes = device_lanes()
        partial = ti.ndarray(ti.f32, QUANTITIES * self._lanes.count)
        totals = ti.ndarray(ti.f32, QUANTITIES * (self._lanes.count // BRANCHES))
        self._tree = Tree(partial, self._lanes.count, QUANTITIES, 0, totals)
        self._turn = ti.Vector.ndarray(3, ti.f32, 2)
        self._is_warm = False

    def restore(self, dt: float) -> None:
        """Correct the displacements of a step of dt [s], after the springs."""
        state, lanes = self._state, self._lanes
        # At first also for cloths that pins hold, none of whose nodes it moves: it is compiled for when these let go.
        for cloth in np.flatnonzero(state.is_free) if self._is_warm else range(len(state.names)):
            first, end = (int(node) for node in state.host.first_node[cloth : cloth + 2])
            count = end - first if state.is_free[cloth] else 0
            share = Share(lanes.items(count), lanes.lane_step(count), lanes.item_step(), self._tree)
            return_angular_momentum(state.nodes, dt, first, count, share, self._turn)
        self._is_warm = True


@func
def three(tree: Tree, first: ti.i32) -> ti.math.vec3:
    """Three totals, from one on."""
    step = tree.lanes // BRANCHES
    return ti.math.vec3(tree.nodes[first * step], tree.nodes[(first + 1) * step], tree.nodes[(first + 2) * step])


@kernel
def return_angular_momentum(nodes: Nodes, dt: ti.f32, first: ti.i32, count: ti.i32, share: Share, turn: Vectors):
    """Rotate the nodes of a cloth so that the corrections of its springs have no angular momentum.

    Moments are about the first node; `turn` becomes the rotation, and the centre of mass from there.
    """
    (tree,) = ti.static((share.tree,))
    for lane in range(tree.lanes):
        mass = 0.0
        moment = ti.math.vec3(0.0)
        squares = ti.math.vec3(0.0)
        products = ti.math.vec3(0.0)
        spin = ti.math.vec3(0.0)
        for k in range(share.items):
            n = lane * share.lane_step + k * share.item_step
            if n < count:
                i = first + n
                m_i = 1.0 / nodes.inverse_mass[i]
                r_i = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[first], ti.f32)
                e_i = nodes.displacement[i] - (nodes.carry[i] + dt * nodes.velocity[i])
                mass += m_i
                moment += m_i * r_i
                squares += m_i * r_i * r_i
                products += m_i * r_i.yzx * r_i.zxy
                spin += m_i * r_i.cross(e_i)
        tree.partial[lane] = mass
        for first_of, vector in ti.static(((1, moment), (4, squares), (7, products), (10, spin))):
            for axis in ti.static(range(3)):
                tree.partial[(first_of + axis) * tree.lanes + lane] = vector[axis]
    reduced(tree.partial, tree.lanes, QUANTITIES, 0, tree.nodes)
    if ti.static(not runs_on_gpu()):
        ti.loop_config(serialize=True)
    for _ in range(1):
        mass = tree.nodes[0]
        centre, spin = three(tree, 1) / mass, three(tree, 10)
        squares = three(tree, 4) - mass * centre * centre
        products = three(tree, 7) - mass * centre.yzx * centre.zxy
        whole = squares.sum()
        least = LEAST_INERTIA * whole
        inertia = ti.Matrix(
            [
                [whole - squares.x + least, -products.z, -products.y],
                [-products.z, whole - squares.y + least, -products.x],
                [-products.y, -products.x, whole - squares.z + least],
            ]
        )
        turn[0] = -(inertia / whole).inverse() @ (spin / whole)
        turn[1] = centre
    for i in range(first, first + count):
        r_i = nodes.quantum * ti.cast(nodes.lattice[i] - nodes.lattice[first], ti.f32) - turn[1]
        nodes.displacement[i] = nodes.displacement[i] + turn[0].cross(r_i)


PAIR, BEND_OF_GRID = 2, 3
"""Nodes of springs: of an ordinary one, and of one over a node of a rectangle, which is flat at rest."""


class XPBDSprings:
    """Gauss-Seidel over the springs, colour by colour, each an implicit Euler step of that spring alone; over whole
    threads of rectangles (`threads`); and the triangles of all meshes together (`triangles`).

    Nodes that a spring moves in a colour belong to no other spring of it, so the result is the same whatever the number
    of threads. Approximate: one sweep a step does not let a stiff spring know of all that hangs on it, but within a
    thread and between triangles. Bend springs have one sweep always.

    Args:
        state: what they move.
        springs: all springs.
        cells: all cells.

    Attributes:
        last_dt: length of the last step [s], 0 before the first; `usual_dt` of those that are not shortened.
    """

    def __init__(self, state: ClothState, springs: Sequence[DeviceSprings], cells: Sequence[DeviceCells]) -> None:
        self._state = state
        self._momentum = AngularMomentumCorrection(state)
        self._unconverged = 0
        self.last_dt = self._rate_before = self.usual_dt = 0.0
        self._bends = [family for family in springs if family.arity > PAIR]
        self._shears = [family for family in cells if family.arity != TRIANGLE]
        self._triangles = [TriangleSolver(state, family) for family in cells if family.arity == TRIANGLE]
        self._threads = [ThreadSolver(family) for family in springs if family.in_segments]

    def take_parameters(self) -> None:
        """Mass of meshes as it is now; lists of springs hold their stiffness."""
        for triangles in self._triangles:
            triangles.take_parameters()

    def excess(self, dt: float) -> Callable[[], NDArray[np.float64]]:
        """Asks by how much threads, or meshes at a node, are longer than tension makes them, at most [rest lengths].

        Of each cloth; those that are solved in the same lists have the same. To be answered before springs or contacts
        go on.
        """
        asked = [(threads.springs.cloths, threads.excess(self._state, dt)) for threads in self._threads]

        def answer() -> NDArray[np.float64]:
            found = [(cloths, *excess()) for cloths, excess in asked]
            found += [(triangles.cloths, *triangles.excess()) for triangles in self._triangles]
            self._unconverged = sum(count for *_, count in found)
            largest = np.zeros(len(self._state.names))
            for cloths, excess, _ in found:
                largest[list(cloths)] = np.maximum(largest[list(cloths)], excess)
            return largest

        return answer

    def diagnostics(self) -> Mapping[str, float]:
        """`overlong_springs`: at the end of the frame, along the threads of rectangles, and at the nodes of meshes."""
        return {"overlong_springs": float(self._unconverged)}

    def stable_dt(self, cloths: NDArray[np.bool_] | None = None) -> float:  # noqa: ARG002  (the integrators' protocol)
        """Any step is stable [s]."""
        return float("inf")

    def accelerate(self, dt: float) -> None:
        """Damp the velocities along springs between two nodes, and in the shear of rectangles.

        Apart from their own sweep, where a damping of gamma = tau / dt (Macklin et al. 2016, eq. 26) would make their
        largest stiffness 1 + gamma times smaller. Bend springs are damped there.
        """
        state = self._state
        for springs in (threads.springs for threads in self._threads if threads.springs.is_damped):
            for bounds in springs.colours:
                damp_threads(springs.on_device, bounds, state.nodes, dt, springs.at_once)
        for cells in (each for each in self._shears if each.is_damped):
            damp_shears(cells.on_device, cells.bounds, state.nodes, dt, cells.colours)

    def displace(self, dt: float, sweeps: NDArray[np.int64]) -> None:
        """Bring the displacements of a step of dt [s] to where the springs let them go, in so many sweeps a cloth."""
        for bends in self._bends:
            for bounds in bends.colours:
                numbers = dt * dt, 1.0 / dt, bends.arity, bends.at_once
                solve_bends(bends.on_device, bounds, self._state.nodes, *numbers)
        self._rate_before = 1.0 / self.last_dt if self.last_dt else 0.0
        for sweep in range(sweeps.max()):
            self.sweep(dt, sweeps > sweep, shears=self._shears, is_first=sweep == 0)
        self.last_dt = dt
        for threads in self._threads:
            threads.straighten(self._state, dt)
        self._momentum.restore(dt)

    def sweep(
        self, dt: float, cloths: NDArray[np.bool_], *, shears: Sequence[DeviceCells] = (), is_first: bool = False
    ) -> None:
        """Solve what bears tension in some cloths, once more after contacts have pushed: threads, and the triangles of
        meshes; and shears if they are given. Lists hold only cloths that take the same sweeps.
        """
        for cells in shears:
            if not cloths[list(cells.cloths)].any():
                continue
            steps = ti.math.vec3(dt, self._rate_before, (self.usual_dt / dt) ** 2)
            solve_shears(cells.on_device, cells.bounds, self._state.nodes, steps, int(is_first), cells.colours)
        for threads in self._threads:
            if cloths[list(threads.springs.cloths)].any():
                threads.displace(self._state, dt, is_first=is_first)
        for triangles in self._triangles:
            if cloths[list(triangles.cloths)].any():
                triangles.displace(dt, self._rate_before, is_first=is_first)


@func
def solve_bend(s: ti.i32, springs: SpringArrays, nodes: Nodes, dt_squared: ti.f32, rate: ti.f32, arity: ti.template()):
    """Macklin, Müller & Chentanez 2016, eq. 26, from a multiplier of 0:

        Delta lambda = -(C + gamma dC) / ((1 + gamma) sum_a w_a c_a² + 1/(k dt²)),   gamma = tau / dt

    multiplied through by k dt² |d|, so that springs without stiffness do nothing, and one division does. `law` is
    (rest, k, tau); over a node of a rectangle the rest length is 0.
    """
    d = separation(springs, nodes, s, arity)
    moved = ti.math.vec3(0.0)
    weight = 0.0
    for a in ti.static(range(arity)):
        c_a = coefficient(springs, s, arity, a)
        i = springs.nodes[arity * s + a]
        moved += c_a * nodes.displacement[i]
        weight += c_a * c_a * nodes.inverse_mass[i]
    d += moved
    squared = d.dot(d)
    if squared > TINY_LENGTH * TINY_LENGTH:
        strength = springs.law[s][1] * dt_squared
        gamma = springs.law[s][2] * rate
        error = squared + gamma * d.dot(moved)  # times |d|
        if ti.static(arity != BEND_OF_GRID):
            error -= springs.law[s][0] * ti.sqrt(squared)
        impulse = -strength * error / (squared * (strength * weight * (1.0 + gamma) + 1.0)) * d
        for a in ti.static(range(arity)):
            i = springs.nodes[arity * s + a]
            push = nodes.inverse_mass[i] * coefficient(springs, s, arity, a) * impulse
            nodes.displacement[i] = nodes.displacement[i] + push


@kernel
def solve_bends(
    springs: SpringArrays,
    bounds: Bounds,
    nodes: Nodes,
    dt_squared: ti.f32,
    rate: ti.f32,
    arity: ti.template(),
    colours: ti.template(),
):
    """The bend springs of so many colours, within their bounds, one colour after the other; `rate` is 1/dt."""
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = bounds
    for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
        for s in range(begin, end):
            solve_bend(s, springs, nodes, dt_squared, rate, arity)


@kernel
def damp_threads(springs: SpringArrays, bounds: Bounds, nodes: Nodes, dt: ti.f32, colours: ti.template()):
    """Implicit Euler of the forces -tau k dC/dt along the springs of so many colours, one colour after the other, and
    one by one within a piece.
    """
    c_0, c_1, c_2, c_3, c_4, c_5, c_6 = bounds
    for begin, end in ti.static(((c_0, c_1), (c_1, c_2), (c_2, c_3), (c_3, c_4), (c_4, c_5), (c_5, c_6))[:colours]):
        for piece in range(begin, end):
            for s in range(springs.segment_start[piece], springs.segment_start[piece + 1]):
                i, j = springs.nodes[2 * s], springs.nodes[2 * s + 1]
                w_i, w_j, v_i, v_j = nodes.inverse_mass[i], nodes.inverse_mass[j], nodes.velocity[i], nodes.velocity[j]
                d = between(i, j, nodes, nodes.carry)
                squared, strength = d.dot(d), springs.law[s][1] * springs.law[s][2] * dt
                if squared > TINY_LENGTH * TINY_LENGTH:
                    impulse = -strength / (strength * (w_i + w_j) + 1.0) * d.dot(v_i - v_j) / squared * d
                    nodes.velocity[i], nodes.velocity[j] = v_i + w_i * impulse, v_j - w_j * impulse


class ExplicitSprings:
    """Forces -k (C + tau dC/dt) c_a d/|d| on the velocities, before nodes move.

    Forces of springs are stored, and each node gathers its own in a fixed order.
    """

    last_dt = usual_dt = 0.0  # as of `XPBDSprings`; nothing depends on them

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
        gather_spring_forces(self._start, self._spring, self._coefficient, self._force, dt, state.nodes)

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
    start: Integers, spring: Integers, coefficients: Floats, force: Vectors, dt: ti.f32, nodes: Nodes
):
    """Accelerate every node by its springs."""
    for i in range(nodes.velocity.shape[0]):
        total = ti.math.vec3(0.0)
        for k in range(start[i], start[i + 1]):
            total += coefficients[k] * force[spring[k]]
        nodes.velocity[i] += dt * nodes.inverse_mass[i] * total
