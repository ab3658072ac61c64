"""Angular momentum of cloth that no pin holds, which its springs must not change."""

import numpy as np
import taichi as ti

from sim.cloth.bundles import NodeMotion, Nodes
from sim.cloth.state import ClothState
from sim.core.arrays import Vectors
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.core.reductions import BRANCHES, Share, Tree, device_lanes, reduced, runs_on_gpu

QUANTITIES = 13
"""Mass, its first moments (3) and second moments (6), and angular momentum that the springs gave (3)."""

LEAST_INERTIA = 1.0e-6
"""About its long axis a cloth counts as no thinner than this, as a share of the sum of its moments of inertia [-]."""


class AngularMomentumCorrection:
    """Takes back the angular momentum that springs gave to free cloths.

    With velocities v = (x' - x)/dt, sum m x' x v = sum m x x v: a spring changes the angular momentum unless it pushes
    along its direction d at the start of the step, as SHAKE does (Ryckaert, Ciccotti & Berendsen 1977). Springs of XPBD
    push along where the step leads them. That is what lets them hold tension in long steps, and slows whatever spins:
    by 1e-3 within frames where a ball is caught in cloth. Pushing along d instead is an explicit force across the
    spring, unstable from the time on in which a wave runs along it; so the loss is returned, to each cloth as a whole:
    its displacements get the rotation t about its centre of mass X that restores the sum over its nodes,

        I t = -sum m (x - X) x e,   e_i += t x (x_i - X),

    with e the displacements by springs and I the moments of inertia. Linear momentum stays, and no spring is stretched
    to first order. Where pins hold a cloth, they have a torque of their own, and nothing is returned; nor to a mesh of
    several pieces, as what one has lost is not the others'.
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
            return_angular_momentum(state.nodes, state.motion, dt, first, count, share, self._turn)
        self._is_warm = True


@func
def three(tree: Tree, first: ti.i32) -> ti.math.vec3:
    """Three totals, from one on."""
    step = tree.lanes // BRANCHES
    return ti.math.vec3(tree.nodes[first * step], tree.nodes[(first + 1) * step], tree.nodes[(first + 2) * step])


@kernel
def return_angular_momentum(
    nodes: Nodes,
    motion: NodeMotion,
    dt: ti.f32,
    first: ti.i32,
    count: ti.i32,
    share: Share,
    turn: Vectors,
):
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
                e_i = nodes.displacement[i] - (motion.carry[i] + dt * motion.velocity[i])
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
