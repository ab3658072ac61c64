"""No mirror of air between water and what it wets: tiny pictures without denoising."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import LUMINANCE, RENDER_FRAMES, draw_all, redness, spec_of, sphere, still_camera, write_mesh
from needed_blender import needs_bpy
from warm_python import run_python

from render.meshes import read_ply, write_ply
from render.parameters import CameraParameters, MaterialParameters
from render.poses import write_poses
from render.spec import MeshObject, MeshSequenceObject, MovingMeshObject, SceneObject

pytestmark = needs_bpy

REACH = 0.012  # of particles with a radius of 8 mm [m]
GAP = 0.002  # between the water and what it lies on, a quarter of a radius [m]
NO_REACH = 0.1 * GAP  # too short to reach across the gap [m]
WATER_TOP = 0.5
RED = MaterialParameters(look="plastic", color=(0.7, 0.02, 0.02), roughness=0.5)
CAMERA = still_camera(CameraParameters(position=(0.0, -3.0, 0.62), look_at=(0.0, 0.0, 0.3), focal_length_mm=70.0))


Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]  # positions, triangles and normals


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Mesh:
    """A closed box whose vertices belong to one side each: positions, triangles and outward normals."""
    corners = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]) * np.subtract(high, low) + low
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    sides = np.array([(0, 0, -1), (0, 0, 1), (0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0)])
    first = 4 * np.arange(6)[:, None]
    triangles = np.concatenate([first + np.array(three) for three in ((0, 1, 2), (0, 2, 3))])
    return corners[quads.ravel()], triangles, np.repeat(sides, 4, axis=0)


def write_water(folder: Path, *, hole: tuple[tuple[float, float, float], float] | None = None, frame: int = 0) -> None:
    """A block of water a hair above the floor, maybe with a round hole in it: its centre and radius."""
    positions, triangles, normals = box((-0.45, -0.4, GAP), (0.45, 0.4, WATER_TOP))
    if hole is not None:
        around, inside = sphere(*hole)
        triangles = np.concatenate([triangles, inside[:, ::-1] + len(positions)])
        normals = np.concatenate([normals, (np.array(hole[0]) - around) / hole[1]])
        positions = np.concatenate([positions, around])
    write_ply(folder / f"water{frame:06d}.ply", positions, triangles, normals=normals, velocities=0 * positions)


def layers(height: float) -> tuple[Mesh, Mesh]:
    """Two blocks of water, one a hair below and one a hair above a height [m]."""
    below = box((-0.45, -0.4, GAP), (0.45, 0.4, height - GAP))
    return below, box((-0.45, -0.4, height + GAP), (0.45, 0.4, WATER_TOP))


def write_layers(path: Path, height: float) -> None:
    """Both of them as one fluid."""
    below, above = layers(height)
    positions, normals = (np.concatenate([below[part], above[part]]) for part in (0, 2))
    triangles = np.concatenate([below[1], above[1] + len(below[0])])
    write_ply(path, positions, triangles, normals=normals, velocities=0 * positions)


def write_sheet(path: Path, height: float) -> None:
    """A level sheet, a little wider than the water."""
    vertices = np.array([(-0.46, -0.41, height), (0.46, -0.41, height), (0.46, 0.41, height), (-0.46, 0.41, height)])
    triangles = np.array([(0, 1, 2), (0, 2, 3)])
    up = np.tile((0, 0, 1), (4, 1))
    write_ply(path, vertices, triangles, normals=up, velocities=0 * vertices, uv=vertices[:, :2])


def water(wets_within: float, *, caustics: bool = False) -> MeshSequenceObject:
    # Hardly coloured: the surface alone decides what is seen.
    material = MaterialParameters(look="water", density=0.02, caustics=caustics)
    return MeshSequenceObject(name="water", file="water{frame}.ply", material=material, wets_within=wets_within)


def draw(folder: Path, *objects: SceneObject) -> np.ndarray:
    """Display values of frame 0 from 0 to 255, (72, 128, 3)."""
    return draw_frames(folder, 1, *objects)[0]


def draw_frames(folder: Path, count: int, *objects: SceneObject) -> list[np.ndarray]:
    """Display values of the first frames, all drawn in one process."""
    spec = spec_of(*objects, samples=4, motion_blur=False, resolution=(128, 72), quality="preview")
    return draw_all(folder, spec.model_copy(update={"camera": CAMERA}), range(count))


FLOOR = np.s_[58:62, 44:84]
"""Pixels of the floor through the water's front, which meet its lower side at some 80 degrees."""


def brightness(picture: np.ndarray, where: tuple[slice, slice]) -> float:
    return float((picture[where] @ LUMINANCE).mean())


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """A block of water that wets the floor."""
    folder = tmp_path_factory.mktemp("block")
    write_water(folder)
    return draw(folder, water(REACH))


