"""`pipeline still`: one frame in another quality, beside the job's own."""

from __future__ import annotations

import numpy as np
import pytest
from checked_pictures import validate_picture
from click.testing import Result
from command_line import pipeline
from exr_channels import exr_channels
from half_simulated_jobs import half_simulated_job
from needed_blender import needs_bpy
from PIL import Image
from warm_blender import WarmRenderer

from pipeline.base.layout import JobLayout
from pipeline.stages import render_drawing
from render.pictures import validate_exr


@pytest.fixture(autouse=True)
def warm(monkeypatch):
    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", WarmRenderer)


@pytest.fixture
def job(tmp_path) -> JobLayout:
    return half_simulated_job(tmp_path)


def draw(job: JobLayout, frame: int, quality: str, *arguments: object) -> Result:
    result = pipeline("still", job.root, "--frame", frame, "--quality", quality, *arguments)
    render_drawing.close_renderers()
    assert result.exit_code == 0, result.output
    return result


def contents(layout: JobLayout) -> dict[str, bytes]:
    return {
        path.relative_to(layout.root).as_posix(): path.read_bytes()
        for path in sorted(layout.root.rglob("*"))
        if path.is_file() and layout.stills not in path.parents
    }


@needs_bpy
def test_a_still_is_drawn_beside_the_jobs_frames_and_touches_nothing_else(job):
    before = contents(job)
    result = draw(job, 1, "preview", "--resolution", 48, 32, "--set", "render.samples=2")
    (drawn,) = job.stills.iterdir()
    assert result.stdout == f"{drawn}\n"
    assert drawn.name.startswith("000001-preview-48x32-"), "and what tells it from one without that --set"
    assert "frame 1 of flight: 48 x 32 pixels, preview quality" in result.stderr
    with Image.open(drawn) as picture:
        assert picture.size == (48, 32)
    assert contents(job) == before


@needs_bpy
def test_a_still_is_seen_from_elsewhere_where_keyframes_lead_the_films_camera(tmp_path):
    led = """
[camera]
easing = "linear"
[[camera.keyframe]]
time_s = 0.0
position = [0.0, -2.0, 0.5]
[[camera.keyframe]]
time_s = 1.0
position = [1.0, -2.0, 0.5]
"""
    pictures = []
    for name, camera in (("led", led), ("standing", "[camera]\nposition = [1.0, -2.0, 0.5]\n")):
        (tmp_path / name).mkdir()
        job = half_simulated_job(tmp_path / name, camera)
        arguments = ("--set", "camera.position=[0, -3, 1]", "--set", "render.samples=1")
        draw(job, 1, "draft", *arguments)
        (drawn,) = job.stills.iterdir()
        pictures.append(drawn.read_bytes())
    assert pictures[0] == pictures[1]


@needs_bpy
def test_a_still_goes_where_it_is_wanted_and_replaces_what_is_there(job, tmp_path):
    target = tmp_path / "pictures" / "poster.png"
    target.parent.mkdir()
    target.write_bytes(b"an older poster")
    arguments = ("--set", "render.samples=1", "--set", "set.color=[0.5, 0.1, 0.1]", "-o", target)
    draw(job, 0, "draft", *arguments)
    with Image.open(target) as picture:
        assert picture.size == (64, 36)
    assert [path.name for path in target.parent.iterdir()] == ["poster.png"]
    assert not job.stills.exists()


@needs_bpy
def test_a_still_with_a_master_has_both_files(job, tmp_path):
    arguments = ("--set", 'render.format="exr"', "--set", "render.samples=1", "-o", tmp_path / "poster.png")
    draw(job, 0, "draft", *arguments)
    validate_exr(tmp_path / "poster.exr", (64, 36))
    validate_picture(tmp_path / "poster.png", (64, 36))


@needs_bpy
def test_vectors_of_a_rigid_body_and_of_a_camera_reach_to_the_next_frame(job, tmp_path):
    render = {"format": '"exr"', "passes": '["vector"]', "motion_blur": "false", "samples": "1"}
    view = {"position": "[0.0, -2.5, 0.5]", "look_at": "[0.0, 0.0, 0.5]"}
    keys = [f"render.{key}={value}" for key, value in render.items()]
    keys += [f"camera.{key}={value}" for key, value in view.items()]
    vectors = {}
    for name, more in {"still": [], "following": ['camera.follow="ball"']}.items():
        overrides = [word for key in (*keys, *more) for word in ("--set", key)]
        target = tmp_path / f"{name}.png"
        draw(job, 1, "draft", *overrides, "-o", target)
        vectors[name] = exr_channels(target.with_suffix(".exr"), tmp_path)["ViewLayer.Vector.X"]
    # 12 m/s at 60 fps are 0.2 m a frame; 64 pixels x 50 mm / 36 mm / 2.4 m = 37.0 pixels a metre on the ball's front.
    # Vectors point to where things were in the frame before.
    moved = 0.2 * 37.0
    assert np.median(vectors["still"]) == pytest.approx(0.0, abs=0.01)  # most of the picture is the stage
    assert abs(vectors["still"]).max() == pytest.approx(moved, abs=0.3)
    # A camera that flies along sees the ball stand still and the stage behind it move the other way.
    assert np.median(vectors["following"]) * vectors["still"].sum() < 0.0


def test_a_frame_that_is_not_simulated_yet_is_told_with_the_command_that_makes_it(job):
    result = pipeline("still", job.root, "--frame", 2)
    assert result.exit_code == 1
    assert f"cache/000002.h5 is not simulated yet; go on with: pipeline resume {job.root}" in result.stderr


def test_options_that_change_the_simulation_are_refused(job):
    result = pipeline("still", job.root, "--frame", 1, "--set", "rigid.ball.velocity=[1.0, 0.0, 0.0]")
    assert result.exit_code == 1
    assert "--set changes what is simulated" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--frame", 3), "flight has no frame 3; its frames are 0-2"),
        (("--frame", 1, "-o", "still.jpg"), 'a still is a PNG, so its name must end in ".png"'),
        (("--frame", 1, "--resolution", 4, 4), "render.resolution"),
        (("--frame", 1, "--set", "render.qualty=final"), 'did you mean "quality"'),
    ],
)
def test_what_cannot_be_drawn_is_told(job, arguments, sentence):
    result = pipeline("still", job.root, *arguments)
    assert result.exit_code in (1, 2)
    assert sentence in result.stderr


def test_a_still_from_elsewhere_says_where_and_is_kept_apart_from_others(job):
    text = job.job_file.read_text() + '\n[camera]\nframing = "action"\n'
    job.job_file.write_text(text)
    result = pipeline(
        "still", job.root, "--frame", 0, "--set", "camera.position=[0, -3, 1]", "-o", job.root / "job.toml" / "a.png"
    )
    assert result.exit_code == 1
    assert "cannot write" in result.output  # the place is tried before anything is drawn
