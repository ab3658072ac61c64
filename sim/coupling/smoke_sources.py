"""Sources of smoke that are fixed to rigid bodies that move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim.rigid import rotation
from sim.rigid.keyframes import Motion
from sim.smoke.source_motion import BodyMotion

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver
    from sim.smoke.solver import SmokeSolver


class SmokeSourcesOnBodies:
    """Takes the sources of a smoke along with the bodies that they follow.

    The smoke takes its own steps; before each, bodies go ahead to its end, and a source emits all along the way of its
    body in the step. One way: what it blows out does not push the body.

    Attributes:
        bodies: names of the rigid solver and of the smoke.
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

    def follow(self, dt: float) -> None:
        """Bodies do not feel their sources."""

    def resume(self) -> None:
        """Sources are where their bodies are now."""
        for number, motion in self._sources:
            motion.stay(self._body(number))

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
