"""Smoke and fire as Cycles draws them, against optics: tiny pictures, in child processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bare_volumes import PICTURE_WIDTH_M, draw_bare, smoke_object, write_frame
from blender_scenes import LUMINANCE, RENDER_FRAMES, read, spec_of
from needed_blender import needs_bpy
from warm_python import run_python

from blender_scripts.black_body import black_body_color, relative_luminance
from render.parameters import MaterialParameters

pytestmark = [needs_bpy, pytest.mark.slow]

BLACK = (0.0, 0.0, 0.0)
LENGTH_M = 0.6
MIDDLE = np.s_[24:40, 24:40]


def depth_of(picture: np.ndarray) -> float:
    """Optical depth, by the light that comes through."""
    return float(-np.log(picture[MIDDLE].mean()))


@pytest.mark.parametrize("extinction", [0.5, 2.5, 8.0])
def test_light_that_passes_a_slab_falls_exponentially_with_extinction_and_length(tmp_path, extinction):
    """Beer and Lambert: exp(-sigma L), so `density` is the extinction per metre."""
    write_frame(tmp_path, 0, np.ones((48, 48, 48)))
    write_frame(tmp_path, 1, np.full((48, 48, 48), 0.5))
    smoke = smoke_object(MaterialParameters(look="smoke", color=BLACK, density=extinction))
    full, half = draw_bare(tmp_path, smoke, 2)
    # Marching through a hard edge loses a part of a cell, here 1/48 of the slab at most; and noise, 1e-3 of the light.
    assert depth_of(full) == pytest.approx(extinction * LENGTH_M, rel=1 / 48)
    assert depth_of(half) == pytest.approx(extinction * LENGTH_M / 2, rel=1 / 48)
    assert (full[:8] == 1.0).all()  # beside the smoke


@pytest.mark.parametrize("quality", ["preview", "final"])
def test_better_qualities_find_the_same_light(tmp_path, quality):
    write_frame(tmp_path, 0, np.ones((48, 48, 48)))
    smoke = smoke_object(MaterialParameters(look="smoke", color=BLACK, density=2.5))
    (picture,) = draw_bare(tmp_path, smoke, 1, quality=quality)
    assert depth_of(picture) == pytest.approx(2.5 * LENGTH_M, rel=1 / 48)


@pytest.fixture(scope="module")
def flames(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """Black smoke before darkness, of 1500, 1800, 2200, 600 K, and of 1500 K three times as dense."""
    folder = tmp_path_factory.mktemp("flames")
    for frame, (kelvin, density) in enumerate(((1500, 1.0), (1800, 1.0), (2200, 1.0), (600, 1.0), (1500, 3.0))):
        write_frame(folder, frame, np.full((24, 24, 24), density), kelvin=kelvin)
    fire = MaterialParameters(look="fire", color=BLACK, density=2.0, emission=4.0, flame_temperature=1500.0)
    return draw_bare(folder, smoke_object(fire), 5, world_radiance=0.0)


@pytest.mark.parametrize(("frame", "depth"), [(0, 1.2), (4, 3.6)])
def test_flames_shine_as_thickly_as_they_are_opaque(flames, frame, depth):
    """Kirchhoff: radiance E (1 - exp(-sigma L)) at the flame temperature, which is E where nothing shines through."""
    luminance = (flames[frame][MIDDLE] @ LUMINANCE).mean()
    # Half floats give the temperature to a degree, 1 % of the light; the edge half a cell of 24; red is out of gamut.
    assert luminance == pytest.approx(4.0 * (1.0 - np.exp(-depth)), rel=0.05)


def test_hotter_flames_are_brighter_and_whiter_as_planck_says(flames):
    mean = [flames[frame][MIDDLE].mean(axis=(0, 1)) for frame in range(3)]
    ratios = [color @ LUMINANCE / (mean[0] @ LUMINANCE) for color in mean]
    expected = relative_luminance(np.array([1500.0, 1800.0, 2200.0]), 1500.0)
    # A degree of half floats and of the renderer's colours: 24000 K / T² is 1 % of the light a degree.
    np.testing.assert_allclose(ratios, expected, rtol=0.06)
    green_of_red = [color[1] / color[0] for color in mean]
    planck = black_body_color(np.array([1500.0, 1800.0, 2200.0]))
    # Blender's colours are a fit of its own; ours is Krystek's of the chromaticity.
    np.testing.assert_allclose(green_of_red, planck[:, 1] / planck[:, 0], rtol=0.05)
    assert green_of_red[0] < green_of_red[1] < green_of_red[2]


def test_warm_smoke_does_not_glow(flames):
    # exp(-24000 (1/600 - 1/1500)) is 4e-11 of the light of a flame.
    assert flames[3][MIDDLE].max() < 1e-6


@pytest.mark.parametrize("quality", ["draft", "final"])
def test_smoke_that_flies_is_blurred_by_its_way_while_the_shutter_is_open(tmp_path, quality):
    """Also in the best quality: Cycles' tracking without steps would show 0.14 m of the 0.2 m at 24 m/s."""
    cells = 48
    centres = (np.arange(cells) + 0.5) / cells - 0.5
    x, y, z = np.meshgrid(centres, centres, centres, indexing="ij")
    ball = np.clip(8.0 * (0.15 - np.sqrt(x**2 + y**2 + z**2)), 0.0, 1.0)
    for frame, speed in enumerate((0.0, 12.0, 24.0)):
        velocity = np.zeros((cells, cells, cells, 3), np.float32)
        velocity[..., 0] = speed
        write_frame(tmp_path, frame, ball, velocity=velocity)
    smoke = smoke_object(MaterialParameters(look="smoke", color=BLACK, density=30.0))
    pictures = draw_bare(tmp_path, smoke, 3, quality=quality, motion_blur=True, shutter=0.5, samples=24)
    place = PICTURE_WIDTH_M * ((np.arange(64) + 0.5) / 64 - 0.5)
    centres_of, variances = [], []
    for picture in pictures:
        missing = 1.0 - picture[..., 0].mean(axis=0)
        centre = (missing * place).sum() / missing.sum()
        centres_of.append(centre)
        variances.append((missing * (place - centre) ** 2).sum() / missing.sum())
    # The picture is the mean over positions spread evenly over v shutter / fps: their variance is added.
    for variance, speed in zip(variances[1:], (12.0, 24.0), strict=True):
        travelled = np.sqrt(12.0 * (variance - variances[0]))
        assert travelled == pytest.approx(speed * 0.5 / 60.0, rel=0.1)
    # The shutter opens before the frame as long as after it.
    assert np.abs(centres_of).max() < 0.004


