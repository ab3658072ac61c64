"""Static bodies: obstacles that never move."""

from __future__ import annotations

import numpy as np

from sim.core.snapshots import Snapshot
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.placement import build_solid


class StaticBody:
    """A rigid body that stays where its placement puts it.

    Attributes:
        name: its name in the job.
        solid: its region of the world.

    Raises:
        ShapeError: its shape cannot be built.
    """

    def __init__(self, parameters: RigidBodyParameters) -> None:
        self.name, self.solid = parameters.name, build_solid(parameters)

    def snapshot(self) -> Snapshot:
        """Its pose: the same at every frame."""
        arrays = {
            "position": self.solid.position.copy(),
            "orientation": self.solid.orientation,
            "velocity": np.zeros(3),
            "angular_velocity": np.zeros(3),
        }
        return Snapshot("rigid", arrays, {})
