"""Sets: ground, backdrop and the lights that belong to them, and the extra lights of a job."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from blender_scripts.camera import aim, pixel_angle
from blender_scripts.compatibility import node_tree_of, set_physical_sky
from blender_scripts.errors import RenderInputError
from blender_scripts.geometry import TriangleMesh, new_mesh_object
from blender_scripts.looks import new_material
from blender_scripts.shading import Color, LookContext, NodeBuilder, mix_shaders, or_default

_REFERENCE_SIZE_M = math.sqrt(3.0)
"""Diagonal of the domain that the lights' powers are written for."""

_SKY_MAP_PIXELS = 256
"""Across the map by which light samples choose their way into the sky: 1.4 degrees each."""
_HDRI_MAP_PIXELS = 1024
"""The same for an HDRI, where a sun of half a degree may be: 0.35 degrees each."""

GREY: Color = (0.22, 0.25, 0.29)
"""Of the ground and backdrop of a set that has no colour of its own."""
_CATCHER_REACH = 2.1
"""Radius of the shadow catcher where there is no background, in diagonals of the domain."""

_SUNLIGHT: Color = (1.0, 0.94, 0.86)
"""Of the sun outdoors at its usual height, linear RGB."""
_USUAL_ELEVATION_DEG = 38.0
_OPTICAL_DEPTH: Color = (0.04, 0.10, 0.24)
"""Of clean air overhead, by Rayleigh scattering, at 680, 550 and 440 nm (Bucholtz 1995)."""

_WINDOW_DISTANCE = 1.7
"""Of the window of a room, from the domain's middle, in diagonals of the domain."""

PLASTER: Color = (0.56, 0.52, 0.46)
"""Of the walls and the floor of the room."""


@dataclass(frozen=True)
class SetGeometry:
    """Geometry that a set is built around.

    Attributes:
        centre: middle of the domain [m].
        floor_z: height of the ground [m].
        size: diagonal of the domain [m].
        to_camera: horizontal unit vector from the domain towards the camera.
        camera_circle: how far from the domain's middle the camera gets, if it goes around it [m].
        pixel_angle: width of a pixel at a distance of 1 m [m/m].
    """

    centre: Vector
    floor_z: float
    size: float
    to_camera: Vector
    camera_circle: float | None
    pixel_angle: float

    @classmethod
    def of(cls, spec: dict[str, Any]) -> SetGeometry:
        """The geometry for a specification, seen from where its camera starts."""
        box_min, box_max = Vector(spec["domain_min"]), Vector(spec["domain_max"])
        centre = (box_min + box_max) / 2
        camera = spec["camera"]
        towards = Vector(camera["position"]) - Vector(camera["look_at"])
        towards.z = 0.0
        # A camera straight above has no horizontal direction; any will do.
        to_camera = towards.normalized() if towards.length > 1e-6 else Vector((0.0, -1.0, 0.0))
        size = (box_max - box_min).length
        return cls(centre, box_min.z, size, to_camera, camera["distance_all_round"], pixel_angle(spec))

    def place(self, *, right: float, towards_camera: float, above_floor: float) -> Vector:
        """A point given in domain sizes, in axes that turn with the camera [m]."""
        rightwards = Vector((-self.to_camera.y, self.to_camera.x, 0.0))
        offset = self.size * (right * rightwards + towards_camera * self.to_camera)
        return Vector((self.centre.x + offset.x, self.centre.y + offset.y, self.floor_z + self.size * above_floor))

    @property
    def power_scale(self) -> float:
        """Factor on powers [W] that keeps irradiance when the whole set grows."""
        return (self.size / _REFERENCE_SIZE_M) ** 2


def build_set(spec: dict[str, Any], folder: Path) -> None:
    """Build the set that a specification names, and its extra lights.

    Args:
        spec: the specification.
        folder: that paths in it are relative to.

    Raises:
        RenderInputError: the picture around the scene cannot be read.
    """
    geometry, parameters = SetGeometry.of(spec), spec["set"]
    if parameters["hdri"] is None:
        SETS[parameters["name"]](parameters, geometry)
    else:
        _build_under_hdri(parameters, geometry, folder / parameters["hdri"])
    for index, light in enumerate(spec["lights"]):
        _add_extra_light(f"light {index}", light)


