"""Joints between rigid bodies and points of cloths: which nodes they hold, and what both sides feel of each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.cloth.parameters import ClothParameters, substeps_of
from sim.core.host_access import copied, put_rows, viewed
from sim.core.parameters import Vector3
from sim.core.solver import Coupling
from sim.rigid.joint_parameters import JointParameters, JointProblem
from sim.rigid.joint_points import JointPoints

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.cloth.state import ClothState
    from sim.rigid.solver import RigidSolver

Floats = NDArray[np.float64]

EYELET_IN_IMPEDANCES = 3.0
"""Mass of an eyelet, in what a thread that is pulled along opposes in a step, which is as if dt (K rho)^(1/2) times the
distance of nodes moved along: more than a half of all that a node feels of its cloth, or steps would go wrong."""

LEAST_HANGING = 100.0
"""How heavy a node is in the cloth's step at least, in its own masses: as what cannot be moved, if that leads it."""


def jointed_ends(joint: JointParameters, cloths: Sequence[ClothParameters]) -> Iterator[tuple[int, int]]:
    """Ends of a joint that are at cloths, and the numbers of these."""
    numbers = {cloth.name: number for number, cloth in enumerate(cloths)}
    for end, name in enumerate(joint.between):
        if name in numbers:
            yield end, numbers[name]


def place_of_end(joint: JointParameters, end: int) -> Vector3:
    """Where a joint is on the cloth at one of its ends [m]; it says so."""
    place = joint.anchor if joint.anchors is None else joint.anchors[end]
    assert place is not None
    return place


def node_near(place: Vector3, position: Floats) -> tuple[int, float]:
    """The node of a cloth, (n, 3) [m], that is nearest to a place, and how far it is [m]."""
    distance = np.linalg.norm(position - np.asarray(place), axis=1)
    node = int(np.argmin(distance))
    return node, float(distance[node])


def off_cloth(
    number: int, joint: JointParameters, end: int, cloth: str, position: Floats, longest_edge: float
) -> JointProblem | None:
    """What is wrong with a joint that has no node of its cloth, (n, 3) [m], nearer than the longest edge [m]."""
    node, distance = node_near(place_of_end(joint, end), position)
    if distance <= longest_edge:
        return None
    nearest = ", ".join(f"{value:.4g}" for value in position[node])
    return JointProblem(
        number,
        "anchor" if joint.anchors is None else "anchors",
        f'is {distance:.3g} m off the cloth "{cloth}", whose nodes are at most {longest_edge:.3g} m apart; move it to '
        f"the nearest one, at [{nearest}], or another",
    )


def eyelet_mass(
    cloth: ClothParameters, node_area: float, frames_per_second: float, cloths: Sequence[ClothParameters]
) -> float:
    """Mass of an eyelet at a node with such a share of the area of one of the cloths of a scene [m²] [kg]."""
    dt = 1.0 / (frames_per_second * substeps_of(cloths))
    impedance = math.sqrt(cloth.plane_stiffness * cloth.mass_per_area * node_area)
    return EYELET_IN_IMPEDANCES * dt * impedance


