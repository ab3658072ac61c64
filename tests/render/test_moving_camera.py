"""A camera that moves, in real pictures: it is where its views say, and what it passes is blurred."""

from __future__ import annotations

from pathlib import Path

import pytest
from blender_scenes import (
    HALF_A_PIXEL,
    RED,
    RENDER_FRAMES,
    centroid,
    spec_of,
    sphere,
    spread,
    still_camera,
    weight,
    write_mesh,
)
from drawn_jobs import BALL as MOVING_BALL
from drawn_jobs import draw_frame, job_of_the_ball, pose
from needed_blender import needs_bpy
from warm_blender import WarmRenderer
from warm_python import run_python

from pipeline.stages.render import RenderStage
from render.camera_path import View, write_views
from render.parameters import CameraParameters
from render.poses import write_poses
from render.spec import MeshObject
from sim.core.snapshots import Snapshot

pytestmark = needs_bpy

BALL = MeshObject(name="ball", file="ball.ply", position=(0.0, 0.25, 0.5), material=RED)
FRONT = View((0.0, -2.25, 0.5), (0.0, 0.25, 0.5), 50.0, 2.5)
WAY_M = 0.2  # how far the camera flies while the shutter is open: half of a frame


def flying(frame_part: float) -> View:
    x = WAY_M * frame_part / 0.5
    return View((x, -2.25, 0.5), (x, 0.25, 0.5), 50.0, 2.5)


VIEWS = [
    {0.0: FRONT},
    {0.0: View((2.5, 0.0, 0.5), (0.0, 0.0, 0.5), 50.0, 2.5)},  # a quarter around: +y is to the right
    {offset: flying(offset) for offset in (-0.25, 0.0, 0.25)},
    {0.0: FRONT},  # after a flight: nothing of its motion is left
    {0.0: View((0.0, -2.25, 0.5), (0.0, 0.25, 0.5), 100.0, 2.5)},
]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> tuple[Path, str]:
    """A red ball from several sides, every frame drawn in one process; and what that printed."""
    folder = tmp_path_factory.mktemp("camera")
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.1))
    (folder / "views").mkdir()
    for frame, views in enumerate(VIEWS):
        write_views(folder / f"views/{frame:06d}.json", frame, views)
    (folder / "views/000006.json").write_text('{"version": 1, "frame": 6, "views": [{"offset": 0, "position": [0]}]}')
    camera = still_camera(CameraParameters(position=FRONT.position, look_at=FRONT.look_at))
    moving = camera.model_copy(update={"views": "views/{frame}.json", "distance_all_round": 2.5})
    spec_of(BALL, samples=32).model_copy(update={"camera": moving}).write(folder / "spec.json")
    return folder, run_python(RENDER_FRAMES, str(folder), "{frame}.png", "0,1,2,3,4,5,6")


def test_the_ball_is_where_the_camera_of_the_frame_sees_it(pictures):
    folder, _ = pictures
    assert centroid(folder, 0) == pytest.approx([0.0, 0.5], abs=HALF_A_PIXEL)
    assert centroid(folder, 1) == pytest.approx([0.25, 0.5], abs=HALF_A_PIXEL)


def test_a_longer_lens_draws_the_ball_larger(pictures):
    folder, _ = pictures
    assert weight(folder, 4).sum() == pytest.approx(4 * weight(folder, 0).sum(), rel=0.1)


def test_a_flying_camera_blurs_what_it_passes_as_if_that_flew_past_it(pictures):
    folder, _ = pictures
    still, passed = spread(folder, 0), spread(folder, 2)
    assert centroid(folder, 2) == pytest.approx([0.0, 0.5], abs=HALF_A_PIXEL)
    assert passed[0] > 1.5 * still[0]
    assert spread(folder, 3) == pytest.approx(still, rel=0.05)
    (folder / "poses").mkdir()
    passing = pose(position=BALL.position, velocity=(-2.0 * WAY_M * 60.0, 0.0, 0.0))
    write_poses(folder / "poses/000002.json", 2, passing)
    camera = still_camera(CameraParameters(position=FRONT.position, look_at=FRONT.look_at))
    spec_of(MOVING_BALL, samples=32).model_copy(update={"camera": camera}).write(folder / "spec.json")
    run_python(RENDER_FRAMES, str(folder), "flown{frame}.png", "2")
    (folder / "flown2.png").rename(folder / "12.png")
    assert passed == pytest.approx(spread(folder, 12), rel=0.05)


def test_views_that_are_missing_or_unfit_are_refused_with_their_frame(pictures):
    _, printed = pictures
    missing, unfit = [line for line in printed.splitlines() if line.startswith("REFUSED")]
    assert "frame 5:" in missing and "cannot read the views" in missing
    assert "frame 6:" in unfit and "position must be 3 finite numbers" in unfit


FOLLOWING_CAMERA = """
[camera]
position = [-0.4, -2.5, 0.5]
look_at = [-0.4, 0.0, 0.5]
follow = "ball"
"""


def test_a_body_that_the_camera_follows_stays_in_the_middle_and_sharp(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", WarmRenderer)
    job, layout = job_of_the_ball(tmp_path, "chase", FOLLOWING_CAMERA)
    task = RenderStage().plan(job, layout)[2]
    ball = Snapshot("rigid", pose(position=(0.4, 0.0, 0.5), velocity=(24.0, 0.0, 0.0))["ball"], {})
    draw_frame(task, layout, 2, {"ball": ball}, picture=tmp_path / "2.png")
    assert centroid(tmp_path, 2) == pytest.approx([0.0, 0.5], abs=HALF_A_PIXEL)
    width, height = spread(tmp_path, 2)
    assert width < 1.25 * height  # its lower half is paler; without following it is twice as wide as high
