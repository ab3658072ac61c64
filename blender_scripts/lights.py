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
from blender_scripts.compatibility import set_physical_sky
from blender_scripts.errors import RenderInputError
from blender_scripts.geometry import new_mesh_object
from blender_scripts.looks import new_material
from blender_scripts.ply import SurfaceMesh
from blender_scripts.shading import Color, LookContext, NodeBuilder, or_default

_REFERENCE_SIZE_M = math.sqrt(3.0)  # diagonal of the domain that the lights' powers are written for

_SKY_MAP_PIXELS = 256  # across the map by which light samples choose their way into the sky: 1.4 degrees each
_HDRI_MAP_PIXELS = 1024  # the same for an HDRI, where a sun of half a degree may be: 0.35 degrees each

GREY: Color = (0.22, 0.25, 0.29)  # of the ground and backdrop of a set that has no colour of its own
_CATCHER_REACH = 2.1  # radius of the shadow catcher where there is no background, in diagonals of the domain

_SUNLIGHT: Color = (1.0, 0.94, 0.86)  # of the sun outdoors at its usual height, linear RGB
_USUAL_ELEVATION_DEG = 38.0
_OPTICAL_DEPTH: Color = (0.04, 0.10, 0.24)
"""Of clean air overhead, by Rayleigh scattering, at 680, 550 and 440 nm (Bucholtz 1995)."""

_WINDOW_DISTANCE = 1.7  # of the window of a room, from the domain's middle, in diagonals of the domain

PLASTER: Color = (0.56, 0.52, 0.46)  # of the walls and the floor of the room


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
    """Build the set that a specification names, and its extra lights; paths in it are relative to the folder.

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
        place = geometry.place(**placement)
        lamp = _add_square(name, power * strength, color, size * geometry.size, place=place, target=target)
        # A pool of light that fades around the domain; a lamp of 180° would draw its own plane across the backdrop.
        lamp.spread = math.radians(spread_deg)
    _set_gradient_world(parameters["strength"])


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
    place = geometry.centre + 3 * geometry.size * towards_sun
    _add_sun("sun", 5.5 * parameters["strength"], _sunlight(elevation_deg), 0.7, place=place, target=geometry.centre)

    builder = _new_world()
    sky = builder.node("ShaderNodeTexSky")
    # The sky's rotation is measured from +y, clockwise seen from above.
    set_physical_sky(sky, sun_elevation=elevation, sun_rotation=math.atan2(towards_sun.x, towards_sun.y))
    # Without its sun the sky is smooth. Cycles' own map of where it is bright is made anew for each frame, and so fine
    # that it takes a third of a draft's time.
    _shine(builder, sky.outputs["Color"], 0.14 * parameters["strength"], map_pixels=_SKY_MAP_PIXELS)


def _sunlight(elevation_deg: float) -> Color:
    """Colour of the sun's light after its way through the air: a low sun is dim and red.

    I = I_0 exp(-tau m) for each channel; the air mass m is that of Kasten & Young 1989, eq. 3.
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
    place = geometry.place(right=0.8, towards_camera=-1.2, above_floor=1.0)
    # Wider than the real one, of half a degree: its shadows are soft, as those of a night in a film are.
    _add_sun("moon", 0.4 * parameters["strength"], (0.66, 0.80, 1.0), 4.0, place=place, target=geometry.centre)
    _set_gradient_world(0.05 * parameters["strength"])


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
        height, forward = scale * (1.15 + 0.5 * up), scale * (0.15 + 0.5 * across)
        place = geometry.place(right=left + 0.01, towards_camera=forward, above_floor=height)
        inwards = geometry.place(right=0.0, towards_camera=forward, above_floor=height)
        name, size = f"pane {number}", 0.95 * scale * geometry.size
        _add_square(name, power, (0.86, 0.93, 1.0), size, place=place, target=inwards)
        # A window in the picture is what one expects.
        bpy.data.objects[name].visible_camera = parameters["background"] == "set"
    power = 14.0 * parameters["strength"] * geometry.power_scale
    place = geometry.place(right=2.2, towards_camera=0.6, above_floor=1.2)
    target = geometry.place(right=0.0, towards_camera=0.0, above_floor=0.35)
    _add_square("bounce", power, (1.0, 0.86, 0.70), 2.2 * geometry.size, place=place, target=target)
    _set_gradient_world(0.35 * parameters["strength"])


