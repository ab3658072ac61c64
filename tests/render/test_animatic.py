"""`pipeline animatic`: the film in plain pictures, by Blender's Workbench."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from bare_volumes import smoke_object, write_frame
from blender_scenes import read, redness, spec_of, sphere, write_mesh
from command_line import pipeline
from half_simulated_jobs import half_simulated_job
from needed_blender import needs_bpy, needs_egl

from pipeline.base.layout import JobLayout
from render import workbench
from render.blender import BlenderUnavailableError, FrameRenderError, script_argv
from render.parameters import MaterialParameters, SetParameters
from render.spec import MeshObject, SceneObject
from render.workbench import draw_frames, require_workbench


def frames_of(film: Path) -> list[np.ndarray]:
    with av.open(str(film)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def contents(layout: JobLayout) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in layout.root.rglob("*") if path.is_file()}


@needs_bpy
@needs_egl
def test_the_simulated_frames_become_a_film_beside_the_job_and_touch_nothing_else(tmp_path):
    job = half_simulated_job(tmp_path)
    before = contents(job)
    result = pipeline("animatic", job.root, "--width", 96)
    assert result.exit_code == 0, result.output
    film = job.root / "flight-animatic.mp4"
    assert result.stdout == f"{film}\n"
    assert "the 2 of 3 frames that are simulated, 96 x 54 pixels" in result.stderr
    frames = frames_of(film)
    assert [frame.shape for frame in frames] == [(54, 96, 3)] * 2
    # The red ball flies to the right, 0.2 m from frame to frame.
    columns = [np.nonzero(redness(frame.astype(float)) > 0.6)[1].mean() for frame in frames]
    assert columns[1] > columns[0] + 3
    assert {name: content for name, content in contents(job).items() if name != film.name} == before


@needs_bpy
@needs_egl
def test_workbench_is_found_by_letting_it_draw():
    require_workbench(None)


def test_a_missing_library_is_told_with_the_packages(monkeypatch):
    monkeypatch.setattr(workbench, "EGL_PACKAGES", {"libNoSuchThing.so.1": "libegl1"})
    monkeypatch.setattr(workbench, "require_bpy", lambda: None)
    with pytest.raises(BlenderUnavailableError, match=r"lacks libNoSuchThing.*install -y libegl1 libgl1-mesa-dri"):
        require_workbench(None)


@needs_egl
def test_a_process_that_aborts_is_told_with_the_packages(tmp_path):
    """As Workbench does where there is EGL, and no driver behind it."""
    aborting = tmp_path / "blender"
    aborting.write_text("#!/bin/sh\necho no display\nkill -ABRT $$\n")
    aborting.chmod(0o755)
    with pytest.raises(BlenderUnavailableError, match=r"(?s)exit code -6.*libgl1-mesa-dri\nno display"):
        require_workbench(str(aborting))
    with pytest.raises(FrameRenderError, match="frame 4: Blender ended with exit code -6: no display"):
        draw_frames(
            tmp_path / "spec.json", [4, 5], tmp_path, threads=1, blender=str(aborting), drawn=lambda _frame: None
        )


def test_argv_of_the_module_and_of_an_executable_run_the_same_script():
    module = script_argv(None, "render_frames.py", ["spec.json"])
    executable = script_argv("/opt/blender", "render_frames.py", ["spec.json"])
    start = ["/opt/blender", "--background", "--factory-startup", "--disable-autoexec"]
    assert executable == [*start, "--python", module[1], "--", "spec.json"]
    assert Path(module[1]).is_file()


@pytest.mark.parametrize("command", [("animatic",), ("still", "--frame", 0)])
def test_a_foreign_job_file_may_not_choose_what_runs_here(tmp_path, command):
    job = half_simulated_job(tmp_path)
    job.manifest.unlink()
    result = pipeline(*command, job.root)
    assert result.exit_code == 2
    assert "a job file may not choose what runs here" in result.stderr


def test_a_job_without_simulated_frames_is_told_what_to_do(tmp_path):
    job = half_simulated_job(tmp_path)
    for receipt in (job.receipts / "cache").iterdir():
        receipt.unlink()
    result = pipeline("animatic", job.root)
    assert result.exit_code == 1
    assert f"cache/000000.h5 is not simulated yet; go on with: pipeline resume {job.root}" in result.stderr


def workbench_picture(folder: Path, *objects: SceneObject, **changes: object) -> np.ndarray:
    spec = spec_of(*objects, resolution=(96, 54)).model_copy(update={"engine": "workbench", **changes})
    spec.write(folder / "spec.json")
    (picture,) = draw_frames(folder / "spec.json", [0], folder, threads=1, blender=None, drawn=lambda _frame: None)
    return read(picture)


@needs_bpy
@needs_egl
def test_bodies_have_the_colours_of_their_looks(tmp_path):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.12, rings=12, segments=24))
    looks = {"rubber": (1.0, 0.59, 0.02), "plastic": (0.62, 0.06, 0.05), "ceramic": (0.82, 0.79, 0.74)}
    balls = [
        MeshObject(name=look, file="ball.ply", position=(x, 0.0, 0.5), material=MaterialParameters(look=look))
        for look, x in zip(looks, (-0.35, 0.0, 0.35), strict=True)
    ]
    green = MaterialParameters(look="metal", color=(0.05, 0.6, 0.1))
    balls.append(MeshObject(name="own", file="ball.ply", position=(0.0, 0.0, 0.85), material=green))
    picture = workbench_picture(tmp_path, *balls, set=SetParameters(tank=True))
    # 96 pixels x 50 mm / 36 mm / 2.5 m = 53 pixels a metre.
    orange, red, white = (picture[27, 48 + round(53 * x)] for x in (-0.35, 0.0, 0.35))
    assert orange[0] > 1.2 * orange[1] > 2.0 * orange[2]
    assert red[0] > 2.0 * red[1]
    assert white.min() > 0.85 * white.max()
    own = picture[27 - round(53 * 0.35), 48]
    assert own[1] > 1.5 * own[0]


@needs_bpy
@needs_egl
@pytest.mark.parametrize("name", ["cyclorama", "tank_edge", "tank_glass"])
def test_a_body_that_is_called_as_a_part_of_the_stage_has_its_own_colour_and_the_stage_keeps_its(tmp_path, name):
    write_mesh(tmp_path / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.25, rings=12, segments=24))
    green = MaterialParameters(look="plastic", color=(0.05, 0.6, 0.1))
    ball = MeshObject(name=name, file="ball.ply", position=(0.0, 0.0, 0.5), material=green)
    for tank in (False, True):
        picture = workbench_picture(tmp_path, ball, set=SetParameters(tank=tank))
        red, level, blue = picture[27, 48]
        assert level > 1.5 * max(red, blue)
        around = picture.copy()
        around[12:42, 33:63] = 128.0  # the ball and its edge
        tint = around.max(axis=2) - around.min(axis=2)
        assert tint.max() < 40.0, "the stage is grey"


@needs_bpy
@needs_egl
@pytest.mark.parametrize("look", ["smoke", "fire"])
def test_smoke_and_fire_are_seen_where_they_are(tmp_path, look):
    cells = 16
    volume = smoke_object(MaterialParameters(look=look))
    pictures = []
    for filled in (0, cells // 2):
        density = np.zeros((cells,) * 3, np.float32)
        density[:filled] = 1.0
        write_frame(tmp_path, 0, density, kelvin=1200.0)
        pictures.append(workbench_picture(tmp_path, volume))
    # The left half of a cube of 0.6 m is full: 16 pixels of its 32 change, the right half does not.
    change = abs(pictures[1] - pictures[0]).mean(axis=2)[18:36]
    assert change[:, 36:46].mean() > 8.0
    assert change[:, 52:62].mean() < 1.0
