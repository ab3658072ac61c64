"""Pictures that Blender ends well and that show nothing of the film: drawn once more, then told and kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from blender_scenes import RED, read, spec_of, sphere, still_camera, write_mesh
from checked_pictures import validate_picture
from drawn_jobs import job_of_the_ball, pose
from inline_tasks import run_task
from needed_blender import needs_bpy
from PIL import Image
from warm_blender import WarmRenderer
from warm_python import run_python

from pipeline.base.layout import JobLayout
from pipeline.job.loading import load_job
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.stages import render_drawing
from pipeline.stages.render import RenderStage
from pipeline.store.cache import write_frame
from render.camera_path import View, write_views
from render.errors import InvalidFileError
from render.parameters import CameraParameters
from render.pictures import over_black, read_picture, require_more_than_set
from render.spec import MeshObject
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

SAME_FRAMES = """
    import sys
    from pathlib import Path
    from render.blender import open_renderer
    folder, blender = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    renderer = open_renderer(folder / "spec.json", threads=1, blender=blender)
    renderer.render(0, folder / "before.png")
    renderer.render_set(0, folder / "stage.png", resolution=(32, 18))
    renderer.render(0, folder / "after.png")
    renderer.render_set(1, folder / "stage1.png", resolution=(32, 18))
    renderer.close()