def plain_background(parameters: dict[str, Any]) -> Color | None:
    """The colour to lay pictures over once they are drawn, linear RGB; None for those that stay as they are."""
    if parameters["background"] != "plain":
        return None
    return _ground_color(parameters, PLASTER if parameters["name"] == "window" and parameters["hdri"] is None else GREY)


def _build_studio(parameters: dict[str, Any], geometry: SetGeometry) -> None:
    """A cyclorama with a small warm key, a large cool fill and strong rims: water and smoke read by their rims."""
    backdrop = _cyclorama(geometry) if geometry.camera_circle is None else _round_cyclorama(geometry)
    _add_ground(backdrop, "cyclorama", parameters, geometry)
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


def _build_outdoor(parameters: dict[str, Any], geometry: SetGeometry) -> None:
    """Ground to the horizon, a physical sky and a sun: at the left and behind the scene where the job does not say."""
    _add_ground(_plain(geometry), "ground", parameters, geometry)

    elevation_deg, azimuth_deg = parameters["sun_elevation_deg"], parameters["sun_azimuth_deg"]
    elevation = math.radians(elevation_deg)
    if azimuth_deg is None:
        from_sun = geometry.place(right=-1.0, towards_camera=-0.45, above_floor=0.0) - geometry.place(
            right=0.0, towards_camera=0.0, above_floor=0.0
        )
        horizontal = from_sun.normalized()
    else:
        horizontal = Vector((math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg)), 0.0))
    towards_sun = Vector((horizontal.x * math.cos(elevation), horizontal.y * math.cos(elevation), math.sin(elevation)))
    sun = _new_light("sun", "SUN", 5.5 * parameters["strength"], _sunlight(elevation_deg))
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


def _sunlight(elevation_deg: float) -> Color:
    """Colour of the sun's light after its way through the air: a low sun is dim and red.

    I = I_0 exp(-tau m) for each channel; the air mass m is that of Kasten & Young 1989, eq. 3.

    Args:
        elevation_deg: above the horizon [degrees].
    """
    longer = _air_mass(elevation_deg) - _air_mass(_USUAL_ELEVATION_DEG)
    red, green, blue = (
        channel * math.exp(-depth * longer) for channel, depth in zip(_SUNLIGHT, _OPTICAL_DEPTH, strict=True)
    )
    return red, green, blue


def _air_mass(elevation_deg: float) -> float:
    """Air on the way of the sun's light, in thicknesses of the atmosphere overhead [-]."""
    return 1.0 / (math.sin(math.radians(elevation_deg)) + 0.50572 * (elevation_deg + 6.07995) ** -1.6364)


def _build_night(parameters: dict[str, Any], geometry: SetGeometry) -> None:
    """Ground to the horizon under a dark sky, for what glows; a moon from behind draws rims on what does not."""
    _add_ground(_plain(geometry), "ground", parameters, geometry)
    moon = _new_light("moon", "SUN", 0.4 * parameters["strength"], (0.66, 0.80, 1.0))
    # Wider than the real one, of half a degree: its shadows are soft, as those of a night in a film are.
    moon.angle = math.radians(4.0)
    _add_light_object("moon", moon, geometry.place(right=0.8, towards_camera=-1.2, above_floor=1.0), geometry.centre)
    _set_gradient_world(0.05 * parameters["strength"])
    bpy.context.scene.world.cycles.sampling_method = "NONE"