def test_the_floor_under_water_is_seen_and_mirrors_nothing(tmp_path, block):
    write_water(tmp_path)
    bare, wet = brightness(draw(tmp_path), FLOOR), brightness(block, FLOOR)
    # What the water's surfaces keep back comes to 0.1 % in display values, noise of 4 samples to less.
    assert wet == pytest.approx(bare, rel=0.05)
    # What does not wet is a mirror, of the dark upper half of the room.
    assert brightness(draw(tmp_path, water(NO_REACH)), FLOOR) < 0.5 * wet


def test_light_that_caustics_bend_reaches_a_floor_under_water(tmp_path, block):
    """Cycles finds no way through two parallel surfaces, and a floor under a block of water was a quarter as bright."""
    write_water(tmp_path)
    bent = draw(tmp_path, water(REACH, caustics=True))
    # The light of the room's dome is not followed.
    assert brightness(bent, FLOOR) > 0.7 * brightness(block, FLOOR)


BALL = ((0.0, -0.1, 0.2), 0.12)
IN_FRONT = np.s_[36:66, 40:88]  # pixels of the ball as it is seen through the water's front
IN_FRONT_OF_ALL = np.s_[36:66, :]  # the same rows, wherever the ball is
EVERYWHERE = np.s_[:, :]


def draw_ball(folder: Path, material: MaterialParameters, *, gap: float, reach: float) -> np.ndarray:
    """A ball in a hole in the water that is so much wider than it."""
    center, radius = BALL
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), radius))
    write_water(folder, hole=(center, radius + gap))
    return draw(folder, water(reach), MeshObject(name="ball", file="ball.ply", position=center, material=material))


def red_pixels(picture: np.ndarray, where: tuple[slice, slice] = IN_FRONT) -> int:
    # Grey has 0.33; the bright upper side of the ball is paler than the rest.
    return int((redness(picture) > 0.42)[where].sum())


def test_a_ball_under_water_is_red_up_to_its_rim(tmp_path):
    wet, dry, apart = (
        red_pixels(draw_ball(tmp_path, RED, gap=gap, reach=reach))
        for gap, reach in ((GAP, REACH), (GAP, NO_REACH), (2.0 * REACH, REACH))
    )
    # Total reflection begins at three quarters of the radius, which leaves 0.56 of the disc.
    assert dry < 0.7 * wet
    # Water that is far from the ball has air around it, and its mirror.
    assert apart < 0.7 * wet


def test_the_wet_surface_follows_a_body_that_moves_and_turns(tmp_path):
    """A ball beside its mesh's origin, in a hole of the water that is where the ball is in that frame."""
    (_, y, z), radius = BALL
    beside = np.array([0.2, 0.0, 0.0])
    write_mesh(tmp_path / "ball.ply", *sphere(tuple(beside), radius))
    places = [(-0.25, y, z), (0.25, y, z)]
    for frame, (place, angle, offset) in enumerate(zip(places, (0.0, np.pi), (-beside, beside), strict=True)):
        write_water(tmp_path, hole=(place, radius + GAP), frame=frame)
        pose = {
            "position": np.add(place, offset),
            "orientation": np.array((np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))),
            "velocity": np.zeros(3),
            "angular_velocity": np.zeros(3),
        }
        write_poses(tmp_path / f"poses{frame:06d}.json", frame, {"ball": pose})
    ball = MovingMeshObject(name="ball", file="ball.ply", body="ball", poses="poses{frame}.json", material=RED)
    wet, dry = (
        [red_pixels(picture, IN_FRONT_OF_ALL) for picture in draw_frames(tmp_path, 2, water(reach), ball)]
        for reach in (REACH, NO_REACH)
    )
    # 288 and 300 against 170 and 172, as for the ball that stays.
    assert dry[0] < 0.7 * wet[0] and dry[1] < 0.7 * wet[1]


def test_cloth_that_lies_in_water_is_seen_wherever_it_is(tmp_path):
    """A red sheet between two blocks of water, each a hair from it: seen from above through the front of both."""
    for frame, height in enumerate((0.12, 0.26)):
        write_sheet(tmp_path / f"cloth{frame:06d}.ply", height)
        write_layers(tmp_path / f"water{frame:06d}.ply", height)
    material = MaterialParameters(look="cotton", color=RED.color)
    cloth = MeshSequenceObject(name="cloth", file="cloth{frame}.ply", material=material)
    wet, dry = (
        [red_pixels(picture, EVERYWHERE) for picture in draw_frames(tmp_path, 2, water(reach), cloth)]
        for reach in (REACH, NO_REACH)
    )
    # 1264 and 858 against 146 and 81, which are its edge and its image in the water's top.
    assert dry[0] < 0.3 * wet[0] and dry[1] < 0.3 * wet[1]