def _build_under_hdri(parameters: dict[str, Any], geometry: SetGeometry, path: Path) -> None:
    """Ground to the horizon under the sky of a picture, lit by it alone."""
    _add_ground(_plain(geometry), "ground", parameters, geometry)
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise RenderInputError(f"cannot read the picture {path}: {error}") from error
    if not all(image.size):
        raise RenderInputError(f"cannot read the picture {path}: Blender finds no pixels in it")
    builder = _new_world()
    # What lies in a direction shows the picture at the direction turned back.
    turn = (0.0, 0.0, -math.radians(parameters["rotation_deg"]))
    directions = builder.node("ShaderNodeTexCoord").outputs["Generated"]
    mapping = builder.node("ShaderNodeMapping", Vector=directions, Rotation=turn)
    texture = builder.node("ShaderNodeTexEnvironment", Vector=mapping.outputs["Vector"])
    texture.image = image
    _shine(builder, texture.outputs["Color"], parameters["strength"], map_pixels=_HDRI_MAP_PIXELS)


SETS: dict[str, Callable[[dict[str, Any], SetGeometry], None]] = {
    "studio": _build_studio,
    "outdoor": _build_outdoor,
    "night": _build_night,
    "window": _build_window,
}
"""The function that builds each set, by its name in specifications."""


def _plain(geometry: SetGeometry) -> SurfaceMesh:
    """A floor as far as the eye sees."""
    half = 60.0 * geometry.size
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    positions = np.array(
        [(geometry.centre.x + x, geometry.centre.y + y, geometry.floor_z) for x, y in corners], dtype=np.float32
    )
    return SurfaceMesh(positions, np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32))


def _walls(geometry: SetGeometry, corners: list[tuple[float, float]], *, height: float) -> SurfaceMesh:
    """Upright walls from corner to corner, each (right, towards the camera), in diagonals of the domain."""
    positions = [
        geometry.place(right=right, towards_camera=forward, above_floor=up)
        for up in (0.0, height)
        for right, forward in corners
    ]
    here = np.arange(len(corners) - 1)
    return _mesh(np.array(positions), _quads(here, here + 1, here + 1 + len(corners), here + len(corners)))


def _cyclorama(geometry: SetGeometry) -> SurfaceMesh:
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
    left = np.arange(len(profile) - 1)
    right = left + len(profile)
    return _mesh(positions, _quads(left, right, right + 1, left + 1))


