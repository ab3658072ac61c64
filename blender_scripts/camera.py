"""The camera: where it stands, or where the documents of its frames say.

A document is `{"version": 1, "frame": 12, "views": [{"offset": from the frame [frames], "position": [m], "look_at":
[m], "focal_length_mm": [mm], "focus_distance": [m]}, ...]}`: where it is while the shutter is open.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from blender_scripts.documents import numbers_of, read_document
from blender_scripts.errors import RenderInputError
from blender_scripts.geometry import new_object
from blender_scripts.keyframes import forget_keyframes

SENSOR_WIDTH_MM = 36.0
VIEWS_VERSION = 1
_NEAREST_M = 1e-3  # a body that is looked at may pass through the camera, but its picture needs a near and a far plane
_LENGTHS = {"offset": 1, "position": 3, "look_at": 3, "focal_length_mm": 1, "focus_distance": 1}


def pixel_angle(spec: dict[str, Any]) -> float:
    """Width of the narrowest pixel in the middle of a picture, at a distance of 1 m [m/m]."""
    return SENSOR_WIDTH_MM / spec["camera"]["longest_focal_length_mm"] / max(spec["render"]["resolution"])


def add_camera(parameters: dict[str, Any]) -> Any:
    """Put the camera into the scene and make it the active one."""
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "AUTO"
    camera.sensor_width = SENSOR_WIDTH_MM
    if parameters["f_stop"] is not None:
        camera.dof.use_dof = True
        camera.dof.aperture_fstop = parameters["f_stop"]
    blender_object = new_object("camera", camera)
    set_view(blender_object, parameters)
    bpy.context.scene.camera = blender_object
    return blender_object


def place_camera(blender_object: Any, path: Path, *, frame: int) -> None:
    """Put the camera where the document of a frame says, and let it move while the shutter is open."""
    camera = blender_object.data
    for animated in (blender_object, camera):
        forget_keyframes(animated)
    before = None
    for view in read_views(path):
        set_view(blender_object, view)
        orientation = blender_object.rotation_quaternion
        if before is not None and before.dot(orientation) < 0.0:
            blender_object.rotation_quaternion = -orientation  # the same, on the short way from the one before
        before = blender_object.rotation_quaternion.copy()
        time = frame + view["offset"]
        for name in ("location", "rotation_quaternion"):
            blender_object.keyframe_insert(name, frame=time)
        for name in ("lens", "dof.focus_distance"):
            camera.keyframe_insert(name, frame=time)


def read_views(path: Path) -> list[dict[str, Any]]:
    """The views of a frame, in order.

    Raises:
        RenderInputError: the file is missing, of another version, or holds something else than views.
    """
    views = read_document(path, "views", version=VIEWS_VERSION).get("views")
    if not isinstance(views, list) or not views:
        raise RenderInputError(f"the views {path} hold none")
    for view in views:
        numbers_of(view, _LENGTHS, f"the views {path}")
    return views


def set_view(blender_object: Any, view: dict[str, Any]) -> None:
    """Put the camera where a view says."""
    position, look_at = Vector(view["position"]), Vector(view["look_at"])
    distance = max((look_at - position).length, _NEAREST_M)
    aim(blender_object, position, look_at)
    camera = blender_object.data
    camera.lens = view["focal_length_mm"]
    camera.clip_start, camera.clip_end = 1e-3 * distance, 1e3 * distance
    camera.dof.focus_distance = view["focus_distance"]


def aim(blender_object: Any, position: Vector, look_at: Vector) -> None:
    """Place a camera or light and turn its -z axis towards a point, +y up."""
    blender_object.location = position
    blender_object.rotation_mode = "QUATERNION"
    blender_object.rotation_quaternion = (look_at - position).to_track_quat("-Z", "Y")
