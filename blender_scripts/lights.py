"""Sets: ground, backdrop and the lights that belong to them, and the extra lights of a job."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from blender_scripts.camera import aim, pixel_angle
from blender_scripts.compatibility import set_physical_sky
from blender_scripts.errors import RenderInputError
from blender_scripts.flattening import Backplate, EvenColor
from blender_scripts.geometry import new_mesh_object, new_object
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
_SQUARE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


class SetBuilder:
    """What a set is built of, around the domain of a specification as its camera sees it at first.

    Attributes:
        parameters: of the set.
        centre: middle of the domain [m].
        floor_z: height of the ground [m].
        size: diagonal of the domain [m].
        to_camera, rightwards: horizontal unit vectors from the domain towards the camera, and to its right.
        camera_circle: how far from the domain's middle the camera gets, if it goes around it [m].
        pixel_angle: width of a pixel at a distance of 1 m [m/m].
        power: factor on powers [W]: the job's strength, and what keeps irradiance when the whole set grows.
    """

    def __init__(self, spec: dict[str, Any]) -> None:
        self.parameters: dict[str, Any] = spec["set"]
        box_min, box_max = Vector(spec["domain_min"]), Vector(spec["domain_max"])
        self.centre, self.floor_z, self.size = (box_min + box_max) / 2, box_min.z, (box_max - box_min).length
        camera = spec["camera"]
        towards = Vector(camera["position"]) - Vector(camera["look_at"])
        towards.z = 0.0
        # A camera straight above has no horizontal direction; any will do.
        self.to_camera = towards.normalized() if towards.length > 1e-6 else Vector((0.0, -1.0, 0.0))
        self.rightwards = Vector((-self.to_camera.y, self.to_camera.x, 0.0))
        self.camera_circle: float | None = camera["distance_all_round"]
        self.pixel_angle = pixel_angle(spec)
        self.power = self.parameters["strength"] * (self.size / _REFERENCE_SIZE_M) ** 2

    def place(self, right: float, forward: float, up: float) -> Vector:
        """A point right of the domain's middle, towards the camera and above the floor, in diagonals of it [m]."""
        offset = self.size * (right * self.rightwards + forward * self.to_camera)
        return Vector((self.centre.x + offset.x, self.centre.y + offset.y, self.floor_z + self.size * up))

    def color(self, own: Color = GREY) -> Color:
        """The job's colour, or the set's own."""
        return _color_of(self.parameters, own)

    def add_ground(self, mesh: SurfaceMesh, name: str, own: Color = GREY) -> None:
        """Ground in the job's look or colour, or the set's own; its shadows alone where there is no background."""
        # A hair below the domain's floor: surfaces that lie on the floor would otherwise flicker against it.
        drop = 2e-6 * float(np.ptp(mesh.vertices, axis=0).max())
        if self.parameters["ground"] is None:
            material = _matt(name, self.color(own))
        else:
            scene = {"domain_size": self.size, "pixel_angle": self.pixel_angle, "surface": "ground"}
            context = LookContext.of({"color": self.parameters["color"]}, **scene)
            material = new_material(name, self.parameters["ground"], context)
        self.add_surface(mesh, name, material).location.z = -drop
        if not shows_set(self.parameters):
            self._add_shadow_catcher(self.color(own)).location.z = -0.5 * drop

    def add_surface(self, mesh: SurfaceMesh, name: str, material: Any) -> Any:
        """A surface of the set, which light and reflections meet whatever stands behind the picture."""
        surface = new_mesh_object(name, mesh)
        surface.data.materials.append(material)
        surface.visible_camera = shows_set(self.parameters)
        # What a wall keeps from the ground is none of the scene's shadows.
        surface.is_shadow_catcher = not surface.visible_camera
        return surface

    def _add_shadow_catcher(self, color: Color) -> Any:
        """Ground around the domain of which pictures without a background show the shadows; seen by the camera alone.

        It fades out before a backdrop would begin to rise.
        """
        reach = _CATCHER_REACH * self.size
        middle = self.place(0.0, _CATCHER_REACH - 1.4, 0.0)
        catcher = new_mesh_object("shadows", _quad([middle + reach * Vector((x, y, 0.0)) for x, y in _SQUARE]))
        material = bpy.data.materials.new("shadows")
        builder = NodeBuilder(material)
        place = builder.node("ShaderNodeNewGeometry").outputs["Position"]
        fade = builder.smoothstep(builder.vector_math("DISTANCE", place, middle), 0.5 * reach, reach)
        matt = builder.node("ShaderNodeBsdfDiffuse", Color=color)
        builder.surface(builder.mix_shaders(fade, matt, builder.node("ShaderNodeBsdfTransparent")))
        catcher.data.materials.append(material)
        catcher.is_shadow_catcher = True
        for kind in ("diffuse", "glossy", "transmission", "volume_scatter", "shadow"):
            setattr(catcher, f"visible_{kind}", False)
        return catcher


