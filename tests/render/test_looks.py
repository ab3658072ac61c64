"""Looks as Cycles draws them, by what tells them apart: tiny pictures without denoising, in child processes."""

from __future__ import annotations

from math import sqrt
from pathlib import Path

import numpy as np
import pytest
from blender_scenes import LUMINANCE, RESOLUTION, draw_all, spec_of, sphere, still_camera, write_mesh
from needed_blender import needs_bpy

from blender_scripts.optics import usual_density
from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters, SetParameters
from render.spec import MeshObject, MeshSequenceObject, SceneObject

pytestmark = needs_bpy

QUARTER_TURN = (sqrt(0.5), 0.0, sqrt(0.5), 0.0)  # about the y axis, along which the camera looks


def draw(folder: Path, *objects: SceneObject, **render: object) -> np.ndarray:
    """Display values of frame 0 from 0 to 255, (rows, columns, 3)."""
    (picture,) = draw_all(folder, spec_of(*objects, **{"samples": 24, "motion_blur": False, **render}))
    return picture


def patch(picture: np.ndarray, x: float, z: float, half: float) -> np.ndarray:
    """The square around a point of the plane y = 0, of this half edge, all in metres."""
    scale = picture.shape[1] * 50.0 / 36.0 / 2.5
    column, row = picture.shape[1] / 2 + x * scale, picture.shape[0] / 2 - (z - 0.5) * scale
    reach = half * scale
    return picture[round(row - reach) : round(row + reach), round(column - reach) : round(column + reach)]


def liquid(look: str, size: float = 0.32, **keys: object) -> MaterialParameters:
    """A look as it is by itself on a body of a size [m]."""
    material = MaterialParameters.model_validate({"look": look, **keys})
    return material.model_copy(update={"density": usual_density(look, size, material.color)})


@pytest.fixture(scope="module")
def liquids(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Mean colour of the middle of a ball of each."""
    folder = tmp_path_factory.mktemp("liquids")
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.2))
    places = {"water": -0.5, "honey": 0.0, "milk": 0.5}
    picture = draw(
        folder,
        *(
            MeshObject(name=look, file="ball.ply", position=(x, 0.0, 0.5), material=liquid(look))
            for look, x in places.items()
        ),
        resolution=(128, 72),
        samples=8,
    )
    return {look: patch(picture, x, 0.5, 0.12).mean(axis=(0, 1)) for look, x in places.items()}


def test_honey_lets_red_light_through_and_keeps_blue_back(liquids):
    red, green, blue = liquids["honey"]
    # Its blue absorbs six times as much as its green, which is what makes it amber and not grey.
    assert red > 1.1 * green > 1.3 * blue


def test_water_is_bluish_and_milk_a_warm_white(liquids):
    assert liquids["water"][2] > liquids["water"][0]
    assert liquids["milk"][0] > liquids["milk"][2]
    # Saturation of a white that reflects 0.91 of red light and 0.76 of blue is far below honey's.
    assert np.ptp(liquids["milk"]) < 0.25 * np.ptp(liquids["honey"])


def test_milk_is_the_brightest_and_none_is_black_or_burnt_out(liquids):
    luminances = {look: color @ LUMINANCE for look, color in liquids.items()}
    assert max(luminances, key=luminances.__getitem__) == "milk"
    assert all(25 < luminance < 245 for luminance in luminances.values())


@pytest.fixture(scope="module")
def drinks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Mean colour of the middle of a ball of each, of the size of a glass."""
    folder = tmp_path_factory.mktemp("drinks")
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.13))
    places = dict(
        zip(("wine", "oil", "coffee", "ink", "juice", "muddy_water"), np.linspace(-0.72, 0.72, 6), strict=True)
    )
    picture = draw(
        folder,
        *(
            MeshObject(name=look, file="ball.ply", position=(x, 0.0, 0.5), material=liquid(look, 0.21))
            for look, x in places.items()
        ),
        resolution=(128, 72),
        samples=8,
    )
    return {look: patch(picture, x, 0.5, 0.08).mean(axis=(0, 1)) for look, x in places.items()}


def test_liquids_have_their_colours(drinks):
    red, green, blue = drinks["wine"]
    # The lower half of the ball shows the dark upper half of the room, and the reflection of lamps is white.
    assert red > 1.5 * max(green, blue)
    red, green, blue = drinks["oil"]
    assert min(red, green) > 1.5 * blue and red < 1.3 * green
    assert drinks["coffee"] @ LUMINANCE < 0.2 * (drinks["oil"] @ LUMINANCE)
    red, green, blue = drinks["ink"]
    assert blue > 1.3 * max(red, green)
    red, green, blue = drinks["juice"]
    assert red > 1.2 * green > 1.5 * blue
    red, green, blue = drinks["muddy_water"]
    assert red > green > blue
    assert drinks["muddy_water"] @ LUMINANCE < drinks["juice"] @ LUMINANCE


