"""Stages: ground, backdrop and the lights that belong to them, and the extra lights of a job."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from blender_scripts.camera import aim
from blender_scripts.compatibility import node_tree_of, set_physical_sky
from blender_scripts.geometry import TriangleMesh, new_mesh_object

_REFERENCE_SIZE_M = math.sqrt(3.0)
"""Diagonal of the domain that the lights' powers are written for."""

_SKY_MAP_PIXELS = 256
"""Across the map by which light samples choose their way into the sky: 1.4 degrees each."""


@dataclass(frozen=True)
class StageGeometry:
    """What a stage is built around.

    Attributes:
        centre: middle of the domain [m].
        floor_z: height of the ground [m].
        size: diagonal of the domain [m].
        to_camera: horizontal unit vector from the domain towards the camera.
        camera_circle: how far from the domain's middle the camera gets, if it goes around it [m].
    """

    centre: Vector
    floor_z: float
    size: float
    to_camera: Vector
    camera_circle: float | None

    @classmethod
    def of(cls, spec: dict[str, Any]) -> StageGeometry:
        """The geometry for a specification, seen from where its camera starts."""
        box_min, box_max = Vector(spec["domain_min"]), Vector(spec["domain_max"])
        centre = (box_min + box_max) / 2
        camera = spec["camera"]
        towards = Vector(camera["position"]) - Vector(camera["look_at"])
        towards.z = 0.0
        # A camera straight above has no horizontal direction; any will do.
        to_camera = towards.normalized() if towards.length > 1e-6 else Vector((0.0, -1.0, 0.0))
        size = (box_max - box_min).length
        return cls(centre, box_min.z, size, to_camera, camera["distance_all_round"])

    def place(self, *, right: float, towards_camera: float, above_floor: float) -> Vector:
        """A point given in domain sizes, in axes that turn with the camera [m]."""
        rightwards = Vector((-self.to_camera.y, self.to_camera.x, 0.0))
        offset = self.size * (right * rightwards + towards_camera * self.to_camera)
        return Vector((self.centre.x + offset.x, self.centre.y + offset.y, self.floor_z + self.size * above_floor))

    @property
    def power_scale(self) -> float:
        """Factor on powers [W] that keeps irradiance when the whole stage grows."""
        return (self.size / _REFERENCE_SIZE_M) ** 2


def build_stage(spec: dict[str, Any]) -> None:
    """Build the stage that a specification names, and its extra lights."""
    geometry = StageGeometry.of(spec)
    STAGES[spec["stage"]["name"]](spec["stage"], geometry)
    for index, light in enumerate(spec["lights"]):
        _add_extra_light(f"light {index}", light)


def _build_studio(parameters: dict[str, Any], geometry: StageGeometry) -> None:
    """A cyclorama with a small warm key, a large cool fill and strong rims: water and smoke read by their rims."""
    backdrop = _cyclorama(geometry) if geometry.camera_circle is None else _round_cyclorama(geometry)
    _add_ground(backdrop, "cyclorama", parameters["color"])
    target = geometry.place(right=0.0, towards_camera=0.0, above_floor=0.22)
    strength = parameters["strength"] * geometry.power_scale
    for name, placement, size, spread_deg, power, color in (
        ("key", {"right": -1.15, "towards_camera": 0.75, "above_floor": 1.5}, 0.35, 110.0, 62.0, (1.0, 0.90, 0.78)),
        ("fill", {"right": 1.6, "towards_camera": 0.7, "above_floor": 1.0}, 1.6, 180.0, 24.0, (0.72, 0.86, 1.0)),
        ("rim", {"right": 0.45, "towards_camera": -1.45, "above_floor": 1.3}, 0.8, 95.0, 105.0, (0.86, 0.93, 1.0)),
        ("kicker", {"right": -1.3, "towards_camera": -0.8, "above_floor": 0.7}, 0.5, 95.0, 34.0, (1.0, 0.93, 0.84)),
    ):
        light = _new_light(name, "AREA", power * strength, color)
        light.shape = "SQUARE"
        light.size = size * geometry.size
        # A pool of light that fades around the domain; a lamp of 180° would draw its own plane across the backdrop.
        light.spread = math.radians(spread_deg)
        _add_light_object(name, light, geometry.place(**placement), target)
    _set_gradient_world(parameters["strength"])
    # The dome is dim and smooth: found by chance it adds no noise worth a light sample at every bounce.
    bpy.context.scene.world.cycles.sampling_method = "NONE"