def build_set(spec: dict[str, Any], folder: Path) -> None:
    """Build the set that a specification names, and its extra lights; paths in it are relative to the folder.

    Raises:
        RenderInputError: the picture around the scene cannot be read.
    """
    builder = SetBuilder(spec)
    if spec["set"]["hdri"] is None:
        SETS[spec["set"]["name"]](builder)
    else:
        _build_under_hdri(builder, folder / spec["set"]["hdri"])
    for index, light in enumerate(spec["lights"]):
        place, target = Vector(light["position"]), Vector(light["look_at"])
        kind, size = light["type"].upper(), light["size"]
        _add_light(f"light {index}", kind, light["power"], tuple(light["color"]), size, place=place, target=target)


def shows_set(parameters: dict[str, Any]) -> bool:
    """Whether the camera sees ground and sky themselves, and not only the shadows on the ground."""
    return parameters["background"] == "set" and parameters["backplate"] is None


def what_is_behind(parameters: dict[str, Any], folder: Path) -> EvenColor | Backplate | None:
    """What to lay pictures over once they are drawn; None for those that stay as they are.

    Raises:
        RenderInputError: the backplate cannot be read.
    """
    if parameters["backplate"] is not None:
        return Backplate(folder / parameters["backplate"])
    if parameters["background"] != "plain":
        return None
    return EvenColor(_plain_color(parameters))


def _plain_color(parameters: dict[str, Any]) -> Color:
    return _color_of(parameters, PLASTER if parameters["name"] == "window" and parameters["hdri"] is None else GREY)


def _color_of(parameters: dict[str, Any], own: Color) -> Color:
    red, green, blue = or_default(parameters["color"], own)
    return red, green, blue


def _build_studio(stage: SetBuilder) -> None:
    """A cyclorama with a small warm key, a large cool fill and strong rims: water and smoke read by their rims."""
    stage.add_ground(_cyclorama(stage) if stage.camera_circle is None else _round_cyclorama(stage), "cyclorama")
    target = stage.place(0.0, 0.0, 0.22)
    for name, place, size, spread_deg, power, color in (
        ("key", (-1.15, 0.75, 1.5), 0.35, 110.0, 62.0, (1.0, 0.90, 0.78)),
        ("fill", (1.6, 0.7, 1.0), 1.6, 180.0, 24.0, (0.72, 0.86, 1.0)),
        ("rim", (0.45, -1.45, 1.3), 0.8, 95.0, 105.0, (0.86, 0.93, 1.0)),
        ("kicker", (-1.3, -0.8, 0.7), 0.5, 95.0, 34.0, (1.0, 0.93, 0.84)),
    ):
        watts, edge = power * stage.power, size * stage.size
        lamp = _add_light(name, "AREA", watts, color, edge, place=stage.place(*place), target=target)
        # A pool of light that fades around the domain; a lamp of 180° would draw its own plane across the backdrop.
        lamp.data.spread = math.radians(spread_deg)
    _set_gradient_world(stage.parameters["strength"])


def _build_outdoor(stage: SetBuilder) -> None:
    """Ground to the horizon, a physical sky and a sun: at the left and behind the scene where the job does not say."""
    stage.add_ground(_plain(stage), "ground")
    strength, elevation_deg = stage.parameters["strength"], stage.parameters["sun_elevation_deg"]
    elevation = math.radians(elevation_deg)
    if stage.parameters["sun_azimuth_deg"] is None:
        horizontal = (stage.place(-1.0, -0.45, 0.0) - stage.place(0.0, 0.0, 0.0)).normalized()
    else:
        azimuth = math.radians(stage.parameters["sun_azimuth_deg"])
        horizontal = Vector((math.cos(azimuth), math.sin(azimuth), 0.0))
    towards_sun = Vector((horizontal.x * math.cos(elevation), horizontal.y * math.cos(elevation), math.sin(elevation)))
    place, target = stage.centre + 3 * stage.size * towards_sun, stage.centre
    _add_light("sun", "SUN", 5.5 * strength, _sunlight(elevation_deg), 0.7, place=place, target=target)
    builder = _new_world()
    sky = builder.node("ShaderNodeTexSky")
    # The sky's rotation is measured from +y, clockwise seen from above.
    set_physical_sky(sky, sun_elevation=elevation, sun_rotation=math.atan2(towards_sun.x, towards_sun.y))
    # Without its sun the sky is smooth. Cycles' own map of where it is bright is made anew for each frame, and so fine
    # that it takes a third of a draft's time.
    _shine(builder, sky.outputs["Color"], 0.14 * strength, map_pixels=_SKY_MAP_PIXELS)


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