class ClothJointsCoupling(Coupling):
    """Joints hold nodes of cloth and bodies together, and pull on both.

    A coupled step: in that of the cloth a held node has the mass of all that hangs on it, and goes where that would
    without joints and cloth; the impulse by which springs, air and contacts keep it from there is measured. The bodies'
    step takes the node as a point with its own mass and this impulse, which joints share out among all that hangs
    there. Then the node has the velocity of that point, and is led to where it is in the next step. What the cloth
    gave the bodies got, so that momentum is kept to the rounding of that measurement, some 1e-7 of what hangs there.
    It is of first order in the step, and damps what swings on the cloth as its springs themselves do.

    A cloth's node is far lighter than what hangs on it, and than what its threads oppose to it in a step. So that steps
    are stable whatever the joint and however light the body, there is an eyelet at the node, which belongs to the cloth
    and weighs `eyelet_mass`: a gram or less, mostly.

    A node that a pin holds leads what is joined to it.

    Approximate: what a fluid pushes at such a node, it pushes at one with the mass of all that hangs there.
    """

    def __init__(
        self, cloth: ClothSolver, rigid: RigidSolver, nodes: NDArray[np.int64], passing: NDArray[np.bool_]
    ) -> None:
        """Couple the two at nodes, which are the points of joints; bodies and cloths that do not touch by joint, see
        `passing_of`."""
        assert rigid.joints is not None
        self.bodies = (cloth.name, rigid.name)
        self._cloth, self._rigid, self._joints, self._nodes = cloth, rigid, rigid.joints, nodes
        self._passing = passing
        self._broken: NDArray[np.bool_] | None = None
        self._told = np.zeros((len(nodes), 3), dtype=np.float32)
        self._start = np.zeros((len(nodes), 3))
        self._mass = np.ones(len(nodes))
        self._own_inverse = np.zeros(len(nodes), dtype=np.float32)
        cloth.loads.insert(0, self)
        self._obey_broken()
        self._tell()

    def put_on(self, state: ClothState, gravity: Vector3, dt: float) -> None:  # noqa: ARG002  (as of `NodeLoad`)
        """Let the nodes carry what hangs on them, and go to where their points would in dt [s]."""
        points, nodes = self._joints.points, self._nodes
        self._own_inverse, velocity = (viewed(each)[nodes] for each in (state.inverse_mass, state.velocity))
        is_free, position = (self._own_inverse > 0.0) & self._is_jointed(), state.positions_of(nodes)
        let_go = is_free & ~points.is_free
        points.position[let_go], points.velocity[let_go] = position[let_go], velocity[let_go]
        # What somebody else has changed since the last step.
        points.velocity += np.where((is_free & ~let_go)[:, None], velocity - self._told.astype(np.float64), 0.0)
        points.is_free = is_free
        hanging = self._joints.hanging_mass(self._rigid.bodies)
        self._mass = np.maximum(hanging, LEAST_HANGING * points.mass)
        led = (points.velocity + (points.position - position) / dt).astype(np.float32)
        velocity = np.where(is_free[:, None], led, velocity)
        self._start = velocity.astype(np.float64)
        put_rows(state.velocity, nodes, velocity)
        put_rows(state.inverse_mass, nodes, np.where(is_free, 1.0 / self._mass, self._own_inverse))

    def take_off(self, state: ClothState) -> None:
        """Give the nodes their own masses back."""
        put_rows(state.inverse_mass, self._nodes, self._own_inverse)

    def exchange(self, dt: float) -> None:
        """Push the points as the cloth did its nodes in its substep of dt [s]; lead those that pins hold."""
        points, state = self._joints.points, self._cloth.state
        velocity = viewed(state.velocity)[self._nodes].astype(np.float64)
        fall = dt * np.asarray(self._cloth.gravity, dtype=np.float64)
        impulse = self._mass[:, None] * (velocity - self._start - fall)
        points.acceleration = (fall + impulse / points.mass[:, None]) / dt
        led = (state.positions_of(self._nodes) - points.position) / dt
        points.velocity = np.where(points.is_free[:, None], points.velocity, led)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Give the nodes the velocities of their points after a substep of dt [s]."""
        self._obey_broken()
        self._tell()

    def resume(self) -> None:
        """Go on from restored nodes and points."""
        self._broken = None
        self._obey_broken()
        self._told = self._joints.points.velocity.astype(np.float32)

    def _tell(self) -> None:
        state, points = self._cloth.state, self._joints.points
        follows = (points.is_free & self._is_jointed())[:, None]
        self._told = np.where(follows, points.velocity.astype(np.float32), viewed(state.velocity)[self._nodes])
        put_rows(state.velocity, self._nodes, self._told)

    def _is_jointed(self) -> NDArray[np.bool_]:
        """Points that a joint holds that is not broken, (h,)."""
        jointed = np.zeros(len(self._nodes) + 1, dtype=bool)
        jointed[self._joints.points.ends[~self._joints.is_broken]] = True
        return jointed[:-1]

    def _obey_broken(self) -> None:
        """Let cloths and bodies touch whose joints are broken."""
        broken = self._joints.is_broken
        if self._broken is None or (broken != self._broken).any():
            self._broken = broken.copy()
            contacts = self._cloth.contacts
            assert contacts is not None
            contacts.rigid.set_passing(self._passing[~broken].any(axis=0))


def points_of_joints(
    joints: Sequence[JointParameters], cloth: ClothSolver, frames_per_second: float
) -> tuple[NDArray[np.int64], JointPoints]:
    """Nodes of cloths that joints hold, in the numbers of the scene, and the points that they are for joints.

    Their eyelets are put on.

    Raises:
        ValueError: a joint is off its cloth.
    """
    host, parameters = cloth.state.host, cloth.parameters
    held, ends = [], []
    for number, joint in enumerate(joints):
        for end, which in jointed_ends(joint, parameters):
            first, last = host.first_node[which : which + 2]
            edges = host.edges.nodes[host.body[host.edges.nodes[:, 0]] == which]
            longest = float(np.linalg.norm(host.position[edges[:, 0]] - host.position[edges[:, 1]], axis=1).max())
            problem = off_cloth(number, joint, end, parameters[which].name, host.position[first:last], longest)
            if problem is not None:
                raise ValueError(f'joint "{joint.name}": {problem.text}')
            node, _ = node_near(place_of_end(joint, end), host.position[first:last])
            held.append(first + node)
            ends.append((number, end))
    nodes, of_end = np.unique(np.array(held, dtype=np.int64), return_inverse=True)
    numbers = np.full((len(joints), 2), -1)
    for (number, end), point in zip(ends, of_end.tolist(), strict=True):
        numbers[number, end] = point
    eyelets = [
        eyelet_mass(parameters[int(host.body[node])], float(host.node_area[node]), frames_per_second, parameters)
        for node in nodes
    ]
    cloth.put_eyelets(nodes, np.array(eyelets))
    mass = copied(cloth.state.mass)[nodes].astype(np.float64)
    return nodes, JointPoints(numbers, host.position[nodes], host.velocity[nodes].astype(np.float64), mass)


def passing_of(
    joints: Sequence[JointParameters], cloths: Sequence[ClothParameters], bodies: Sequence[str]
) -> NDArray[np.bool_]:
    """Which cloth and body each joint keeps from touching, (j, cloths, b); it asks for contacts otherwise."""
    passing = np.zeros((len(joints), len(cloths), len(bodies)), dtype=bool)
    numbers = {name: number for number, name in enumerate(bodies)}
    for number, joint in enumerate(joints):
        for _, which in jointed_ends(joint, cloths):
            for name in joint.between:
                if name in numbers and not joint.contacts:
                    passing[number, which, numbers[name]] = True
    return passing