def _build_window(parameters: dict[str, Any], geometry: SetGeometry) -> None:
    """A room: light falls in through a window of four panes at the left, and what the walls give back is warm.

    A camera that stays sees two walls of it; one that goes around, a whole room around its way.
    """
    _add_ground(_plain(geometry), "floor", parameters, geometry, own=PLASTER)
    wall = _matt("wall", _ground_color(parameters, PLASTER))
    # In diagonals of the domain, as `SetGeometry.place` takes them: the wall with the window, and the one behind.
    left, behind = -_WINDOW_DISTANCE, -1.9
    corners = [(left, 1.2), (left, behind), (30.0, behind)]
    if geometry.camera_circle is not None:
        half = max(3.0, 1.2 * geometry.camera_circle / geometry.size)
        left = -half
        corners = [(-half, half), (-half, -half), (half, -half), (half, half), (-half, half)]
    walls = _walls(geometry, corners, height=max(8.0, 1.5 * -left))
    _add_surface(walls, "walls", wall, parameters)
    # As large and bright from afar as it would be near. Bars between the panes: what shines shows a window, not a lamp.
    scale = -left / _WINDOW_DISTANCE
    # Four walls give more of the light back than two.
    power = (210.0 if geometry.camera_circle is None else 115.0) * scale**2
    power *= parameters["strength"] * geometry.power_scale
    for number, (across, up) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        pane = _new_light(f"pane {number}", "AREA", power, (0.86, 0.93, 1.0))
        pane.shape, pane.size = "SQUARE", 0.95 * scale * geometry.size
        height, forward = scale * (1.15 + 0.5 * up), scale * (0.15 + 0.5 * across)
        place = geometry.place(right=left + 0.01, towards_camera=forward, above_floor=height)
        inwards = geometry.place(right=0.0, towards_camera=forward, above_floor=height)
        window = _add_light_object(f"pane {number}", pane, place, inwards)
        window.visible_camera = parameters["background"] == "set"  # a window in the picture is what one expects
    bounce = _new_light("bounce", "AREA", 14.0 * parameters["strength"] * geometry.power_scale, (1.0, 0.86, 0.70))
    bounce.shape, bounce.size = "SQUARE", 2.2 * geometry.size
    target = geometry.place(right=0.0, towards_camera=0.0, above_floor=0.35)
    _add_light_object("bounce", bounce, geometry.place(right=2.2, towards_camera=0.6, above_floor=1.2), target)
    _set_gradient_world(0.35 * parameters["strength"])
    bpy.context.scene.world.cycles.sampling_method = "NONE"


def _build_under_hdri(parameters: dict[str, Any], geometry: SetGeometry, path: Path) -> None:
    """Ground to the horizon under the sky of a picture, lit by it alone."""
    _add_ground(_plain(geometry), "ground", parameters, geometry)
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise RenderInputError(f"cannot read the picture {path}: {error}") from error
    if not all(image.size):
        raise RenderInputError(f"cannot read the picture {path}: Blender finds no pixels in it")
    tree = _new_world_tree()
    coordinates, mapping = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
    # What lies in a direction shows the picture at the direction turned back.
    mapping.inputs["Rotation"].default_value = (0.0, 0.0, -math.radians(parameters["rotation_deg"]))
    texture = tree.nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    tree.links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
    tree.links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
    _connect_background(tree, texture.outputs["Color"], parameters["strength"])
    settings = bpy.context.scene.world.cycles
    settings.sampling_method, settings.sample_map_resolution = "MANUAL", _HDRI_MAP_PIXELS


SETS: dict[str, Callable[[dict[str, Any], SetGeometry], None]] = {
    "studio": _build_studio,
    "outdoor": _build_outdoor,
    "night": _build_night,
    "window": _build_window,
}
"""The function that builds each set, by its name in specifications."""


def _plain(geometry: SetGeometry) -> TriangleMesh:
    """A floor as far as the eye sees."""
    half = 60.0 * geometry.size
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    positions = np.array(
        [(geometry.centre.x + x, geometry.centre.y + y, geometry.floor_z) for x, y in corners], dtype=np.float32
    )
    return TriangleMesh(positions, np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32))


def _walls(geometry: SetGeometry, corners: list[tuple[float, float]], *, height: float) -> TriangleMesh:
    """Upright walls from corner to corner, each (right, towards the camera), in diagonals of the domain."""
    positions = [
        geometry.place(right=right, towards_camera=forward, above_floor=up)
        for up in (0.0, height)
        for right, forward in corners
    ]
    count = len(corners)
    here = np.arange(count - 1)
    triangles = np.concatenate(
        [np.stack([here, here + 1, here + 1 + count], axis=1), np.stack([here, here + 1 + count, here + count], axis=1)]
    )
    return TriangleMesh(np.array(positions, dtype=np.float32), triangles.astype(np.int32))


def _cyclorama(geometry: SetGeometry) -> TriangleMesh:
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


def _round_cyclorama(geometry: SetGeometry) -> TriangleMesh:
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


def _add_ground(
    mesh: TriangleMesh, name: str, parameters: dict[str, Any], geometry: SetGeometry, own: Color = GREY
) -> None:
    # A hair below the domain's floor: surfaces that lie on the floor would otherwise flicker against it.
    drop = 2e-6 * float(np.ptp(mesh.positions, axis=0).max())
    ground = _add_surface(mesh, name, _ground_material(name, parameters, geometry, own), parameters)
    ground.location.z = -drop
    if parameters["background"] != "set":
        _add_shadow_catcher(geometry, _ground_color(parameters, own), drop=0.5 * drop)