BETWEEN = np.s_[39:42, 40:88]
"""Pixels of where two blocks of water meet at a height of 0.26 m, through the front of the upper one."""
UPPER = {"name": "upper", "file": "upper{frame}.ply"}


def test_two_clear_fluids_that_meet_mirror_nothing(tmp_path, block):
    for name, (positions, triangles, normals) in zip(("water", "upper"), layers(0.26), strict=True):
        write_ply(tmp_path / f"{name}000000.ply", positions, triangles, normals=normals, velocities=0 * positions)
    met, apart = (
        brightness(draw(tmp_path, water(reach), water(reach).model_copy(update=UPPER)), BETWEEN)
        for reach in (REACH, NO_REACH)
    )
    # 156 where one block has 155; the sliver between them mirrors the dark upper half of the room, 69.
    assert met == pytest.approx(brightness(block, BETWEEN), rel=0.05)
    assert apart < 0.6 * met


def test_glass_in_water_bends_light_as_between_the_two(tmp_path):
    ball = draw_ball(tmp_path, MaterialParameters(look="glass"), gap=GAP, reach=REACH) @ LUMINANCE
    # A lens of 1.5 shows the room upside down, its dark half from the ball's middle down (129 there); relative to
    # water glass bends little (182, and 200 for the ground beside the ball).
    assert ball[46:49, 58:70].mean() > 155


GLASS = MaterialParameters(look="glass", color=(1.0, 1.0, 1.0))
CLEAR_HONEY = MaterialParameters(look="honey", density=1.0e-4)  # nothing but its refractive index of 1.49


def draw_in_honey(folder: Path, *, gap: float, reach: float) -> np.ndarray:
    """A ball of glass in a hole of clear honey that is so much wider than it."""
    center, radius = BALL
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), radius))
    write_water(folder, hole=(center, radius + gap))
    honey = water(reach).model_copy(update={"material": CLEAR_HONEY})
    return draw(folder, honey, MeshObject(name="ball", file="ball.ply", position=center, material=GLASS))


def test_glass_vanishes_in_a_liquid_of_its_refractive_index(tmp_path):
    """With a sliver of air around it, half a radius of a particle wide and more, it is a mirror."""
    write_water(tmp_path)
    alone = draw(tmp_path, water(REACH).model_copy(update={"material": CLEAR_HONEY}))

    def difference(**ball: float) -> float:
        return float(np.abs(draw_in_honey(tmp_path, **ball) - alone)[IN_FRONT].mean())

    covered, wide, dry = (
        difference(gap=gap, reach=reach) for gap, reach in ((GAP, REACH), (2.0 * GAP, REACH), (GAP, NO_REACH))
    )
    # Of 255; glass of 1.50 in honey of 1.49 is a weak lens, its tint and the noise of 4 samples come to the rest.
    assert covered < 0.25 * dry
    assert wide < 0.25 * dry


EXPORTED = """
import sys
from pathlib import Path
import bpy
from blender_scripts.render_frames import SceneRenderer
from blender_scripts.scene_file import SceneFile
folder = Path(sys.argv[1])
spec = folder / "spec.json"
SceneRenderer(spec, threads=1, gpu=None).save_surfaces(0, folder)
SceneFile(spec, threads=1, gpu=None)
nodes = bpy.data.materials["ball"].node_tree.nodes
print("ASKED", [node.attribute_name for node in nodes if node.type == "ATTRIBUTE"])
"""


@pytest.mark.parametrize(("look", "is_wet"), [("glass", False), ("metal", True)])
def test_an_exported_scene_has_whole_surfaces_beside_glass_that_is_not_told_of_what_covers_it(tmp_path, look, is_wet):
    center, radius = BALL
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), radius))
    write_water(tmp_path, hole=(center, radius + GAP))
    ball = MeshObject(name="ball", file="ball.ply", position=center, material=MaterialParameters(look=look))
    spec_of(water(REACH), ball).write(tmp_path / "spec.json")
    assert "ASKED []" in run_python(EXPORTED, str(tmp_path))
    surface = read_ply(tmp_path / "water.ply")
    beside = np.linalg.norm(surface.vertices - center, axis=1) < radius + 1.5 * GAP
    assert beside.any()
    assert (surface.wet[beside] > 0.5).all() == is_wet
    assert (surface.wet[beside] > 0.5).any() == is_wet
    assert (surface.wet[np.isclose(surface.vertices[:, 2], surface.vertices[:, 2].min())] > 0.5).any()  # on the floor


def test_a_surface_without_normals_is_refused(tmp_path):
    write_mesh(tmp_path / "water000000.ply", *sphere((0.0, 0.0, 0.5), 0.2))
    spec_of(water(REACH)).write(tmp_path / "spec.json")
    told = run_python(RENDER_FRAMES, str(tmp_path), "{frame}.png", "0")
    assert "REFUSED" in told and "has no normals (nx, ny, nz)" in told
