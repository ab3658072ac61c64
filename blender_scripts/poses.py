"""Poses of rigid bodies: from the document of a frame onto Blender objects, with the motion that is to be blurred.

The document is `{"version": 1, "frame": 12, "bodies": {NAME: {"position": [m], "orientation": [w, x, y, z],
"velocity": [m/s], "angular_velocity": [rad/s]}}}`; a pose places the body's mesh at rest, axes are the world's, and
the velocity is that of the mesh's origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from blender_scripts.documents import numbers_of, read_document
from blender_scripts.errors import RenderInputError
from blender_scripts.keyframes import forget_keyframes, reach_of_motion

POSES_VERSION = 1
_LENGTHS = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}


@dataclass(frozen=True)
class Pose:
    """Pose and velocity of a body, as in the document."""

    position: np.ndarray
    orientation: np.ndarray
    velocity: np.ndarray
    angular_velocity: np.ndarray

    def after(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Position and orientation a short time before or after, both velocities kept: x + v t, exp(omega t / 2) q."""
        half_turn = self.angular_velocity * (0.5 * time_s)
        angle = float(np.linalg.norm(half_turn))
        # sin(a) / a, also where a is 0
        turn = np.concatenate([[np.cos(angle)], np.sinc(angle / np.pi) * half_turn])
        return self.position + self.velocity * time_s, _product(turn, self.orientation)


def read_poses(path: Path) -> dict[str, Pose]:
    """The poses of a frame, by body.

    Raises:
        RenderInputError: the file is missing, of another version, or holds something else than poses.
    """
    document = read_document(path, "poses", version=POSES_VERSION)
    bodies = document.get("bodies")
    if not isinstance(bodies, dict) or not all(isinstance(values, dict) for values in bodies.values()):
        raise RenderInputError(f"the poses {path} hold no bodies")
    return {name: _pose(path, name, values) for name, values in bodies.items()}


def place(blender_object: Any, pose: Pose, *, frame: int) -> None:
    """Put an object where its body is at a frame, and let it move while the shutter is open.

    Cycles looks at an object when the shutter opens, in the middle and when it closes, or for vectors a frame before
    and after. These are the times that get a keyframe each, so nothing depends on how Blender interpolates.
    """
    scene = bpy.context.scene
    forget_keyframes(blender_object)
    reach = reach_of_motion()
    frames_per_second = scene.render.fps / scene.render.fps_base
    for offset in sorted({-reach, 0.0, reach}):
        position, orientation = pose.after(offset / frames_per_second)
        blender_object.location = position
        blender_object.rotation_quaternion = orientation
        for path in ("location", "rotation_quaternion"):
            blender_object.keyframe_insert(path, frame=frame + offset)


def _pose(path: Path, name: str, values: dict[str, Any]) -> Pose:
    arrays = numbers_of(values, _LENGTHS, f"the poses {path}", f' of "{name}"')
    if not 0.99 < np.linalg.norm(arrays["orientation"]) < 1.01:
        raise RenderInputError(f'the poses {path}: the orientation of "{name}" is no unit quaternion')
    return Pose(**arrays)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation b followed by a, as a quaternion: the Hamilton product a b."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    vector = a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])
    return np.concatenate([[scalar], vector])
