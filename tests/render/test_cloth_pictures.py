"""Woven cloth as Cycles draws it: tiny pictures, in child processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import draw_all, redness, spec_of, still_camera
from needed_blender import needs_bpy

from render.meshes import write_ply
from render.parameters import CameraParameters, MaterialParameters
from render.spec import MeshSequenceObject

pytestmark = [needs_bpy, pytest.mark.slow]

THREADS = 12  # a side of the sheet, three periods of twill; a thread is two pixels wide


def write_sheet(path: Path, *, turned: bool) -> None:
    """An upright square in the middle of the picture, with its front or its back to the camera."""
    vertices = np.array([[-0.4, 0, 0.1], [0.4, 0, 0.1], [0.4, 0, 0.9], [-0.4, 0, 0.9]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    path.parent.mkdir(exist_ok=True)
    write_ply(
        path,
        vertices,
        triangles[:, ::-1] if turned else triangles,
        normals=np.tile([0, 1 if turned else -1, 0], (4, 1)),
        velocities=np.zeros((4, 3)),
        uv=vertices[:, [0, 2]] - vertices[0, [0, 2]],
    )


def draw_denim(folder: Path, *, threads: int, samples: int) -> list[np.ndarray]:
    """A denim sheet with red warp, seen from its front and from its back: the pixels well within it."""
    material = MaterialParameters(look="denim", color=(0.8, 0.02, 0.02), thread_spacing=0.8 / threads)
    sheet = MeshSequenceObject(name="sheet", file="sheet/{frame}.ply", material=material)
    for frame, turned in enumerate((False, True)):
        write_sheet(folder / f"sheet/{frame:06d}.ply", turned=turned)
    pictures = draw_all(folder, spec_of(sheet, resolution=(128, 72), samples=samples), (0, 1))
    # 0.8 m of the 1.8 m that the picture shows in width, at half its height.
    return [picture[22:50, 42:86] for picture in pictures]


@pytest.fixture(scope="module")
def seen_from_near(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    return draw_denim(tmp_path_factory.mktemp("near"), threads=THREADS, samples=16)


@pytest.fixture(scope="module")
def seen_from_afar(tmp_path_factory: pytest.TempPathFactory) -> list[np.ndarray]:
    """Three and a half threads a pixel, a number that beats against the pixels."""
    return draw_denim(tmp_path_factory.mktemp("afar"), threads=201, samples=64)


@pytest.fixture(scope="module")
def red_pixels(seen_from_near: list[np.ndarray]) -> list[float]:
    """Share of red pixels of both sides."""
    return [float((redness(picture) > 0.45).mean()) for picture in seen_from_near]


def test_twill_shows_three_of_four_crossings_in_the_colour_of_its_warp(red_pixels):
    # Threads are round and dip, so that at the edges of a crossing the other thread may show: a band about 3/4.
    assert 0.6 < red_pixels[0] < 0.9


def test_the_back_of_twill_shows_the_weft(red_pixels):
    assert 0.1 < red_pixels[1] < 0.4


def test_threads_finer_than_a_pixel_leave_no_pattern(seen_from_near, seen_from_afar):
    # What is left is noise of the lamps (0.017 and 0.004); threads as they are would scatter by 0.058 and 0.042.
    for near, afar in zip(seen_from_near, seen_from_afar, strict=True):
        assert redness(near).std() > 0.15
        assert redness(afar).std() < 0.03


def test_from_afar_denim_has_the_mean_colour_of_its_threads_on_either_side(seen_from_near, seen_from_afar):
    # The sides differ by 0.25. Far away no light is lost between threads, and film bleaches what is brighter: 0.07 on
    # the front.
    for near, afar in zip(seen_from_near, seen_from_afar, strict=True):
        assert redness(afar).mean() == pytest.approx(redness(near).mean(), abs=0.08)


def drawn_lying(folder: Path, material: MaterialParameters, name: str = "sheet") -> np.ndarray:
    """A sheet that lies in the studio, seen at 16 degrees against the lamps behind it, (6, 10, 3) [0, 255]."""
    vertices = np.array([[-0.45, -0.45, 0.3], [0.45, -0.45, 0.3], [0.45, 0.45, 0.3], [-0.45, 0.45, 0.3]])
    write_ply(
        folder / "sheet.ply",
        vertices,
        np.array([[0, 1, 2], [0, 2, 3]]),
        normals=np.tile([0, 0, 1], (4, 1)),
        velocities=np.zeros((4, 3)),
        uv=vertices[:, :2],
    )
    sheet = MeshSequenceObject(name=name, file="sheet.ply", material=material, edges=(0.9, 0.9, 1e-6))
    camera = still_camera(CameraParameters(position=(0.0, -3.0, 1.16), look_at=(0.0, 0.0, 0.3)))
    spec = spec_of(sheet, samples=16, motion_blur=False).model_copy(update={"camera": camera})
    (picture,) = draw_all(folder, spec)
    # A band across the sheet, which begins 8 pixels beside the middle of the picture and is 6 high.
    return picture[16:20, 27:37]


def brightness_lying(folder: Path, look: str, color: tuple[float, float, float]) -> float:
    """Luminance [0, 255] of such a sheet."""
    lying = drawn_lying(folder, MaterialParameters(look=look, color=color))
    return float((lying @ [0.2126, 0.7152, 0.0722]).mean())


@pytest.mark.parametrize("look", ["cotton", "wood"])
def test_two_sheets_of_one_look_are_of_different_bolts(look, tmp_path):
    material = MaterialParameters(look=look)
    first, again, other = (drawn_lying(tmp_path, material, name) for name in ("sail", "sail", "flag"))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first.mean(axis=(0, 1)) - other.mean(axis=(0, 1))).max() > 1.0


@pytest.mark.parametrize(("look", "darkest", "brightest"), [("cotton", 75, 125), ("denim", 127, 155)])
def test_matt_cloth_stays_dark_where_light_grazes_it(tmp_path, look, darkest, brightest):
    """With white sheen and more gloss both were pale, 183 and 172 of 255; they are 100 and 136.

    With neither sheen nor gloss they have 50 and 117 (denim's weft is undyed), without sheen alone 97 and 134, too near
    to tell; cloth as light as paper has 227.
    """
    assert darkest < brightness_lying(tmp_path, look, (0.02, 0.02, 0.022)) < brightest


def test_light_cloth_is_as_light_as_its_threads_where_light_grazes_it(tmp_path):
    assert brightness_lying(tmp_path, "cotton", (0.72, 0.70, 0.66)) > 210
