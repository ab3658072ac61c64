"""`pipeline animatic`: the film in plain pictures, by Blender's Workbench."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from blender_scenes import redness
from command_line import pipeline
from half_simulated_jobs import half_simulated_job
from needed_blender import needs_bpy, needs_egl

from pipeline.layout import JobLayout
from render import workbench
from render.blender import BlenderUnavailableError, FrameRenderError
from render.workbench import build_workbench_argv, draw_frames, require_workbench


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
    module = build_workbench_argv(None, "render_frames.py", ["spec.json"])
    executable = build_workbench_argv("/opt/blender", "render_frames.py", ["spec.json"])
    assert executable == ["/opt/blender", "--background", "--factory-startup", "--python", module[1], "--", "spec.json"]
    assert Path(module[1]).is_file()


def test_a_job_without_simulated_frames_is_told_what_to_do(tmp_path):
    job = half_simulated_job(tmp_path)
    for receipt in (job.receipts / "cache").iterdir():
        receipt.unlink()
    result = pipeline("animatic", job.root)
    assert result.exit_code == 1
    assert f"cache/000000.h5 is not simulated yet; go on with: pipeline resume {job.root}" in result.stderr
