"""What the camera's shutter and lens do, in real pictures: how long things smear, and what is out of focus."""

from __future__ import annotations

import numpy as np
import pytest
from blender_scenes import RED, draw_all, redness, spec_of, sphere, spread, still_camera, write_mesh
from drawn_jobs import BALL, pose
from needed_blender import needs_bpy

from render.parameters import CameraParameters
from render.poses import write_poses
from render.spec import MeshObject

pytestmark = needs_bpy


LENGTH_M = 0.4  # how far the ball flies while the shutter is open; it is half as wide


@pytest.mark.parametrize("shutter", [0.25, 1.0])
def test_a_body_smears_as_long_as_it_flies_while_the_shutter_is_open(shutter, tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.1))
    (tmp_path / "poses").mkdir()
    for frame, speed in enumerate((0.0, LENGTH_M * 60.0 / shutter)):
        write_poses(tmp_path / f"poses/{frame:06d}.json", frame, pose(velocity=(speed, 0.0, 0.0)))
    draw_all(tmp_path, spec_of(BALL, samples=8, shutter=shutter), (0, 1))
    still, flying = spread(tmp_path, 0), spread(tmp_path, 1)
    # Even smearing over a length L adds L²/12 to the variance. Open for half a frame, it would be twice or half of it.
    assert np.sqrt(flying[0] ** 2 - still[0] ** 2) == pytest.approx(LENGTH_M / np.sqrt(12.0), rel=0.2)


def test_a_ball_out_of_focus_has_a_wider_rim_than_the_one_in_focus(tmp_path):
    width, height = 256, 144
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.2))
    balls = (
        MeshObject(name=name, file="ball.ply", position=place, material=RED)
        for name, place in (("near", (-0.4, 0.0, 0.5)), ("far", (0.7, 1.5, 0.5)))
    )
    camera = still_camera(CameraParameters(position=(0.0, -2.5, 0.5), look_at=(0.0, 0.0, 0.5), f_stop=0.1))
    spec = spec_of(*balls, samples=8, motion_blur=False, resolution=(width, height))
    (picture,) = draw_all(tmp_path, spec.model_copy(update={"camera": camera}))
    red = redness(picture)[height // 2 - 8 : height // 2 + 8].mean(axis=0)
    # Between the stage's 0.27 to 0.30 and the ball's 0.5 and more.
    near, far = (((half > 0.32) & (half < 0.48)).sum() for half in (red[: width // 2], red[width // 2 :]))
    # A lens of 50 mm at f/0.1 is 0.5 m wide: focused at 2.5 m, it smears a point at 4 m over 0.3 m there, 27 pixels,
    # on both sides of the ball. In focus, what is mixed is the pixels of the edge, and a paler side.
    assert near < 10
    assert far > near + 10