"""


@needs_bpy
def test_the_empty_set_is_drawn_without_bodies_and_leaves_the_frames_as_they_are(tmp_path):
    ball = MeshObject(name="ball", file="ball.ply", position=(0.0, 0.0, 0.5), material=RED)
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.3))
    (tmp_path / "views").mkdir()
    for frame, x in enumerate((0.0, 1.0)):
        view = View((x, -2.5, 0.5), (x, 0.0, 0.5), 50.0, 2.5)
        write_views(tmp_path / f"views/{frame:06d}.json", frame, {-0.25: view, 0.0: view, 0.25: view})
    camera = still_camera(CameraParameters(position=(0.0, -2.5, 0.5), look_at=(0.0, 0.0, 0.5)))
    moving = camera.model_copy(update={"views": "views/{frame}.json", "distance_all_round": 2.5})
    spec_of(ball, denoise=False).model_copy(update={"camera": moving}).write(tmp_path / "spec.json")
    run_python(SAME_FRAMES, str(tmp_path))
    assert (tmp_path / "before.png").read_bytes() == (tmp_path / "after.png").read_bytes()
    stage = read(tmp_path / "stage.png")
    assert stage.shape == (18, 32, 3)
    assert (stage[..., 0] <= stage[..., 2]).mean() > 0.95, "nothing red is in it"
    assert (read(tmp_path / "stage1.png") != stage).any(), "its camera is that of the frame"


SIZE = (192, 108)
"""With a cell of the empty stage for four pixels; noise of single pixels looks like something that is drawn."""


@pytest.fixture
def warm(monkeypatch):
    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", WarmRenderer)


def draw_the_ball(layout: JobLayout) -> TaskEvent:
    """Draw frame 1 of a job of the ball, in which it lies where it was put; how that ended."""
    cache = layout.path(layout.frame_cache(1))
    cache.parent.mkdir()
    ball = Snapshot("rigid", pose()["ball"], {})
    write_frame(cache, {"ball": ball}, FrameReport(1, 1 / 60, {}, {}, {}), device="cpu")
    ended = run_task(RenderStage().plan(load_job(layout.job_file), layout)[1], layout)
    render_drawing.close_renderers()
    return ended


def draw_with_faults(folder: Path, monkeypatch: pytest.MonkeyPatch, faults: int):
    """Draw a frame of the ball by renderers of which so many drop it; how it ended, and the layout."""
    opened = []

    def open_dropping(spec_path: Path, **options: object) -> WarmRenderer:
        renderer = WarmRenderer(spec_path)
        opened.append(renderer)
        if len(opened) <= faults:
            run_python("import bpy; bpy.data.objects['ball'].hide_render = True")
        return renderer

    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", open_dropping)
    _, layout = job_of_the_ball(folder, "pond", "")
    text = layout.job_file.read_text().replace("[64, 36]", f"{[*SIZE]}").replace("samples = 32", "samples = 16")
    layout.job_file.write_text(text.replace("denoise = false", "denoise = true"))
    ended = draw_the_ball(layout)
    assert len(opened) == 2
    return ended, layout


@needs_bpy
def test_a_body_that_was_dropped_once_is_drawn_by_a_new_renderer(tmp_path, monkeypatch):
    ended, layout = draw_with_faults(tmp_path, monkeypatch, 1)
    assert isinstance(ended, Finished), ended
    assert (read(layout.path(layout.picture(1)))[..., 0] > 100).any()
    assert "shows the empty set" in layout.log(ended.task_id, 1).read_text()
    assert not layout.rejected_picture(1).exists()


@needs_bpy
def test_a_body_that_is_dropped_again_fails_the_frame_and_its_picture_is_kept(tmp_path, monkeypatch):
    ended, layout = draw_with_faults(tmp_path, monkeypatch, 2)
    assert isinstance(ended, Failed)
    assert ended.message.startswith("frame 1: the picture shows the empty set, though bodies are in ")
    assert str(layout.rejected_picture(1)) in ended.message
    validate_picture(layout.rejected_picture(1), SIZE)
    assert not layout.path(layout.picture(1)).exists()


def require_more(path: Path, empty: np.ndarray, cells: np.ndarray) -> None:
    require_more_than_set(path, over_black(read_picture(path)), empty, cells)


def test_only_cells_that_bodies_are_in_count_against_the_set(tmp_path):
    shade = np.linspace(60, 120, 40)[:, None, None] * np.ones((40, 80, 3))
    stage = shade.reshape(20, 2, 40, 2, 3).mean(axis=(1, 3)).astype(np.uint8)
    noise = np.random.default_rng(0).normal(0.0, 2.0, shade.shape)
    stage = np.dstack([stage, np.full(stage.shape[:2], 255, np.uint8)])
    cells = np.zeros((20, 40), np.bool_)
    cells[5:15, 10:20] = True
    empty, drawn, beside = shade + noise, shade + noise, shade + noise
    drawn[10:14, 20:40] += 20
    beside[:, 60:] += 50
    for name, pixels in (("empty", empty), ("drawn", drawn), ("beside", beside)):
        Image.fromarray(np.clip(pixels, 0, 255).astype(np.uint8)).save(tmp_path / f"{name}.png")
    require_more(tmp_path / "drawn.png", stage, cells)
    for name in ("empty", "beside"):
        with pytest.raises(InvalidFileError, match="though bodies are in 12 % of it"):
            require_more(tmp_path / f"{name}.png", stage, cells)


def test_a_picture_of_one_colour_and_rounding_is_flat_and_one_with_a_faint_shade_is_not(tmp_path):
    flat = np.full((30, 40, 3), 90, np.uint8)
    flat[::2] += 1
    faint = flat.copy()
    faint[10:20, 10:20] += 3
    Image.fromarray(flat).save(tmp_path / "flat.png")
    Image.fromarray(faint).save(tmp_path / "faint.png")
    with pytest.raises(InvalidFileError, match="has one colour only"):
        validate_picture(tmp_path / "flat.png", (40, 30))
    validate_picture(tmp_path / "faint.png", (40, 30))


def test_a_black_body_before_nothing_is_seen_by_its_alpha(tmp_path):
    nothing = np.zeros((20, 40, 4), np.uint8)
    body = nothing.copy()
    body[5:15, 10:30, 3] = 255
    cells = body[..., 3] > 0
    Image.fromarray(body).save(tmp_path / "drawn.png")
    Image.fromarray(nothing).save(tmp_path / "empty.png")
    require_more(tmp_path / "drawn.png", nothing, cells)
    with pytest.raises(InvalidFileError, match="shows the empty set"):
        require_more(tmp_path / "empty.png", nothing, cells)


def test_without_a_background_a_picture_may_be_empty(tmp_path):
    Image.new("RGBA", (40, 30)).save(tmp_path / "nothing.png")
    Image.new("RGB", (40, 30), (129, 137, 147)).save(tmp_path / "plain.png")
    for name in ("nothing", "plain"):
        validate_picture(tmp_path / f"{name}.png", (40, 30), may_be_empty=True)
        with pytest.raises(InvalidFileError):
            validate_picture(tmp_path / f"{name}.png", (40, 30))
    with pytest.raises(InvalidFileError, match="is 40x30 pixels"):
        validate_picture(tmp_path / "plain.png", (40, 31), may_be_empty=True)


@needs_bpy
@pytest.mark.parametrize("background", ["plain", "transparent"])
def test_a_frame_that_the_ball_is_not_in_is_no_fault_without_a_background(tmp_path, warm, background):
    away = "[camera]\nposition = [0.0, -3.0, 9.0]\nlook_at = [0.0, 0.0, 12.0]\n"
    _, layout = job_of_the_ball(tmp_path, "away", f'{away}[set]\nbackground = "{background}"\n')
    ended = draw_the_ball(layout)
    assert isinstance(ended, Finished), ended


@needs_bpy
@pytest.mark.parametrize(("power", "is_white"), [(100.0, True), (5.0, False)])
def test_a_frame_that_is_nearly_white_is_warned_of(tmp_path, warm, power, is_white):
    sun = f'[[light]]\ntype = "sun"\nposition = [0.5, -1.0, 2.0]\npower = {power}\n'
    _, layout = job_of_the_ball(tmp_path, "noon", sun)
    ended = draw_the_ball(layout)
    assert isinstance(ended, Finished), ended
    assert ("of the picture is white" in layout.log(ended.task_id, 1).read_text()) == is_white
