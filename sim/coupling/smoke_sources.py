"""Sources of smoke that are fixed to rigid bodies that move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sim.core.motion import rotation
from sim.core.motion.paths import Motion
from sim.core.solver import Coupling
from sim.smoke.source_motion import BodyMotion

if TYPE_CHECKING:
    from sim.rigid.parameters import RigidBodyParameters
    from sim.rigid.solver import RigidSolver
    from sim.smoke.parameters import SmokeParameters, SmokeSourceParameters
    from sim.smoke.solver import SmokeSolver


class SmokeSourcesOnBodies(Coupling):
    """Takes the sources of a smoke along with the bodies that they follow.

    The smoke takes its own steps; before each, bodies go ahead to its end, and a source emits all along the way of its
    body in the step. One way: what it blows out does not push the body.
    """

    is_loose = True

    def __init__(self, rigid: RigidSolver, smoke: SmokeSolver) -> None:
        """Couple the two; every body that a source follows must be one of the solver's."""
        self.bodies = (rigid.name, smoke.name)
        self._rigid, self._smoke = rigid, smoke
        self._sources = [
            (rigid.bodies.names.index(source.parameters.follow), source.motion)
            for source in smoke.sources
            if source.parameters.follow is not None and isinstance(source.motion, BodyMotion)
        ]
        self.resume()

    def exchange(self, dt: float) -> None:
        """Tell the sources where their bodies get in a step of the smoke of dt [s]."""
        begin_s = self._smoke.time_s
        for number, motion in self._sources:
            motion.carry(self._body(number), begin_s, begin_s + dt)

    def follow(self, dt: float) -> None:  # noqa: ARG002  (the coupling's protocol)
        """As `resume`, so that a run that goes on knows as much as one that begins from a checkpoint."""
        self.resume()

    def resume(self) -> None:
        """Sources are where their bodies are now, and move as these do."""
        for number, motion in self._sources:
            motion.go_on(self._body(number), self._smoke.time_s)

    def _body(self, number: int) -> Motion:
        """Of the shape's origin, which is not the centre of mass."""
        bodies = self._rigid.bodies
        arm = rotation.rotated(bodies.orientation[number], -self._rigid.solids[number].centre_of_mass)
        spin = bodies.angular_velocity[number].copy()
        return Motion(
            bodies.position[number] + arm,
            bodies.orientation[number].copy(),
            bodies.velocity[number] + np.cross(spin, arm),
            spin,
        )


def with_sources_on(smoke: SmokeParameters, bodies: Sequence[RigidBodyParameters]) -> SmokeParameters:
    """The smoke with its sources on static bodies where these stand; only those on bodies that move still follow.

    Raises:
        ValueError: a source follows a body that is not there.
    """
    by_name = {body.name: body for body in bodies}
    sources = []
    for number, source in enumerate(smoke.source):
        if source.follow is not None and source.follow not in by_name:
            raise ValueError(f'smoke "{smoke.name}", source {number}: no rigid body is named "{source.follow}"')
        body = None if source.follow is None else by_name[source.follow]
        sources.append(placed_on(source, body) if body is not None and body.kind == "static" else source)
    return smoke.model_copy(update={"source": tuple(sources)})


def placed_on(source: SmokeSourceParameters, body: RigidBodyParameters) -> SmokeSourceParameters:
    """The source where it is in the world at the start; one with a velocity blows along the world's axes there."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_euler("xyz", body.rotation_deg, degrees=True)
    own = Rotation.from_euler("xyz", source.rotation_deg, degrees=True)
    x, y, z = (np.asarray(body.position) + turned.apply(source.position)).tolist()
    a, b, c = (turned * own).as_euler("xyz", degrees=True).tolist()
    velocity = None if source.velocity is None else tuple(turned.apply(source.velocity).tolist())
    return source.model_copy(
        update={"position": (x, y, z), "rotation_deg": (a, b, c), "velocity": velocity, "follow": None}
    )