def _round_cyclorama(geometry: SetGeometry) -> SurfaceMesh:
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
    heights = np.broadcast_to(profile[:, None, 1:], (len(profile), len(headings), 1))
    rings = np.concatenate([profile[:, None, :1] * directions, heights], axis=2)
    base = np.array((geometry.centre.x, geometry.centre.y, geometry.floor_z))
    positions = np.concatenate([rings.reshape(-1, 3), np.zeros((1, 3))]) + base
    count, middle = len(headings), len(profile) * len(headings)
    here = np.arange(count)
    beside = np.roll(here, -1)
    triangles = [np.stack([np.full(count, middle), here, beside], axis=1)]
    for inner in range(0, middle - count, count):
        outer = inner + count
        triangles.append(_quads(inner + here, outer + here, outer + beside, inner + beside))
    return _mesh(positions, np.concatenate(triangles))


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Two triangles for each quadrilateral of four vertices."""
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _mesh(positions: np.ndarray, triangles: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(positions.astype(np.float32), triangles.astype(np.int32))


def _add_ground(
    mesh: SurfaceMesh, name: str, parameters: dict[str, Any], geometry: SetGeometry, own: Color = GREY
) -> None:
    # A hair below the domain's floor: surfaces that lie on the floor would otherwise flicker against it.
    drop = 2e-6 * float(np.ptp(mesh.vertices, axis=0).max())
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
    reach = _CATCHER_REACH * geometry.size
    middle = geometry.place(right=0.0, towards_camera=_CATCHER_REACH - 1.4, above_floor=0.0)
    corners = [middle + reach * Vector((x, y, 0.0)) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    mesh = SurfaceMesh(np.array(corners, dtype=np.float32), np.array([(0, 1, 2), (0, 2, 3)], dtype=np.int32))
    catcher = new_mesh_object("shadows", mesh)
    material = bpy.data.materials.new("shadows")
    builder = NodeBuilder(material)
    place = builder.node("ShaderNodeNewGeometry").outputs["Position"]
    fade = builder.smoothstep(builder.vector_math("DISTANCE", place, middle), 0.5 * reach, reach)
    matt = builder.node("ShaderNodeBsdfDiffuse", Color=color)
    builder.surface(builder.mix_shaders(fade, matt, builder.node("ShaderNodeBsdfTransparent")))
    catcher.data.materials.append(material)
    catcher.is_shadow_catcher = True
    catcher.location.z = -drop
    for kind in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
        setattr(catcher, f"visible_{kind}", False)


def _add_surface(mesh: SurfaceMesh, name: str, material: Any, parameters: dict[str, Any]) -> Any:
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
    builder = NodeBuilder(material)
    builder.surface(builder.node("ShaderNodeBsdfDiffuse", Color=color))
    return material


def _ground_color(parameters: dict[str, Any], own: Color) -> Color:
    red, green, blue = or_default(parameters["color"], own)
    return red, green, blue


def _set_gradient_world(strength: float) -> None:
    """A dim dome, brighter overhead: something for water, glass and metal to reflect."""
    builder = _new_world()
    height = builder.split(builder.node("ShaderNodeTexCoord").outputs["Generated"])[2]
    color = builder.ramp(height, (0.0, (0.10, 0.13, 0.17)), (0.9, (0.72, 0.84, 1.0)))
    # It is smooth: found by chance it adds no noise worth a light sample at every bounce.
    _shine(builder, color, 0.35 * strength, map_pixels=None)


def _new_world() -> NodeBuilder:
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    return NodeBuilder(world, "ShaderNodeOutputWorld")


def _shine(builder: NodeBuilder, color: Any, strength: float, *, map_pixels: int | None) -> None:
    """Let the world shine; samples find where it is bright by a map of this width, or by chance."""
    builder.surface(builder.node("ShaderNodeBackground", Color=color, Strength=strength))
    settings = bpy.context.scene.world.cycles
    settings.sampling_method = "NONE" if map_pixels is None else "MANUAL"
    if map_pixels is not None:
        settings.sample_map_resolution = map_pixels


def _add_light(name: str, kind: str, energy: float, color: Color, *, place: Vector, target: Vector) -> Any:
    light = bpy.data.lights.new(name, kind)
    light.energy, light.color = energy, color
    blender_object = bpy.data.objects.new(name, light)
    aim(blender_object, place, target)
    # Lamps are reflected and refracted, but a glowing square in the picture itself would look like a mistake.
    blender_object.visible_camera = False
    bpy.context.scene.collection.objects.link(blender_object)
    return light


def _add_square(name: str, power: float, color: Color, size: float, *, place: Vector, target: Vector) -> Any:
    light = _add_light(name, "AREA", power, color, place=place, target=target)
    light.shape, light.size = "SQUARE", size
    return light


def _add_sun(name: str, irradiance: float, color: Color, angle_deg: float, *, place: Vector, target: Vector) -> None:
    _add_light(name, "SUN", irradiance, color, place=place, target=target).angle = math.radians(angle_deg)


def _add_extra_light(name: str, light: dict[str, Any]) -> None:
    power, color, size = light["power"], tuple(light["color"]), light["size"]
    place, target = Vector(light["position"]), Vector(light["look_at"])
    if light["type"] == "area":
        _add_square(name, power, color, size, place=place, target=target)
    elif light["type"] == "point":
        _add_light(name, "POINT", power, color, place=place, target=target).shadow_soft_size = size
    else:
        _add_sun(name, power, color, size, place=place, target=target)
