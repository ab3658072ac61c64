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
from warm_blender import WarmRenderer

from pipeline.base.layout import JobLayout
from render import workbench
from render.blender import BlenderUnavailableError, FrameRenderError
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
    with pytest.raises(FrameRenderError, match=r"(?s)frame 4: .*-6 .*no display"):
        draw_frames(
            tmp_path / "spec.json", [4, 5], tmp_path, threads=1, blender=str(aborting), drawn=lambda _frame: None
        )


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


@pytest.fixture
def warm(monkeypatch):
    monkeypatch.setattr("render.workbench.ChildRenderer", WarmRenderer)


def workbench_pictures(folder: Path, *objects: SceneObject, frames: int = 1, **changes: object) -> list[np.ndarray]:
    spec = spec_of(*objects, resolution=(96, 54)).model_copy(update={"engine": "workbench", **changes})
    spec.write(folder / "spec.json")
    drawn = draw_frames(folder / "spec.json", range(frames), folder, threads=1, blender=None, drawn=lambda _frame: None)
    return [read(picture) for picture in drawn]


def balls(folder: Path, materials: dict[str, MaterialParameters]) -> list[MeshObject]:
    """Three balls beside each other, and one above the middle one if there are four."""
    write_mesh(folder / "ball.ply", *sphere((0.0, 0.0, 0.0), 0.12, rings=12, segments=24))
    places = ((-0.35, 0.0, 0.5), (0.0, 0.0, 0.5), (0.35, 0.0, 0.5), (0.0, 0.0, 0.85))
    return [
        MeshObject(name=name, file="ball.ply", position=place, material=material)
        for (name, material), place in zip(materials.items(), places, strict=False)
    ]


PIXELS_PER_METRE = 53  # of 96 pixels through a lens of 50 mm on 36 mm, at 2.5 m
COLUMNS = [48 + round(PIXELS_PER_METRE * x) for x in (-0.35, 0.0, 0.35)]


@needs_bpy
@needs_egl
def test_bodies_have_the_colours_of_their_looks(tmp_path, warm):
    materials = {look: MaterialParameters(look=look) for look in ("rubber", "plastic", "ceramic")}
    materials["own"] = MaterialParameters(look="metal", color=(0.05, 0.6, 0.1))
    (picture,) = workbench_pictures(tmp_path, *balls(tmp_path, materials), set=SetParameters(tank=True))
    orange, red, white = (picture[27, column] for column in COLUMNS)
    assert orange[0] > 1.2 * orange[1] > 2.0 * orange[2]
    assert red[0] > 2.0 * red[1]
    assert white.min() > 0.85 * white.max()
    own = picture[27 - round(PIXELS_PER_METRE * 0.35), 48]
    assert own[1] > 1.5 * own[0]


@needs_bpy
@needs_egl
@pytest.mark.parametrize("tank", [False, True])
def test_bodies_that_are_called_as_parts_of_the_set_have_their_own_colour_and_the_set_keeps_its(tmp_path, warm, tank):
    green = MaterialParameters(look="plastic", color=(0.05, 0.6, 0.1))
    named = balls(tmp_path, dict.fromkeys(("cyclorama", "tank_edge", "tank_glass"), green))
    (picture,) = workbench_pictures(tmp_path, *named, set=SetParameters(tank=tank))
    around = picture.copy()
    for column in COLUMNS:
        red, level, blue = picture[27, column]
        assert level > 1.5 * max(red, blue)
        around[18:36, column - 9 : column + 10] = 128.0  # the ball and its edge
    tint = around.max(axis=2) - around.min(axis=2)
    assert tint.max() < 40.0, "the set is grey"


@needs_bpy
@needs_egl
@pytest.mark.parametrize("look", ["smoke", "fire"])
def test_smoke_and_fire_are_seen_where_they_are(tmp_path, warm, look):
    cells = 16
    for frame, filled in enumerate((0, cells // 2)):
        density = np.zeros((cells,) * 3, np.float32)
        density[:filled] = 1.0
        write_frame(tmp_path, frame, density, kelvin=1200.0)
    before, after = workbench_pictures(tmp_path, smoke_object(MaterialParameters(look=look, density=12.0)), frames=2)
    # The left half of a cube of 0.6 m is full: 16 pixels of its 32 change, the right half does not.
    change = abs(after - before).mean(axis=2)[18:36]
    assert change[:, 36:46].mean() > 8.0
    assert change[:, 52:62].mean() < 1.0
