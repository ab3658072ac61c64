"""Moving bodies in real pictures: each frame's pose is where the body is drawn, and its motion is what is blurred."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from blender_scenes import (
    HALF_A_PIXEL,
    RENDER_FRAMES,
    centroid,
    spec_of,
    sphere,
    spread,
    write_mesh,
)
from drawn_jobs import BALL, draw_frame, job_of_the_ball, pose
from needed_blender import needs_bpy
from warm_blender import WarmRenderer
from warm_python import run_python

from pipeline.base.layout import JobLayout
from pipeline.base.task import Task
from pipeline.model.job import Job
from pipeline.stages.render import RenderStage
from render.poses import write_poses
from sim.core.snapshots import Snapshot

pytestmark = needs_bpy

ABOUT_Y_90 = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)

POSES = [
    pose(),
    pose(position=(0.4, 0.0, 0.7)),
    pose(velocity=(24.0, 0.0, 0.0)),
    pose(),  # after a flight: nothing of its motion is left
    pose(orientation=ABOUT_Y_90),
    pose(angular_velocity=(0.0, -2.0 * np.pi * 20.0, 0.0)),  # a third of a turn in a frame
]
OFF_CENTRE = np.array([0.25, 0.0, 0.0])  # where the mesh is from its own origin [m], so that turning the body moves it


@pytest.fixture(scope="module")
def pictures(tmp_path_factory) -> tuple[Path, str]:
    """A small ball beside its mesh's origin, every frame drawn in one process; and what that printed."""
    folder = tmp_path_factory.mktemp("moving")
    positions, triangles = sphere((0.0, 0.0, 0.0), 0.1)
    write_mesh(folder / "ball.ply", positions + OFF_CENTRE, triangles)
    (folder / "poses").mkdir()
    for frame, poses in enumerate(POSES):
        write_poses(folder / f"poses/{frame:06d}.json", frame, poses)
    write_poses(folder / "poses/000007.json", 7, {"duck": POSES[0]["ball"]})
    (folder / "poses/000008.json").write_text('{"version": 1, "frame": 8, "bodies": {"ball": {"position": [0, 0]}}}')
    spec_of(BALL, samples=32).write(folder / "spec.json")
    return folder, run_python(RENDER_FRAMES, str(folder), "{frame}.png", "0,1,2,3,4,5,6,7,8")


def test_the_body_is_where_the_pose_of_the_frame_says(pictures):
    folder, _ = pictures
    assert centroid(folder, 0) == pytest.approx([0.25, 0.5], abs=HALF_A_PIXEL)
    assert centroid(folder, 1) == pytest.approx([0.65, 0.7], abs=HALF_A_PIXEL)


def test_the_orientation_turns_the_mesh_about_its_origin(pictures):
    # A quarter of a turn about y takes x to -z.
    assert centroid(pictures[0], 4) == pytest.approx([0.0, 0.25], abs=HALF_A_PIXEL)


def test_blur_is_along_the_velocity_and_centred_on_the_pose(pictures):
    folder, _ = pictures
    travelled = 24.0 * 0.5 / 60.0  # velocity, shutter of half a frame
    assert centroid(folder, 2) == pytest.approx([0.25, 0.5], abs=HALF_A_PIXEL)
    still, flying = spread(folder, 0), spread(folder, 2)
    # Even smearing over a length L adds L²/12 to the variance; the threshold takes some of the pale ends away.
    assert np.sqrt(flying[0] ** 2 - still[0] ** 2) == pytest.approx(travelled / np.sqrt(12.0), rel=0.3)
    assert flying[1] == pytest.approx(still[1], rel=0.15)


def test_motion_is_not_carried_over_to_the_next_frame(pictures):
    folder, _ = pictures
    assert (folder / "3.png").read_bytes() == (folder / "0.png").read_bytes()


def test_a_spinning_body_is_blurred_along_its_arc(pictures):
    folder, _ = pictures
    # 60 degrees while the shutter is open, and 0.25 m from the axis: the ball is smeared over 0.26 m along z.
    still, spinning = spread(folder, 0), spread(folder, 5)
    chord = 2.0 * 0.25 * np.sin(np.radians(30.0))
    assert np.sqrt(spinning[1] ** 2 - still[1] ** 2) == pytest.approx(chord / np.sqrt(12.0), rel=0.3)
    assert spinning[0] < 1.3 * still[0]


def test_poses_that_are_missing_or_unfit_are_refused_with_their_frame(pictures):
    refused = [line for line in pictures[1].splitlines() if line.startswith("REFUSED")]
    assert len(refused) == 3
    assert "frame 6: cannot read the poses" in refused[0] and "000006.json" in refused[0]
    assert "frame 7:" in refused[1] and 'none of "ball"' in refused[1]
    assert "frame 8:" in refused[2] and 'position of "ball" must be 3 finite numbers' in refused[2]


def test_poses_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_poses(tmp_path / "0.json", 0, pose(position=(np.nan, 0, 0)))


CAMERA_AND_ROCK = """
[camera]
position = [0.0, -2.5, 0.5]
look_at = [0.0, 0.0, 0.5]
[[rigid]]
name = "rock"
shape = { type = "sphere", radius = 0.05 }
position = [0.0, 0.0, 0.9]
[material.rock]
look = "plastic"
color = [0.1, 0.3, 0.8]
"""


def test_a_job_is_drawn_with_the_poses_of_its_cache(tmp_path, monkeypatch):
    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", WarmRenderer)
    job, layout = job_of_the_ball(tmp_path, "flight", CAMERA_AND_ROCK)
    task = RenderStage().plan(job, layout)[2]
    assert task.inputs == ("meshes/ball.ply", "meshes/rock.ply", "cache/000002.h5")
    ball = Snapshot("rigid", pose(position=(0.4, 0.0, 0.5), velocity=(24.0, 0.0, 0.0))["ball"], {})
    rock = Snapshot("rigid", pose(position=(0.0, 0.0, 0.9))["ball"], {})
    draw_frame(task, layout, 2, {"ball": ball, "rock": rock}, picture=tmp_path / "2.png")
    assert centroid(tmp_path, 2) == pytest.approx([0.4, 0.5], abs=HALF_A_PIXEL)
    assert spread(tmp_path, 2)[0] > 1.3 * spread(tmp_path, 2)[1]  # blurred along x, as it flies
    document = json.loads((layout.root / "poses/000002.json").read_text())
    assert list(document["bodies"]) == ["ball"]  # what never moves is in the scene, and costs nothing here


def test_a_job_of_static_bodies_does_not_read_the_cache_to_draw():
    def task(kind: str, **motion: object) -> Task:
        rigid = {"name": "ball", "kind": kind, "shape": {"type": "sphere", "radius": 0.1}, **motion}
        fluid = {"name": "water", "block": [{"shape": {"type": "box", "size": (0.1, 0.1, 0.1)}}]}
        job = Job.model_validate({"name": "a", "frames": 1, "rigid": [rigid], "fluid": [fluid]}, strict=False)
        return RenderStage().plan(job, JobLayout(Path("a")))[0]

    assert task("static").inputs == ("meshes/ball.ply", "surfaces/water/000000.ply", "drops/water/000000.ply")
    moving = task("dynamic", density=500.0)
    assert moving.inputs == (*task("static").inputs, "cache/000000.h5")
    # Where a moving body starts is the simulation's business; its pictures change only if its poses do.
    assert moving.parameters.digest == task("dynamic", density=500.0, position=(0.1, 0.0, 0.0)).parameters.digest