def _build_outdoor(parameters: dict[str, Any], geometry: StageGeometry) -> None:
    """Ground to the horizon, a physical sky and a sun from behind the camera's left."""
    _add_ground(_plain(geometry), "ground", parameters["color"])

    elevation = math.radians(38.0)
    from_sun = geometry.place(right=-1.0, towards_camera=-0.45, above_floor=0.0) - geometry.place(
        right=0.0, towards_camera=0.0, above_floor=0.0
    )
    horizontal = from_sun.normalized()
    towards_sun = Vector((horizontal.x * math.cos(elevation), horizontal.y * math.cos(elevation), math.sin(elevation)))
    sun = _new_light("sun", "SUN", 5.5 * parameters["strength"], (1.0, 0.94, 0.86))
    sun.angle = math.radians(0.7)
    _add_light_object("sun", sun, geometry.centre + 3 * geometry.size * towards_sun, geometry.centre)

    tree = _new_world_tree()
    sky = tree.nodes.new("ShaderNodeTexSky")
    # The sky's rotation is measured from +y, clockwise seen from above.
    set_physical_sky(sky, sun_elevation=elevation, sun_rotation=math.atan2(towards_sun.x, towards_sun.y))
    _connect_background(tree, sky.outputs["Color"], 0.14 * parameters["strength"])
    # Without its sun the sky is smooth. Cycles' own map of where it is bright is made anew for each frame, and so fine
    # that it takes a third of a draft's time.
    settings = bpy.context.scene.world.cycles
    settings.sampling_method, settings.sample_map_resolution = "MANUAL", _SKY_MAP_PIXELS


def _build_night(parameters: dict[str, Any], geometry: StageGeometry) -> None:
    """Ground to the horizon under a dark sky, for what glows; a moon from behind draws rims on what does not."""
    _add_ground(_plain(geometry), "ground", parameters["color"])
    moon = _new_light("moon", "SUN", 0.4 * parameters["strength"], (0.66, 0.80, 1.0))
    # Wider than the real one, of half a degree: its shadows are soft, as those of a night in a film are.
    moon.angle = math.radians(4.0)
    _add_light_object("moon", moon, geometry.place(right=0.8, towards_camera=-1.2, above_floor=1.0), geometry.centre)
    _set_gradient_world(0.05 * parameters["strength"])
    bpy.context.scene.world.cycles.sampling_method = "NONE"


STAGES: dict[str, Callable[[dict[str, Any], StageGeometry], None]] = {
    "studio": _build_studio,
    "outdoor": _build_outdoor,
    "night": _build_night,
}
"""How each stage is built, by the name that a specification uses."""


def _plain(geometry: StageGeometry) -> TriangleMesh:
    """A floor as far as the eye sees."""
    half = 60.0 * geometry.size
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    positions = np.array(
        [(geometry.centre.x + x, geometry.centre.y + y, geometry.floor_z) for x, y in corners], dtype=np.float32
    )
    return TriangleMesh(positions, np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32))


def _cyclorama(geometry: StageGeometry) -> TriangleMesh:
    """A floor that curves up into a wall behind the domain, square to the camera's direction."""
    size = geometry.size
    radius, wall_distance, height, front, half_width = 1.6 * size, 3.0 * size, 9.0 * size, 12.0 * size, 14.0 * size
    angles = np.linspace(0.0, np.pi / 2, 33)
    # Profile in (away from the camera, up), from the front edge of the floor to the top of the wall.
    curve = np.stack([wall_distance - radius + radius * np.sin(angles), radius * (1 - np.cos(angles))], axis=1)
    profile = np.concatenate([[(-front, 0.0)], curve, [(wall_distance, height)]])
    away = np.array((-geometry.to_camera.x, -geometry.to_camera.y, 0.0))
    rightwards = np.array((-geometry.to_camera.y, geometry.to_camera.x, 0.0))
    base = np.array((geometry.centre.x, geometry.centre.y, geometry.floor_z))
    middle = base + profile[:, :1] * away + profile[:, 1:] * np.array((0.0, 0.0, 1.0))
    positions = np.concatenate([middle - half_width * rightwards, middle + half_width * rightwards])
    count = len(profile)
    left = np.arange(count - 1)
    right = left + count
    triangles = np.concatenate(
        [np.stack([left, right, right + 1], axis=1), np.stack([left, right + 1, left + 1], axis=1)]
    )
    return TriangleMesh(positions.astype(np.float32), triangles.astype(np.int32))