def draw_column(folder: Path, **material: float) -> np.ndarray:
    """Optical depth by height of smoke that fills its box, over a closed floor and under an open top."""
    folder.mkdir()
    write_frame(folder, 0, np.ones((24, 24, 24)))
    look = MaterialParameters(look="smoke", color=BLACK, density=2.0, **material)
    (picture,) = draw_bare(folder, smoke_object(look, open_faces=("z+",)), 1)
    return -np.log(picture[:, 28:36].mean(axis=(1, 2)))[::-1]


def test_smoke_fades_out_at_open_faces_only(tmp_path):
    cut, faded = draw_column(tmp_path / "cut", edge_fade=0.0), draw_column(tmp_path / "faded", edge_fade=0.15)
    height = PICTURE_WIDTH_M * ((np.arange(64) + 0.5) / 64 - 0.5) + 0.5
    inside = (height > 0.23) & (height < 0.63)
    np.testing.assert_allclose(faded[inside], cut[inside], atol=0.02)  # noise
    # Smoothstep, which is 1/2 in the middle and 5/32 at a quarter of the fade.
    assert np.interp(0.725, height, faded) == pytest.approx(0.5 * 1.2, abs=0.06)
    assert np.interp(0.7625, height, faded) == pytest.approx(5 / 32 * 1.2, abs=0.06)
    # A cell of 0.025 m and a pixel of 0.019 m: the cut is a cliff, the fade nowhere steeper than 1.5 / 0.15 m.
    steepest = [np.abs(np.diff(depth[height > 0.5])).max() for depth in (cut, faded)]
    assert steepest[0] > 0.4
    assert steepest[1] < 1.3 * 1.2 * 1.5 * (height[1] - height[0]) / 0.15


FLOOR = """
floor = bpy.data.meshes.new("floor")
floor.from_pydata([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], [], [(0, 1, 2, 3)])
floor.materials.append(bpy.data.materials.new("floor"))
node_tree = node_tree_of(floor.materials[0])
shader = node_tree.nodes.new("ShaderNodeBsdfDiffuse")
shader.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
node_tree.links.new(shader.outputs[0], node_tree.nodes.new("ShaderNodeOutputMaterial").inputs["Surface"])
scene.collection.objects.link(bpy.data.objects.new("floor", floor))
scene.camera.data.type = "PERSP"
scene.camera.location, scene.camera.rotation_quaternion = (0.0, -1.0, 0.12), (0.70710678, 0.70710678, 0.0, 0.0)
scene.cycles.use_adaptive_sampling = False
scene.cycles.sample_clamp_indirect = 0.0
"""