@pytest.mark.parametrize("look", ["honey", "milk"])
def test_density_decides_how_far_light_gets_inside(look, tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.5), 0.3))
    thin, dense = (
        draw(
            tmp_path,
            MeshObject(name=look, file="ball.ply", material=MaterialParameters(look=look, density=density)),
            resolution=(128, 72),
            samples=4,
        )
        for density in (0.02, 0.5)
    )
    # The backdrop shows through thin honey. In thin milk, light that entered far away fills the shadow below; 500
    # pixels of 4 samples are good to two per cent.
    z, half, factor = (0.5, 0.2, 1.3) if look == "honey" else (0.3, 0.06, 1.05)
    lighter, darker = ((patch(each, 0.0, z, half) @ LUMINANCE).mean() for each in (thin, dense))
    assert lighter > factor * darker


def stripes(picture: np.ndarray) -> float:
    """How much more the picture changes from left to right than up and down [-]: above 1 for upright stripes."""
    luminance = picture @ LUMINANCE
    # Second differences: shading is smooth, and stripes are not.
    across, down = np.diff(luminance, 2, axis=1), np.diff(luminance, 2, axis=0)
    return float(np.abs(across).mean() / np.abs(down).mean())


WOOD = MaterialParameters(look="wood", roughness=1.0)


def test_wood_is_brown_and_has_a_grain_that_plastic_of_its_colour_lacks(tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.25))
    plain = MaterialParameters(look="plastic", color=(0.36, 0.19, 0.085), roughness=1.0)
    left, right = (
        MeshObject(name=look.look, file="ball.ply", position=(x, 0.0, 0.5), material=look)
        for look, x in ((WOOD, -0.35), (plain, 0.35))
    )
    picture = draw(tmp_path, left, right, resolution=(128, 72), samples=16)
    wood, plastic = patch(picture, -0.35, 0.5, 0.15), patch(picture, 0.35, 0.5, 0.15)
    red, green, blue = wood.mean(axis=(0, 1))
    assert red > 1.1 * green > 1.2 * blue
    # The same light and the same mean colour within a third; the grain is what differs.
    assert (wood @ LUMINANCE).mean() == pytest.approx((plastic @ LUMINANCE).mean(), rel=0.33)
    rough, smooth = (np.abs(np.diff(each @ LUMINANCE, 2, axis=1)).mean() for each in (wood, plastic))
    assert rough > 1.5 * smooth


def test_the_grain_of_wood_runs_along_a_body_and_turns_with_it(tmp_path):
    """A texture that hung on the world would show the same stripes whichever way the body is turned."""
    positions, triangles = sphere((0.0, 0.0, 0.0), 0.25)
    write_mesh(tmp_path / "egg.ply", positions * (0.9, 0.9, 1.2), triangles)
    upright, lying = (
        MeshObject(name=name, file="egg.ply", position=(x, 0.0, 0.5), orientation=turn, material=WOOD)
        for name, x, turn in (("upright", -0.35, (1.0, 0.0, 0.0, 0.0)), ("lying", 0.35, QUARTER_TURN))
    )
    picture = draw(tmp_path, upright, lying, resolution=(128, 72), samples=16)
    assert stripes(patch(picture, -0.35, 0.5, 0.15)) > 1.25
    assert stripes(patch(picture, 0.35, 0.5, 0.15)) < 0.8


def test_the_grain_of_a_sheet_hangs_on_its_coordinates_at_rest(tmp_path):
    """The sheet stays where it is, its coordinates at rest turn: so does the grain."""
    side = np.linspace(-0.45, 0.45, 12)
    x, z = (each.ravel() for each in np.meshgrid(side, side, indexing="ij"))
    positions = np.stack([x, np.zeros_like(x), z + 0.5], axis=1)
    corner = (np.arange(11)[:, None] * 12 + np.arange(11)).ravel()
    a, b, c, d = corner, corner + 12, corner + 13, corner + 1
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    pictures = []
    for name, uv in (("along", np.stack([x, z], axis=1)), ("across", np.stack([z, x], axis=1))):
        folder = tmp_path / name
        folder.mkdir()
        normals = np.broadcast_to((0.0, -1.0, 0.0), positions.shape)
        write_ply(folder / "sheet000000.ply", positions, triangles, normals=normals, velocities=0 * positions, uv=uv)
        sheet = MeshSequenceObject(name="sheet", file="sheet{frame}.ply", material=WOOD)
        pictures.append(patch(draw(folder, sheet, resolution=(128, 72), samples=16), 0.0, 0.5, 0.35))
    assert stripes(pictures[0]) > 1.25
    assert stripes(pictures[1]) < 0.8


