"""Cameras: the film's, as a browser draws it and looks through it."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from render.camera_path import SENSOR_WIDTH_MM, View


def begin_at(server: viser.ViserServer, position: ArrayLike, target: ArrayLike, *, fov: float) -> None:
    """Have pages begin at a place, looking at another [m], with this angle from the lower to the upper edge [rad]."""
    camera = server.initial_camera
    camera.position, camera.look_at = np.asarray(position, np.float64), np.asarray(target, np.float64)
    camera.up, camera.fov = (0.0, 0.0, 1.0), fov


def vertical_fov(view: View, aspect: float) -> float:
    """Angle between the lower and the upper edge of a picture [rad]; Blender's sensor fits its longer side."""
    tangent = SENSOR_WIDTH_MM / 2.0 / view.focal_length_mm
    return 2.0 * float(np.arctan(tangent / max(1.0, aspect)))


def camera_orientation(view: View) -> NDArray[np.float64]:
    """Unit quaternion w, x, y, z of a camera whose axes are right, down and forward, level as Blender's is."""
    forward = np.asarray(view.look_at, np.float64) - np.asarray(view.position, np.float64)
    distance = np.linalg.norm(forward)
    forward = forward / distance if distance > 0.0 else np.array([0.0, 0.0, -1.0])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    return quaternion_of(np.stack([right, np.cross(forward, right), forward], axis=1))


def quaternion_of(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternion w, x, y, z of a rotation matrix, whose columns are the turned axes."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])