def light_of_block(points: np.ndarray, extinction: float, emission: float) -> np.ndarray:
    """Radiance of a floor of albedo 1/2 at points (n, 3) under the block of flames below, by the sum over its cells.

    Each sends emission extinction dV exp(-extinction s) cos / d² to a point, where s is the way to the block's surface.
    """
    cells = np.stack(np.meshgrid(*(np.arange(8, 16), np.arange(8, 16), np.arange(2, 20)), indexing="ij"), -1)
    centres = np.array([-0.3, -0.3, 0.2]) + 0.025 * (cells.reshape(-1, 3) + 0.5)
    low, high = np.array([-0.1, -0.1, 0.25]), np.array([0.1, 0.1, 0.7])
    radiance = []
    for point in points:
        away = centres - point
        distance = np.linalg.norm(away, axis=1)
        direction = -away / distance[:, None]
        inside = np.where(direction > 0, (high - centres) / direction, (low - centres) / direction).min(axis=1)
        falling = np.exp(-extinction * inside) * away[:, 2] / distance**3
        radiance.append(0.5 / np.pi * emission * extinction * 0.025**3 * falling.sum())
    return np.array(radiance)


@pytest.mark.parametrize(("extinction", "tolerance"), [(0.05, 0.08), (2.0, 0.08), (10.0, 0.12)])
def test_a_fire_lights_the_floor_as_its_glow_would(tmp_path, extinction, tolerance):
    """Lamps stand in for the glow; thin flames, and thick ones that hold most of their light back."""
    density = np.zeros((24, 24, 24))
    density[8:16, 8:16, 2:20] = 1.0
    write_frame(tmp_path, 0, density, kelvin=1500.0)
    fire = MaterialParameters(look="fire", color=BLACK, density=extinction, emission=4.0 / extinction)
    (picture,) = draw_bare(tmp_path, smoke_object(fire), 1, world_radiance=0.0, changes=FLOOR, samples=32)
    # Rays of a 50 mm lens on 36 mm that look down from 0.12 m, at one metre from the flames.
    rows, columns = np.meshgrid(np.arange(48, 64), np.arange(24, 40), indexing="ij")
    right, down = ((index + 0.5 - 32) / 32 * 0.36 for index in (columns, rows))
    points = np.stack([0.12 * right / down, 0.12 / down - 1.0, 0.0 * down], axis=-1).reshape(-1, 3)
    expected = light_of_block(points, extinction, 4.0 / extinction).reshape(16, 16)
    found = picture[48:64, 24:40] @ LUMINANCE
    # Noise of a row is 1 %, a degree of half floats as much; balls in the place of boxes are the rest, the more where
    # only the nearest side of the flames is seen.
    np.testing.assert_allclose(found.mean(axis=1), expected.mean(axis=1), rtol=tolerance)


def test_warm_or_clear_air_needs_no_lamps(tmp_path):
    """Nothing that glows, and heat without soot."""
    fire = MaterialParameters(look="fire", density=2.0)
    write_frame(tmp_path, 0, np.ones((8, 8, 8)), kelvin=600.0)
    write_frame(tmp_path, 1, np.zeros((8, 8, 8)), temperature=np.full((8, 8, 8), 1800.0))
    pictures = draw_bare(tmp_path, smoke_object(fire), 2, world_radiance=0.0, changes=FLOOR, samples=4)
    assert all((picture < 1e-6).all() for picture in pictures)


def test_a_frame_of_fire_does_not_depend_on_the_frames_drawn_before(tmp_path):
    """Two fires with lamps of their own, then one."""
    density = np.zeros((24, 24, 24))
    density[2:6, 8:16, 2:8] = 1.0
    write_frame(tmp_path, 1, density, kelvin=1500.0)
    density[18:22, 8:16, 14:20] = 1.0
    write_frame(tmp_path, 0, density, kelvin=1500.0)
    fire = smoke_object(MaterialParameters(look="fire", density=5.0))
    spec_of(fire, motion_blur=True).write(tmp_path / "spec.json")
    run_python(RENDER_FRAMES, str(tmp_path), "after-{frame}.png", "0,1")
    run_python(RENDER_FRAMES, str(tmp_path), "alone-{frame}.png", "1")
    assert (tmp_path / "after-1.png").read_bytes() == (tmp_path / "alone-1.png").read_bytes()
    assert not np.array_equal(read(tmp_path / "after-0.png"), read(tmp_path / "after-1.png"))
