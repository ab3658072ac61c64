"""The camera: where it stands, and how it frames the domain by itself."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

SENSOR_WIDTH_MM = 36.0
# A three-quarter view from slightly above: both sides of a box and its top are seen.
_AZIMUTH = math.radians(-62.0)
_ELEVATION = math.radians(17.0)
_MARGIN = 0.05


@dataclass(frozen=True)
class View:
    """Where the camera stands and what it looks at [m]."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]


def frame_box(
    box_min: np.ndarray,
    box_max: np.ndarray,
    *,
    focal_length_mm: float,
    aspect: float,
    azimuth: float = _AZIMUTH,
    elevation: float = _ELEVATION,
    margin: float = _MARGIN,
) -> View:
    """The closest view from a given direction that shows a whole box, centred.

    In camera axes (right x, up y, forward z) a corner is inside the frustum of a camera at (a, b, -d) if
    |x - a| <= t_x (z + d) and |y - b| <= t_y (z + d), where t is the tangent of half the field of view. For one axis
    alone the smallest d is (max(x/t - z) + max(-x/t - z)) / 2, and a lies in the middle; the larger d of the two
    axes serves both.

    Args:
        box_min: lower corner [m], (3,).
        box_max: upper corner [m], (3,).
        focal_length_mm: of the lens, on a 36 mm sensor.
        aspect: width over height of the picture.
        azimuth: direction from the box to the camera, around z from +x [rad].
        elevation: of the camera above the horizon [rad].
        margin: share of the picture that stays free on each side.

    Returns:
        The view.
    """
    corners = np.array(list(itertools.product(*zip(box_min, box_max, strict=True))), dtype=np.float64)
    centre = (np.asarray(box_min, dtype=np.float64) + np.asarray(box_max, dtype=np.float64)) / 2
    forward = -np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    x, y, z = ((corners - centre) @ np.stack([right, up, forward], axis=1)).T

    # Blender's sensor fits the longer side of the picture.
    tangent_long = SENSOR_WIDTH_MM / 2 / focal_length_mm
    tangent_x = tangent_long * min(1.0, aspect) * (1 - 2 * margin)
    tangent_y = tangent_long / max(1.0, aspect) * (1 - 2 * margin)
    distances, shifts = [], []
    for offset, tangent in ((x, tangent_x), (y, tangent_y)):
        positive, negative = np.max(offset / tangent - z), np.max(-offset / tangent - z)
        distances.append((positive + negative) / 2)
        shifts.append(tangent * (positive - negative) / 2)
    target = centre + shifts[0] * right + shifts[1] * up
    position = target - max(distances) * forward
    return View(tuple(map(float, position)), tuple(map(float, target)))


def choose_view(spec: dict[str, Any]) -> View:
    """The view that a specification asks for; it frames the domain where the specification leaves it open."""
    camera = spec["camera"]
    width, height = spec["render"]["resolution"]
    box_min, box_max = np.array(spec["domain_min"]), np.array(spec["domain_max"])
    automatic = frame_box(box_min, box_max, focal_length_mm=camera["focal_length_mm"], aspect=width / height)
    position, look_at = camera["position"], camera["look_at"]
    if position is None:
        return View(automatic.position, automatic.look_at if look_at is None else tuple(look_at))
    return View(tuple(position), tuple((box_min + box_max) / 2) if look_at is None else tuple(look_at))


def pixel_angle(spec: dict[str, Any]) -> float:
    """Width of a pixel in the middle of the picture, at a distance of 1 m [m/m]."""
    return SENSOR_WIDTH_MM / spec["camera"]["focal_length_mm"] / max(spec["render"]["resolution"])


def add_camera(spec: dict[str, Any], view: View) -> None:
    """Put the camera into the scene and make it the active one."""
    parameters = spec["camera"]
    position, look_at = Vector(view.position), Vector(view.look_at)
    distance = (look_at - position).length
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "AUTO"
    camera.sensor_width = SENSOR_WIDTH_MM
    camera.lens = parameters["focal_length_mm"]
    camera.clip_start = 1e-3 * distance
    camera.clip_end = 1e3 * distance
    if parameters["f_stop"] is not None:
        camera.dof.use_dof = True
        camera.dof.aperture_fstop = parameters["f_stop"]
        camera.dof.focus_distance = distance
    blender_object = bpy.data.objects.new("camera", camera)
    aim(blender_object, position, look_at)
    bpy.context.scene.collection.objects.link(blender_object)
    bpy.context.scene.camera = blender_object


def aim(blender_object: Any, position: Vector, look_at: Vector) -> None:
    """Place a camera or light and turn its -z axis towards a point, +y up."""
    blender_object.location = position
    blender_object.rotation_mode = "QUATERNION"
    blender_object.rotation_quaternion = (look_at - position).to_track_quat("-Z", "Y")