def _build_night(stage: SetBuilder) -> None:
    """Ground to the horizon under a dark sky, for what glows; a moon from behind draws rims on what does not."""
    stage.add_ground(_plain(stage), "ground")
    strength, place = stage.parameters["strength"], stage.place(0.8, -1.2, 1.0)
    # Wider than the real one, of half a degree: its shadows are soft, as those of a night in a film are.
    _add_light("moon", "SUN", 0.4 * strength, (0.66, 0.80, 1.0), 4.0, place=place, target=stage.centre)
    _set_gradient_world(0.05 * strength)


def _build_window(stage: SetBuilder) -> None:
    """A room: light falls in through a window of four panes at the left, and what the walls give back is warm.

    A camera that stays sees two walls of it; one that goes around, a whole room around its way.
    """
    stage.add_ground(_plain(stage), "floor", own=PLASTER)
    # In diagonals of the domain, as `place` takes them: the wall with the window, and the one behind. Four walls give
    # more of the light back than two.
    if stage.camera_circle is None:
        left, power = -_WINDOW_DISTANCE, 210.0
        corners = [(left, 1.2), (left, -1.9), (30.0, -1.9)]
    else:
        half = max(3.0, 1.2 * stage.camera_circle / stage.size)
        left, power = -half, 115.0
        corners = [(-half, half), (-half, -half), (half, -half), (half, half), (-half, half)]
    walls = _walls(stage, corners, height=max(8.0, 1.5 * -left))
    stage.add_surface(walls, "walls", _matt("wall", stage.color(PLASTER)))
    # As large and bright from afar as it would be near. Bars between the panes: what shines shows a window, not a lamp.
    scale = -left / _WINDOW_DISTANCE
    power *= scale**2
    power *= stage.power
    for number, (across, up) in enumerate(((-1, -1), (1, -1), (-1, 1), (1, 1))):
        height, forward = scale * (1.15 + 0.5 * up), scale * (0.15 + 0.5 * across)
        place, inwards = stage.place(left + 0.01, forward, height), stage.place(0.0, forward, height)
        size = 0.95 * scale * stage.size
        pane = _add_light(f"pane {number}", "AREA", power, (0.86, 0.93, 1.0), size, place=place, target=inwards)
        # A window in the picture is what one expects.
        pane.visible_camera = shows_set(stage.parameters)
    place, target = stage.place(2.2, 0.6, 1.2), stage.place(0.0, 0.0, 0.35)
    power, size = 14.0 * stage.power, 2.2 * stage.size
    _add_light("bounce", "AREA", power, (1.0, 0.86, 0.70), size, place=place, target=target)
    _set_gradient_world(0.35 * stage.parameters["strength"])


def _build_under_hdri(stage: SetBuilder, path: Path) -> None:
    """Ground to the horizon under the sky of a picture, lit by it alone."""
    stage.add_ground(_plain(stage), "ground")
    try:
        image = bpy.data.images.load(str(path))
    except RuntimeError as error:
        raise RenderInputError(f"cannot read the picture {path}: {error}") from error
    if not all(image.size):
        raise RenderInputError(f"cannot read the picture {path}: Blender finds no pixels in it")
    builder = _new_world()
    # What lies in a direction shows the picture at the direction turned back.
    turn = (0.0, 0.0, -math.radians(stage.parameters["rotation_deg"]))
    directions = builder.node("ShaderNodeTexCoord").outputs["Generated"]
    mapping = builder.node("ShaderNodeMapping", Vector=directions, Rotation=turn)
    texture = builder.node("ShaderNodeTexEnvironment", Vector=mapping.outputs["Vector"])
    texture.image = image
    _shine(builder, texture.outputs["Color"], stage.parameters["strength"], map_pixels=_HDRI_MAP_PIXELS)


SETS: dict[str, Callable[[SetBuilder], None]] = {
    "studio": _build_studio,
    "outdoor": _build_outdoor,
    "night": _build_night,
    "window": _build_window,
}
"""The function that builds each set, by its name in specifications."""


