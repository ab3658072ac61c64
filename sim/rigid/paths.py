"""Paths of kinematic bodies."""

from __future__ import annotations

import numpy as np

from sim.core.motion import rotation
from sim.core.motion.paths import Path, SteadyPath, path_through
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import AnimationShape


def path_of(parameters: RigidBodyParameters) -> Path:
    """The path of a kinematic body: of its file, through its keyframes, or steady.

    Raises:
        ShapeError: its file cannot be used.
    """
    if isinstance(parameters.shape, AnimationShape):
        from sim.shapes.animation import path_of_animation

        return path_of_animation(parameters, parameters.shape)
    if not parameters.keyframe:
        return SteadyPath(
            np.asarray(parameters.position, dtype=np.float64),
            rotation.from_degrees(parameters.rotation_deg),
            np.asarray(parameters.velocity, dtype=np.float64),
            np.asarray(parameters.angular_velocity, dtype=np.float64),
        )
    return path_through(parameters.keyframe, linear=parameters.interpolation == "linear")