@pytest.fixture(scope="module")
def empty_set(tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    return draw(tmp_path_factory.mktemp("empty"), samples=8)


@pytest.mark.parametrize("look", ["glass", "metal", "stone", "ceramic", "plastic", "rubber"])
def test_solid_looks_are_lit_and_differ_from_the_set_behind_them(look, tmp_path, empty_set):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.5), 0.3))
    ball = MeshObject(name=look, file="ball.ply", material=MaterialParameters(look=look))
    with_ball = draw(tmp_path, ball, samples=8)
    seen = patch(with_ball, 0.0, 0.5, 0.2) @ LUMINANCE
    assert 25 < seen.mean() < 245
    changed = np.abs(with_ball - empty_set).max(axis=2) > 12.0
    # A disc of 0.3 m at 2.5 m, seen by 1.39 tangents a picture's width; glass hides least of what is behind it.
    disc = np.pi * (RESOLUTION[0] * 50.0 / 36.0 * 0.3 / sqrt(2.5**2 - 0.3**2)) ** 2
    assert changed.sum() > (0.3 if look == "glass" else 0.6) * disc


def test_caustics_bend_the_sun_s_light_and_leave_the_rest_of_the_ground_as_it_is(tmp_path):
    """A ball of glass gathers the light that its shadow lacks; without them it lets light straight through."""
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.3), 0.3, rings=48, segments=96))
    above = still_camera(CameraParameters(position=(0.0, -1.2, 2.6), look_at=(0.15, 0.1, 0.0)))
    pictures = []
    for caustics in (False, True):
        glass = MaterialParameters(look="glass", caustics=caustics)
        ball = MeshObject(name="ball", file="ball.ply", material=glass)
        scene = {"set": SetParameters(name="outdoor", strength=0.5), "camera": above}
        (picture,) = draw_all(tmp_path, spec_of(ball, samples=16, motion_blur=False).model_copy(update=scene))
        pictures.append(picture @ LUMINANCE)
    straight, bent = pictures
    ground = straight[:, :8].mean()
    # A far disc stands for the sun: the same light to a hundredth, and noise of 16 samples over 288 pixels.
    assert bent[:, :8].mean() == pytest.approx(ground, rel=0.02)
    behind = np.s_[8:28, 38:60]  # the ground beside the ball, away from the sun
    assert bent[behind].min() < 0.75 * straight[behind].min()
    assert bent[behind].max() > 1.1 * ground


@pytest.mark.parametrize("look", ["wood", "stone", "metal"])
def test_bodies_of_one_look_differ_by_their_names_and_by_nothing_else(look, tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.3))

    def ball(name: str, **keys: object) -> np.ndarray:
        material = MaterialParameters.model_validate({"look": look, **keys})
        return draw(tmp_path, MeshObject(name=name, file="ball.ply", position=(0.0, 0.0, 0.5), material=material))

    first, again, other = ball("oak"), ball("oak"), ball("ash")
    np.testing.assert_array_equal(first, again)
    assert np.abs(patch(first, 0.0, 0.5, 0.2) - patch(other, 0.0, 0.5, 0.2)).mean() > 2.0


def test_what_the_job_says_of_metal_is_the_same_for_all_names(tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.3))
    brass = MaterialParameters(look="metal", color=(0.8, 0.6, 0.3), roughness=0.2)
    one, two = (
        draw(tmp_path, MeshObject(name=name, file="ball.ply", position=(0.0, 0.0, 0.5), material=brass), samples=4)
        for name in ("oak", "ash")
    )
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_red_wine_is_red_in_a_domain_of_any_size(factor, tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.2))
    wine = liquid("water", color=(0.45, 0.02, 0.03))
    ball = MeshObject(name="wine", file="ball.ply", position=(0.0, 0.0, 0.5), material=wine)
    domain = {"domain_min": (-0.5 * factor, -0.5 * factor, 0.0), "domain_max": (0.5 * factor, 0.5 * factor, factor)}
    (picture,) = draw_all(tmp_path, spec_of(ball, samples=24, motion_blur=False).model_copy(update=domain))
    red, green, blue = patch(picture, 0.0, 0.5, 0.1).mean(axis=(0, 1))
    assert red > 2.5 * max(green, blue)