def _plain(stage: SetBuilder) -> SurfaceMesh:
    """A floor as far as the eye sees."""
    half, centre = 60.0 * stage.size, stage.centre
    return _quad([(centre.x + x * half, centre.y + y * half, stage.floor_z) for x, y in _SQUARE])


def _walls(stage: SetBuilder, corners: list[tuple[float, float]], *, height: float) -> SurfaceMesh:
    """Upright walls from corner to corner, each (right, towards the camera), in diagonals of the domain."""
    positions = [stage.place(right, forward, up) for up in (0.0, height) for right, forward in corners]
    here = np.arange(len(corners) - 1)
    return _mesh(np.array(positions), _quads(here, here + 1, here + 1 + len(corners), here + len(corners)))


def _cyclorama(stage: SetBuilder) -> SurfaceMesh:
    """A floor that curves up into a wall behind the domain, square to the camera's direction."""
    size = stage.size
    profile = np.concatenate([[(-12.0 * size, 0.0)], _profile(1.6 * size, 3.0 * size, 9.0 * size)])
    away, rightwards = -np.array([*stage.to_camera]), np.array([*stage.rightwards])
    base = np.array((stage.centre.x, stage.centre.y, stage.floor_z))
    middle = base + profile[:, :1] * away + profile[:, 1:] * np.array((0.0, 0.0, 1.0))
    aside = 14.0 * size * rightwards
    left = np.arange(len(profile) - 1)
    right = left + len(profile)
    return _mesh(np.concatenate([middle - aside, middle + aside]), _quads(left, right, right + 1, left + 1))


def _round_cyclorama(stage: SetBuilder) -> SurfaceMesh:
    """A floor that curves up into a wall all round, behind wherever the camera goes."""
    assert stage.camera_circle is not None
    size, radius = stage.size, 1.6 * stage.size
    profile = _profile(radius, max(6.0 * size, 1.3 * stage.camera_circle + radius), 3.5 * size)
    headings = np.linspace(0.0, 2 * np.pi, 128, endpoint=False)
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    heights = np.broadcast_to(profile[:, None, 1:], (len(profile), len(headings), 1))
    rings = np.concatenate([profile[:, None, :1] * directions, heights], axis=2)
    base = np.array((stage.centre.x, stage.centre.y, stage.floor_z))
    positions = np.concatenate([rings.reshape(-1, 3), np.zeros((1, 3))]) + base
    count, middle = len(headings), len(profile) * len(headings)
    here = np.arange(count)
    beside = np.roll(here, -1)
    triangles = [np.stack([np.full(count, middle), here, beside], axis=1)]
    for inner in range(0, middle - count, count):
        outer = inner + count
        triangles.append(_quads(inner + here, outer + here, outer + beside, inner + beside))
    return _mesh(positions, np.concatenate(triangles))


def _profile(radius: float, wall_distance: float, height: float) -> np.ndarray:
    """The end of a floor that curves up into a wall: distances and heights, (n, 2) [m]."""
    angles = np.linspace(0.0, np.pi / 2, 33)
    curve = np.stack([wall_distance - radius + radius * np.sin(angles), radius * (1 - np.cos(angles))], axis=1)
    return np.concatenate([curve, [(wall_distance, height)]])


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Two triangles for each quadrilateral of four vertices."""
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _quad(corners: Sequence[Any]) -> SurfaceMesh:
    return _mesh(np.array(corners), _quads(*np.arange(4)[:, None]))


def _mesh(positions: np.ndarray, triangles: np.ndarray) -> SurfaceMesh:
    return SurfaceMesh(positions.astype(np.float32), triangles.astype(np.int32))


def _matt(name: str, color: Color) -> Any:
    """A matt material. Most of the picture and of all bounces end on one: it is a tenth cheaper than a Principled."""
    material = bpy.data.materials.new(name)
    builder = NodeBuilder(material)
    builder.surface(builder.node("ShaderNodeBsdfDiffuse", Color=color))
    return material


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


def _add_light(name: str, kind: str, energy: float, color: Color, size: float, *, place: Vector, target: Vector) -> Any:
    """The object of a lamp; its size is an area's edge or a point's radius [m], or the angle across a sun [degrees]."""
    light = bpy.data.lights.new(name, kind)
    light.energy, light.color = energy, color
    if kind == "AREA":
        light.shape, light.size = "SQUARE", size
    elif kind == "POINT":
        light.shadow_soft_size = size
    else:
        light.angle = math.radians(size)
    lamp = new_object(name, light)
    aim(lamp, place, target)
    # Lamps are reflected and refracted, but a glowing square in the picture itself would look like a mistake.
    lamp.visible_camera = False
    return lamp
