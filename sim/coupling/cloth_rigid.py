"""Two-way coupling of cloths and the rigid bodies that they touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.core.motion import rotation
from sim.core.motion.paths import Poses
from sim.core.solver import Coupling
from sim.core.walls import walls_of
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.body_geometry import BodyGeometry

if TYPE_CHECKING:
    from sim.cloth.continuous_contacts import ContinuousContacts
    from sim.cloth.solver import ClothSolver
    from sim.cloth.state import ClothState
    from sim.rigid.solver import RigidSolver


ROUND_OFF = 1.0e-6  # cloth that is laid onto a body, in decimal numbers, may be this deep in it [m]


class ClothRigidCoupling(Coupling):
    """Bodies push cloth, and cloth pushes bodies.

    A coupled step: contacts of the cloth's substep foresee how bodies move in it, gravity included, and push both sides
    in every iteration, so that light bodies answer within the step; the bodies take the impulses, then gravity and
    contacts among themselves, and move; the cloth's contacts follow. Impulses are opposite contact by contact: linear
    and angular momentum are kept to rounding. Kinematic bodies push and feel nothing. Pieces of a body that breaks are
    felt one by one and move as what they are glued to; what each gets stresses the others.

    Approximate: contacts among bodies in the same step are not foreseen. Cloth carries a heavy body over what stands
    (`sim.cloth.contact_response`), in two layers, too, but gives way between two bodies that both move, or in more.

    """

    def __init__(self, cloth: ClothSolver, rigid: RigidSolver, contacts: ContinuousContacts) -> None:
        """Couple the two; `contacts` are those of the cloth, with the bodies of the rigid solver first."""
        self.bodies = (cloth.name, rigid.name)
        self._cloth, self._rigid, self._contacts = cloth, rigid, contacts
        self.follow(0.0)

    def exchange(self, dt: float) -> None:
        """Hand the cloth's impulses of its substep of dt [s] to the bodies."""
        linear, angular = (each[: len(self._rigid.bodies)] for each in self._contacts.take_impulses(dt))
        self._rigid.apply_impulses(linear, angular)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Tell the cloth's contacts where the bodies are after a substep of dt [s]; 0 before the first."""
        from sim.cloth.rigid_contact import BodyMotion

        bodies, glue = self._rigid.bodies, self._rigid.glue
        motion = BodyMotion(
            velocity=bodies.velocity,
            angular_velocity=bodies.angular_velocity,
            acceleration=np.where(bodies.is_free[:, None], np.asarray(self._cloth.gravity), 0.0),
            inverse_mass=bodies.inverse_mass,
            inverse_inertia=bodies.inverse_inertia(),
        )
        if glue is not None:
            motion = replace(
                motion,
                inverse_mass=glue.movers.inverse_mass[glue.leader],
                inverse_inertia=glue.movers.inverse_inertia()[glue.leader],
                leader=glue.leader,
                arm=bodies.position - glue.movers.position[glue.leader],
            )
        self._contacts.rigid.place(self._rigid.poses(), motion, self._rigid.time_s)

    def resume(self) -> None:
        """Tell the cloth's contacts where the restored bodies are, and how rough they are now."""
        self._contacts.rigid.set_friction(self._rigid.surfaces.friction)
        self.follow(0.0)


def contacts_of_cloths(
    cloth: ClothSolver,
    bodies: Sequence[RigidBodyParameters],
    *,
    domain: DomainParameters,
    rigid: RigidSolver | None = None,
    passing: NDArray[np.bool_] | None = None,
) -> ContinuousContacts:
    """The contacts of all cloths with themselves, with all rigid bodies and with walls.

    Joints may let some pass through each other, (cloths, b).

    Raises:
        ValueError: a cloth starts inside a body.
    """
    from sim.cloth.continuous_contacts import ContinuousContacts
    from sim.cloth.rigid_contact import RigidContact

    static = [body for body in bodies if body.kind == "static"]
    moving = [body for body in bodies if body.kind != "static"]
    geometries = [BodyGeometry(body) for body in static] if rigid is None else rigid.all_geometries
    walls = walls_of(domain)
    contact = RigidContact(geometries, [body.friction for body in (*moving, *static)], walls, len(cloth.parameters))
    poses = _poses_of_static_bodies(static, geometries) if rigid is None else rigid.poses()
    contact.place(poses)
    names = [body.name for body in (*moving, *static)]
    passing = np.zeros((len(cloth.parameters), len(names)), dtype=bool) if passing is None else passing
    _refuse_start_inside(cloth.state, names, geometries, poses, passing)
    return ContinuousContacts(cloth.state, rigid=contact)


def _poses_of_static_bodies(bodies: Sequence[RigidBodyParameters], geometries: Sequence[BodyGeometry]) -> Poses:
    turned = np.array([rotation.matrices(rotation.from_degrees(body.rotation_deg)) for body in bodies]).reshape(
        -1, 3, 3
    )
    arms = np.array([geometry.centre_of_mass for geometry in geometries]).reshape(-1, 3)
    origins = np.array([body.position for body in bodies], dtype=np.float64).reshape(-1, 3)
    return Poses(origins + np.einsum("nij,nj->ni", turned, arms), turned)


def _refuse_start_inside(
    state: ClothState,
    names: Sequence[str],
    geometries: Sequence[BodyGeometry],
    poses: Poses,
    passing: NDArray[np.bool_],
) -> None:
    """Refuse cloth that starts in a body: it would be pulled out through the nearest side, be it the wrong one.

    Pinned nodes are where the job wants them, be it in a post.
    """
    positions, is_free = state.positions(), state.inverse_mass.to_numpy() > 0.0
    for number, (name, geometry) in enumerate(zip(names, geometries, strict=True)):
        relative = (positions - poses.position[number]) @ poses.rotation[number]
        low, high = geometry.bounds
        meets = is_free & ~passing[state.host.body, number]
        near = np.flatnonzero(meets & np.all((relative > low) & (relative < high), axis=1))
        distance = geometry.signed_distance(relative[near])
        if len(near) and distance.min() < -ROUND_OFF:
            inside, deepest = np.count_nonzero(distance < -ROUND_OFF), near[int(np.argmin(distance))]
            where = ", ".join(f"{value:.3g}" for value in positions[deepest])
            raise ValueError(
                f'cloth "{state.names[int(state.host.body[deepest])]}" starts inside "{name}" with {inside} of '
                f"its nodes, deepest at ({where}) m; move one of the two"
            )
