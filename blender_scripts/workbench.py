"""Blender's Workbench engine: a plain picture in a fraction of a second, for animatics.

It draws by OpenGL, on a machine without a screen through EGL, and ends the whole process where it finds neither. As a
script it says whether it can draw here, by drawing a picture of a few pixels, and prints WORKBENCH_READY.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean
from typing import Any

import bpy

from blender_scripts.look_table import LOOK_TABLE
from blender_scripts.optics import seen_across

_ALPHA_OF_CLEAR_BODIES = 0.45
_WATER_COLOR = (0.10, 0.36, 0.62)  # of a body that lets light through and has no colour of its own
_PALE = ("water", "glass", None)
_FIRE_COLOR = (0.95, 0.35, 0.05)


def apply_workbench_settings(bodies: Sequence[tuple[dict[str, Any], Any]], *, panes: Any | None) -> None:
    """Make the finished scene one that Workbench draws: flat colours like those of the looks, studio light, shadows.

    Args:
        bodies: descriptions from the render specification, each with the object that was made of it. Not by name:
            Blender gives a body another one if the set has its own already, as with a body called "ground".
        panes: the glass of the tank; None without one.
    """
    scene = bpy.context.scene
    scene.render.engine = "BLENDER_WORKBENCH"
    scene.render.use_motion_blur = False
    scene.display.render_aa = "FXAA"
    shading = scene.display.shading
    shading.light = "STUDIO"
    shading.color_type = "MATERIAL"
    shading.show_shadows = True
    shading.shadow_intensity = 0.35
    shading.show_cavity = False
    # AgX is for scenes of light without an upper end; these colours are those of a display.
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure = 0.0
    looks = {made.data.materials[0].name: described["material"] for described, made in bodies}
    for material in bpy.data.materials:
        material.diffuse_color = _viewport_color(material, looks.get(material.name, {}))
    for described, made in bodies:
        if made.type == "VOLUME":
            made.data.display.density = described["material"]["density"]
    # Workbench sorts no panes behind each other; the rims alone tell where the tank is.
    if panes is not None:
        panes.hide_render = True


def _viewport_color(material: Any, described: dict[str, Any]) -> tuple[float, float, float, float]:
    """Colour and opacity that stand for a material's nodes."""
    nodes = [] if material.node_tree is None else material.node_tree.nodes
    shader = next((node for node in nodes if node.type == "BSDF_PRINCIPLED"), None)
    color = described.get("color")
    look = LOOK_TABLE.get(described.get("look"))
    if look is not None and look.glows:
        return (*(color or _FIRE_COLOR), 1.0)
    if shader is None:
        return (*(color or (0.8, 0.8, 0.8)), 1.0)
    if shader.inputs["Transmission Weight"].default_value > 0.5:
        own = _WATER_COLOR if described.get("look") in _PALE else seen_across(described["look"])
        return (*(color or own), _ALPHA_OF_CLEAR_BODIES)
    return (*(color or _mean_color(shader.inputs["Base Color"])), 1.0)


def _mean_color(socket: Any) -> tuple[float, float, float]:
    """The colour of a socket, or the mean of those that flow into what it is linked to."""
    found: list[tuple[float, ...]] = []
    waiting, seen = [socket], set()
    while waiting:
        each = waiting.pop()
        if not each.is_linked:
            found.append(tuple(each.default_value)[:3])
            continue
        node = each.links[0].from_node
        if node.name not in seen:
            seen.add(node.name)
            waiting += [child for child in node.inputs if child.type == "RGBA" and child.enabled]
    if not found:
        return (0.8, 0.8, 0.8)
    red, green, blue = (fmean(channel) for channel in zip(*found, strict=True))
    return (red, green, blue)


if __name__ == "__main__":
    bpy.ops.wm.read_factory_settings(use_empty=True)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera
    bpy.context.scene.render.engine = "BLENDER_WORKBENCH"
    bpy.context.scene.render.resolution_x = bpy.context.scene.render.resolution_y = 16
    bpy.ops.render.render()
    print("WORKBENCH_READY", flush=True)
