"""Soft matter and rigid bodies, both ways."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sim.core.solver import Coupling
from sim.shapes.body_geometry import BodyGeometry
from sim.soft.contact import STICKS, BodyContacts

if TYPE_CHECKING:
    from sim.rigid.parameters import RigidBodyParameters
    from sim.rigid.solver import RigidSolver
    from sim.rigid.states import StaticBody
    from sim.soft.solver import SoftSolver


def contacts_of_soft(
    soft: SoftSolver,
    bodies: Sequence[RigidBodyParameters],
    rigid: RigidSolver | None,
    static: Sequence[StaticBody],
    *,
    mass: float,
) -> BodyContacts | None:
    """The bodies of a scene as its soft matter meets them, those that move first; None if there are none.

    `mass` is of soft matter and all that may move along with it [kg].
    """
    moving = [body for body in bodies if body.kind != "static"]
    standing = [body for body in bodies if body.kind == "static"]
    if not bodies:
        return None
    still = [BodyGeometry.of(body.solid) for body in static]
    geometries = [*(() if rigid is None else rigid.solids), *still]
    glue = None if rigid is None else rigid.glue
    whole_of = np.full(len(geometries), -1)
    for number, whole in enumerate(() if glue is None else glue.wholes):
        whole_of[whole.pieces] = number
    wholes = [] if glue is None else [BodyGeometry.of(whole.solid()) for whole in glue.wholes]
    own, glued = soft.parameters[0].friction, {*soft.parameters[0].sticks_to}
    friction = [
        STICKS if glued & {body.name, body.group} else math.sqrt(own * body.friction) for body in (*moving, *standing)
    ]
    contacts = BodyContacts(geometries, len(moving), friction, mass, wholes=wholes, whole_of=whole_of)
    rotation = np.array([body.solid.rotation for body in static]).reshape(-1, 3, 3)
    position = np.array([body.solid.position for body in static]).reshape(-1, 3)
    centre = np.array([geometry.centre_of_mass for geometry in still]).reshape(-1, 3)
    contacts.stand(position + np.einsum("nij,nj->ni", rotation, centre), rotation)
    return contacts


class SoftRigidCoupling(Coupling):
    """Soft matter pushes bodies, and bodies are in its way; see `sim.soft.contact`.

    A coupled step: soft matter meets the bodies where they are, and they get what its nodes lost; they take it in with
    gravity and contacts, and move. Linear and angular momentum are kept to rounding. Kinematic bodies push and feel
    nothing. What pieces of a body that breaks get, each for itself, stresses the faces between them.
    """

    def __init__(self, soft: SoftSolver, rigid: RigidSolver, contacts: BodyContacts) -> None:
        self.bodies = (soft.name, rigid.name)
        self._contacts, self._rigid, self._own_friction = contacts, rigid, soft.parameters[0].friction
        self.resume()

    def exchange(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Hand the impulses of the last substep to the bodies."""
        linear, angular = (each[: len(self._rigid.bodies)] for each in self._contacts.take_impulses())
        self._rigid.apply_impulses(linear, angular)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """Tell soft matter where the bodies are."""
        self.resume()

    def resume(self) -> None:
        """As `follow`."""
        self._contacts.rub(np.sqrt(self._own_friction * self._rigid.surfaces.friction))
        rigid, bodies, glue = self._rigid, self._rigid.bodies, self._rigid.glue
        motion = bodies.position, bodies.rotation(), bodies.velocity, bodies.angular_velocity
        together = None if glue is None else (glue.leader, glue.movers.position[glue.leader])
        self._contacts.move(*motion, rigid.time_s, rigid.mobility(), together)
