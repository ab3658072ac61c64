"""Static bodies: obstacles that never move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.core.snapshots import Snapshot
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.placement import build_solid
from sim.shapes.sampling import sample_surface
from sim.shapes.solid import TriangleMesh


class StaticBody:
    """A rigid body that stays where its placement puts it.

    Attributes:
        name: its name in the job.
        solid: its region of the world.
    """

    def __init__(self, parameters: RigidBodyParameters) -> None:
        """Build the body.

        Raises:
            ShapeError: its shape cannot be built.
        """
        self.name = parameters.name
        self.solid = build_solid(parameters)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired or assumed to build its shape, one sentence each."""
        return self.solid.warnings

    def rest_mesh(self, max_edge: float | None = None) -> TriangleMesh:
        """Its surface, scaled but neither rotated nor moved: the mesh that the poses of its snapshots place."""
        return self.solid.rest_mesh(max_edge)

    def surface_samples(self, spacing: float) -> NDArray[np.float32]:
        """Evenly spread points on its surface in world coordinates [m], (m, 3), for boundary handling.

        They are sampled on the mesh at rest and then placed, so that two bodies of one shape carry the same pattern.
        """
        samples = sample_surface(self.rest_mesh(), spacing).astype(np.float64)
        return (samples @ self.solid.rotation.T + self.solid.position).astype(np.float32)

    def snapshot(self) -> Snapshot:
        """Its pose: the same at every frame."""
        return Snapshot(
            kind="rigid",
            arrays={
                "position": self.solid.position.copy(),
                "orientation": self.solid.orientation,
                "velocity": np.zeros(3),
                "angular_velocity": np.zeros(3),
            },
            attributes={},
        )
