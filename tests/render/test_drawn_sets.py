"""Sets as Cycles draws them, by what tells them apart: tiny pictures, in child processes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import LUMINANCE, draw_all, spec_of, sphere, still_camera, write_mesh
from needed_blender import needs_bpy
from PIL import Image
from radiance_pictures import write_hdr

from render.parameters import CameraParameters, LightParameters, MaterialParameters, SetParameters
from render.pictures import read_picture
from render.spec import MeshObject

pytestmark = needs_bpy

WHITE = MaterialParameters(look="plastic", color=(0.8, 0.8, 0.8), roughness=1.0)
MIDDLE_ROW, MIDDLE_COLUMN = 18, 32
BALL = np.s_[MIDDLE_ROW - 5 : MIDDLE_ROW + 5, MIDDLE_COLUMN - 5 : MIDDLE_COLUMN + 5]
RADIUS_PIXELS = 10  # of a ball of 0.3 m, and two pixels less


def draw(
    folder: Path,
    *,
    ball: MaterialParameters | None = WHITE,
    camera: CameraParameters | None = None,
    lights: tuple[LightParameters, ...] = (),
    open_faces: tuple[str, ...] = (),
    **keys: object,
):
    """Pixels of a ball of 0.3 m that lies on the ground of a set, as they are in the file."""
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.3), 0.3))
    objects = () if ball is None else (MeshObject(name="ball", file="ball.ply", material=ball),)
    changes = {
        "set": SetParameters.model_validate(keys),
        "camera": still_camera(camera or CameraParameters(position=(0.0, -2.5, 0.3), look_at=(0.0, 0.0, 0.3))),
        "lights": lights,
        "open_faces": open_faces,
    }
    draw_all(folder, spec_of(*objects, samples=16, motion_blur=False).model_copy(update=changes))
    return read_picture(folder / "0.png").astype(float)


def sides(picture: np.ndarray) -> tuple[float, float]:
    """Mean luminance of the left and of the right half of the ball."""
    half = slice(MIDDLE_ROW - 5, MIDDLE_ROW + 5)
    luminance = picture[..., :3] @ LUMINANCE
    left = luminance[half, MIDDLE_COLUMN - RADIUS_PIXELS : MIDDLE_COLUMN - 3]
    return float(left.mean()), float(luminance[half, MIDDLE_COLUMN + 3 : MIDDLE_COLUMN + RADIUS_PIXELS].mean())


FROM_ABOVE = CameraParameters(position=(0.0, 0.0, 5.0), look_at=(0.0, 0.0, 0.0))
PIXELS_PER_METRE_OF_GROUND = 64 * 50.0 / 36.0 / 5.0


def darkness_towards(picture: np.ndarray, *, x: float, y: float) -> np.ndarray:
    """How dark the ground is along a way from the middle, relative to the picture's corners: one value every 0.1 m.

    Args:
        picture: of `FROM_ABOVE`, where +x is to the right and +y upwards.
        x: unit vector of the way.
        y: the same.
    """
    luminance = picture[..., :3] @ LUMINANCE
    way = PIXELS_PER_METRE_OF_GROUND * np.arange(0.05, 1.0, 0.1)
    rows, columns = (18 - y * way).astype(int), (32 + x * way).astype(int)
    return 1.0 - luminance[rows, columns] / luminance[::35, ::63].mean()


@pytest.mark.parametrize(
    ("azimuth", "elevation", "shadow", "dark", "light"),
    # The shadow of a ball of radius r reaches r / tan(e / 2): 0.72 m, 0.52 m, 1.7 m. From above the ball hides 0.3 m.
    [
        (0.0, 45.0, (-1, 0), np.s_[4:6], np.s_[8:]),
        (90.0, 45.0, (0, -1), np.s_[4:6], np.s_[8:]),
        (180.0, 60.0, (1, 0), np.s_[3:5], np.s_[6:]),
        (-90.0, 20.0, (0, 1), np.s_[4:], np.s_[10:]),
    ],
)
def test_the_shadow_falls_away_from_where_the_sun_is_put_the_farther_the_lower_it_stands(
    azimuth, elevation, shadow, dark, light, tmp_path
):
    picture = draw(tmp_path, camera=FROM_ABOVE, name="outdoor", sun_elevation_deg=elevation, sun_azimuth_deg=azimuth)
    away = darkness_towards(picture, x=shadow[0], y=shadow[1])
    towards = darkness_towards(picture, x=-shadow[0], y=-shadow[1])
    assert (away[dark] > 0.2).all()
    assert (away[light] < 0.1).all()
    assert (towards[4:] < 0.1).all()


def test_what_a_low_sun_lights_is_redder(tmp_path):
    usual, low = (
        draw(tmp_path, name="outdoor", sun_elevation_deg=e, sun_azimuth_deg=-90.0)[BALL].mean(axis=(0, 1))
        for e in (38.0, 8.0)
    )
    assert low[0] / low[2] > 1.1 * usual[0] / usual[2]


def test_the_size_of_a_sun_is_its_angle_and_softens_shadows(tmp_path):
    sharp, soft = (
        draw(
            tmp_path,
            camera=FROM_ABOVE,
            lights=(LightParameters(type="sun", position=(1.0, 0.0, 1.0), power=3.0, size=size),),
            strength=0.05,
        )
        for size in (0.5, 60.0)
    )
    # At the shadow's tip a sun that stands from 15 to 75 degrees is hidden in part only.
    assert darkness_towards(soft, x=-1, y=0)[6] < 0.5 * darkness_towards(sharp, x=-1, y=0)[6]


def srgb(linear: float) -> int:
    return round(255 * (1.055 * linear ** (1 / 2.4) - 0.055))


def test_a_plain_background_has_exactly_the_colour_of_the_set_and_shadows_on_it(tmp_path):
    picture = draw(tmp_path, background="plain", color=(0.2, 0.5, 0.8))
    assert picture.shape[2] == 3
    color = np.array([srgb(0.2), srgb(0.5), srgb(0.8)])
    assert (picture[:5] == color).all()
    ball = picture[BALL]
    assert np.ptp(ball.mean(axis=(0, 1))) < 60  # white, and not the background's 122
    below = picture[-4:, MIDDLE_COLUMN - 4 : MIDDLE_COLUMN + 4]
    assert (below.mean(axis=(0, 1)) < 0.9 * color).all()


@pytest.mark.parametrize(
    ("name", "size"), [("plate.png", (128, 128)), ("plate.jpg", (64, 128)), ("small.png", (16, 10))]
)
def test_a_backplate_is_seen_as_it_is_behind_the_ball_and_its_shadow(tmp_path, name, size):
    """Its upper half is blue, its lower half orange; what does not fit is cut off above and below alike."""
    width, height = size
    halves = np.zeros((height, width, 3), np.uint8)
    halves[: height // 2], halves[height // 2 :] = (40, 90, 200), (220, 150, 60)
    Image.fromarray(halves).save(tmp_path / name, quality=95)
    picture = draw(tmp_path, backplate=str(tmp_path / name))
    assert picture.shape[2] == 3
    # A JPEG's colours are good to some levels. In a picture of 36 rows the halves meet in the middle.
    np.testing.assert_allclose(picture[:14, :16], np.broadcast_to((40, 90, 200), (14, 16, 3)), atol=6)
    np.testing.assert_allclose(picture[22:24, :4], np.broadcast_to((220, 150, 60), (2, 4, 3)), atol=6)
    assert np.ptp(picture[BALL].mean(axis=(0, 1))) < 60  # white
    below = picture[-4:, MIDDLE_COLUMN - 4 : MIDDLE_COLUMN + 4].mean(axis=(0, 1))
    assert (below < 0.95 * np.array((220, 150, 60))).all()


def test_a_backplate_that_is_gone_or_damaged_draws_nothing(tmp_path):
    (tmp_path / "text.jpg").write_text("this is no picture")
    for name in ("gone.jpg", "text.jpg"):
        with pytest.raises(AssertionError, match=rf"cannot read the picture .*{name}"):
            draw(tmp_path, backplate=str(tmp_path / name))


def test_a_transparent_background_leaves_the_ball_and_its_shadow(tmp_path):
    picture = draw(tmp_path, background="transparent")
    assert picture.shape[2] == 4
    alpha = picture[..., 3]
    assert (alpha[:5] == 0).all()
    assert (alpha[BALL] == 255).all()
    shadow = alpha[-4:, MIDDLE_COLUMN - 4 : MIDDLE_COLUMN + 4].mean()
    assert 20 < shadow < 235
    # The set still lights what stands on it, though it is not seen.
    assert picture[BALL][..., :3].mean() > 60


@pytest.mark.parametrize("name", ["studio", "outdoor", "window"])
def test_no_part_of_any_set_is_seen_where_the_background_is_transparent(name, tmp_path):
    above = CameraParameters(position=(0.0, -2.5, 1.5), look_at=(0.0, 0.0, 0.3))
    empty = draw(tmp_path, ball=None, camera=above, name=name, background="transparent")
    assert (empty[..., 3] == 0).all()


def test_the_ground_takes_the_colour_of_its_look(tmp_path):
    wood, grey, blue = (
        draw(tmp_path, ball=None, strength=0.2, **keys)[-6:, :, :3].mean(axis=(0, 1))
        for keys in ({"ground": "wood"}, {}, {"ground": "stone", "color": (0.1, 0.2, 0.6)})
    )
    assert wood[0] > 1.15 * wood[2]
    assert grey[0] < grey[2] < 1.3 * grey[0]
    assert blue[2] > 1.5 * blue[0]


def test_stone_on_the_ground_is_mottled_near_the_scene(tmp_path):
    above = CameraParameters(position=(0.0, -1.5, 1.5), look_at=(0.0, 0.0, 0.0))
    stone, matt = (
        draw(tmp_path, ball=None, camera=above, name="night", strength=4.0, **keys) @ LUMINANCE
        for keys in ({"ground": "stone"}, {})
    )
    # The moon lights all of the ground alike; noise of 16 samples is in both.
    assert stone.std() / stone.mean() > 2.0 * matt.std() / matt.mean()


def test_the_window_is_at_the_left(tmp_path):
    left, right = sides(draw(tmp_path, name="window"))
    assert left > 1.3 * right
    assert 25 < right < left < 245


def panorama(path: Path) -> None:
    """A dim sky with a lamp at the right, towards +x: in the middle of the picture."""
    sky = np.full((32, 64, 3), 0.1)
    sky[10:18, 29:35] = (60.0, 45.0, 30.0)
    write_hdr(path, sky)


def test_an_hdri_lights_from_where_its_lamp_is_and_turns_counter_clockwise(tmp_path):
    panorama(tmp_path / "lamp.hdr")
    pictures = {
        angle: draw(tmp_path, hdri=str(tmp_path / "lamp.hdr"), rotation_deg=float(angle)) for angle in (0, 180, 90, -90)
    }
    left, right = sides(pictures[0])
    assert right > 1.5 * left
    left, right = sides(pictures[180])
    assert left > 1.5 * right
    # By a quarter turn the lamp goes from the right to behind the ball, the other way to behind the camera.
    behind, before = (sum(sides(pictures[angle])) for angle in (90, -90))
    assert before > 1.5 * behind


def test_an_hdri_is_the_sky_and_strength_its_factor(tmp_path):
    write_hdr(tmp_path / "red.hdr", np.broadcast_to((0.5, 0.05, 0.05), (16, 32, 3)))
    bright, dim = (draw(tmp_path, hdri=str(tmp_path / "red.hdr"), strength=s)[:6] for s in (1.0, 0.2))
    for sky in (bright, dim):
        assert (sky[..., 0] > 1.3 * sky[..., 2]).all()
    assert bright[..., 0].mean() > 1.3 * dim[..., 0].mean()


def test_an_hdri_that_is_gone_or_damaged_draws_nothing(tmp_path):
    (tmp_path / "text.hdr").write_text("this is no picture")
    for name in ("gone.hdr", "text.hdr"):
        with pytest.raises(AssertionError, match=rf"cannot read the picture .*{name}"):
            draw(tmp_path, hdri=str(tmp_path / name))


def test_the_panes_of_a_tank_mirror_nothing_where_they_stand_on_the_ground(tmp_path):
    """The lower side of a pane, seen from inside of the glass, would be a mirror of lamps and of the dark room."""
    camera = CameraParameters(position=(0.0, -2.5, 0.9), look_at=(0.0, -0.51, 0.0), focal_length_mm=800.0)
    front = draw(tmp_path, ball=None, camera=camera, tank=True)[..., :3] @ LUMINANCE
    # 193 everywhere, less what the pane's surfaces keep back. The mirror of the dark room had 42.
    assert front.mean(axis=1) == pytest.approx(np.median(front), rel=0.05)


def test_a_tank_has_no_pane_where_the_domain_is_open(tmp_path):
    """Seen from above, the rim of each pane is a bright line around the floor."""
    above = CameraParameters(position=(0.0, 0.0, 5.0), look_at=(0.0, 0.0, 0.0), focal_length_mm=110.0)
    without = draw(tmp_path, ball=None, camera=above)
    all_open = draw(tmp_path, ball=None, camera=above, tank=True, open_faces=("x-", "x+", "y-", "y+", "z+"))
    assert (all_open == without).all()
    tank = draw(tmp_path, ball=None, camera=above, tank=True, open_faces=("x+", "y-", "z+"))
    changed = np.abs(tank - without)[..., :3].mean(axis=2)
    # Half a metre is 24 pixels at the height of the rims; strips without the corners, whose posts end single panes.
    rows = slice(8, 28)
    left, right = changed[rows, 6:10].max(axis=1), changed[rows, 54:58].max(axis=1)
    assert np.median(left) > 3 * max(np.median(right), 1.0)