def _ground_material(name: str, parameters: dict[str, Any], geometry: SetGeometry, own: Color) -> Any:
    if parameters["ground"] is None:
        return _matt(name, _ground_color(parameters, own))
    context = LookContext.of(
        {"color": parameters["color"]},
        domain_size=geometry.size,
        pixel_angle=geometry.pixel_angle,
        surface="ground",
    )
    return new_material(name, parameters["ground"], context)


def _add_shadow_catcher(geometry: SetGeometry, color: Color, *, drop: float) -> None:
    """Ground around the domain of which pictures without a background show the shadows; seen by the camera alone.

    It fades out before a backdrop would begin to rise.
    """
    reach, fade_from = _CATCHER_REACH * geometry.size, 0.5 * _CATCHER_REACH * geometry.size
    middle = geometry.place(right=0.0, towards_camera=_CATCHER_REACH - 1.4, above_floor=0.0)
    corners = [middle + reach * Vector((x, y, 0.0)) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh = TriangleMesh(np.array(corners, dtype=np.float32), np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32))
    catcher = new_mesh_object("shadows", mesh)
    builder = NodeBuilder(bpy.data.materials.new("shadows"))
    place = builder.node("ShaderNodeNewGeometry").outputs["Position"]
    distance = builder.node("ShaderNodeVectorMath")
    distance.operation = "DISTANCE"
    builder.link(place, distance.inputs[0])
    distance.inputs[1].default_value = middle
    fade = builder.node("ShaderNodeMapRange")
    fade.interpolation_type = "SMOOTHSTEP"
    builder.link(distance.outputs["Value"], fade.inputs["Value"])
    fade.inputs["From Min"].default_value, fade.inputs["From Max"].default_value = fade_from, reach
    matt = builder.node("ShaderNodeBsdfDiffuse", Color=color)
    builder.surface(mix_shaders(builder, fade.outputs[0], matt, builder.node("ShaderNodeBsdfTransparent")))
    catcher.data.materials.append(builder.material)
    catcher.is_shadow_catcher = True
    catcher.location.z = -drop
    for kind in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(catcher, f"visible_{kind}", False)


def _add_surface(mesh: TriangleMesh, name: str, material: Any, parameters: dict[str, Any]) -> Any:
    """A surface of the set, which light and reflections meet whatever stands behind the picture."""
    surface = new_mesh_object(name, mesh)
    surface.data.materials.append(material)
    surface.visible_camera = parameters["background"] == "set"
    # What a wall keeps from the ground is none of the scene's shadows.
    surface.is_shadow_catcher = not surface.visible_camera
    return surface


def _matt(name: str, color: Color) -> Any:
    """A matt material. Most of the picture and of all bounces end on one: it is a tenth cheaper than a Principled."""
    material = bpy.data.materials.new(name)
    tree = node_tree_of(material)
    shader = tree.nodes.new("ShaderNodeBsdfDiffuse")
    shader.inputs["Color"].default_value = (*color, 1.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    return material


def _ground_color(parameters: dict[str, Any], own: Color) -> Color:
    red, green, blue = or_default(parameters["color"], own)
    return red, green, blue


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


def _add_light_object(name: str, light: Any, position: Vector, target: Vector) -> Any:
    blender_object = bpy.data.objects.new(name, light)
    aim(blender_object, position, target)
    # Lamps are reflected and refracted, but a glowing square in the picture itself would look like a mistake.
    blender_object.visible_camera = False
    bpy.context.scene.collection.objects.link(blender_object)
    return blender_object


def _add_extra_light(name: str, parameters: dict[str, Any]) -> None:
    light = _new_light(name, parameters["type"].upper(), parameters["power"], tuple(parameters["color"]))
    if parameters["type"] == "area":
        light.shape = "SQUARE"
        light.size = parameters["size"]
    elif parameters["type"] == "point":
        light.shadow_soft_size = parameters["size"]
    else:
        light.angle = math.radians(parameters["size"])
    _add_light_object(name, light, Vector(parameters["position"]), Vector(parameters["look_at"]))