def _round_cyclorama(geometry: StageGeometry) -> TriangleMesh:
    """A floor that curves up into a wall all round, behind wherever the camera goes."""
    assert geometry.camera_circle is not None
    size = geometry.size
    radius, height = 1.6 * size, 3.5 * size
    wall_distance = max(6.0 * size, 1.3 * geometry.camera_circle + radius)
    angles = np.linspace(0.0, np.pi / 2, 33)
    # Profile in (distance from the middle, up), from where the floor ends to the top of the wall.
    curve = np.stack([wall_distance - radius + radius * np.sin(angles), radius * (1 - np.cos(angles))], axis=1)
    profile = np.concatenate([curve, [(wall_distance, height)]])
    headings = np.linspace(0.0, 2 * np.pi, 128, endpoint=False)
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    rings = np.concatenate(
        [
            profile[:, None, :1] * directions,
            np.broadcast_to(profile[:, None, 1:], (len(profile), len(headings), 1)),
        ],
        axis=2,
    )
    base = np.array((geometry.centre.x, geometry.centre.y, geometry.floor_z))
    positions = np.concatenate([rings.reshape(-1, 3), np.zeros((1, 3))]) + base
    count, middle = len(headings), len(profile) * len(headings)
    here = np.arange(count)
    beside = np.roll(here, -1)
    triangles = [np.stack([np.full(count, middle), here, beside], axis=1)]
    for ring in range(len(profile) - 1):
        inner, outer = ring * count, (ring + 1) * count
        triangles += [
            np.stack([inner + here, outer + here, outer + beside], axis=1),
            np.stack([inner + here, outer + beside, inner + beside], axis=1),
        ]
    return TriangleMesh(positions.astype(np.float32), np.concatenate(triangles).astype(np.int32))


def _add_ground(mesh: TriangleMesh, name: str, color: list[float]) -> None:
    ground = new_mesh_object(name, mesh)
    # A hair below the domain's floor: surfaces that lie on the floor would otherwise flicker against it.
    extent = float(np.ptp(mesh.positions, axis=0).max())
    ground.location.z = -2e-6 * extent
    material = bpy.data.materials.new(name)
    tree = node_tree_of(material)
    # Most of the picture and of all bounces end here: a plain matt surface is a tenth cheaper than a Principled one.
    shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (*color, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    ground.data.materials.append(material)


def _set_gradient_world(strength: float) -> None:
    """A dim dome, brighter overhead: something for water, glass and metal to reflect."""
    tree = _new_world_tree()
    coordinates = tree.nodes.new("ShaderNodeTexCoord")
    separate = tree.nodes.new("ShaderNodeSeparateXYZ")
    ramp = tree.nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.elements[0].position = 0.0
    ramp.color_ramp.elements[0].color = (0.10, 0.13, 0.17, 1.0)
    ramp.color_ramp.elements[1].position = 0.9
    ramp.color_ramp.elements[1].color = (0.72, 0.84, 1.0, 1.0)
    tree.links.new(coordinates.outputs["Generated"], separate.inputs["Vector"])
    tree.links.new(separate.outputs["Z"], ramp.inputs[0])
    _connect_background(tree, ramp.outputs["Color"], 0.35 * strength)


def _new_world_tree() -> Any:
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    return node_tree_of(world)


def _connect_background(tree: Any, color: Any, strength: float) -> None:
    background = tree.nodes.new("ShaderNodeBackground")
    background.inputs["Strength"].default_value = strength
    output = tree.nodes.new("ShaderNodeOutputWorld")
    tree.links.new(color, background.inputs["Color"])
    tree.links.new(background.outputs["Background"], output.inputs["Surface"])


def _new_light(name: str, kind: str, energy: float, color: tuple[float, float, float]) -> Any:
    light = bpy.data.lights.new(name, kind)
    light.energy = energy
    light.color = color
    return light


def _add_light_object(name: str, light: Any, position: Vector, target: Vector) -> None:
    blender_object = bpy.data.objects.new(name, light)
    aim(blender_object, position, target)
    # Lamps are reflected and refracted, but a glowing square in the picture itself would look like a mistake.
    blender_object.visible_camera = False
    bpy.context.scene.collection.objects.link(blender_object)


def _add_extra_light(name: str, parameters: dict[str, Any]) -> None:
    light = _new_light(name, parameters["type"].upper(), parameters["power"], tuple(parameters["color"]))
    if parameters["type"] == "area":
        light.shape = "SQUARE"
        light.size = parameters["size"]
    elif parameters["type"] == "point":
        light.shadow_soft_size = parameters["size"]
    _add_light_object(name, light, Vector(parameters["position"]), Vector(parameters["look_at"]))
