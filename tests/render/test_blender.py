"""Real pictures by the real Cycles: tiny, few samples, in child processes, as Blender has one scene per process."""

from __future__ import annotations

import errno
import os
import pickle
import signal
import sys
import tempfile
import threading
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from bare_volumes import smoke_object, write_frame
from blender_scenes import (
    BALL,
    RENDER_FRAMES,
    RESOLUTION,
    read,
    redness,
    spec_of,
    sphere,
    still_camera,
    write_mesh,
)
from blender_stand_in import write_blender_stand_in
from fresh_python import run_python as run_fresh_python
from inline_tasks import run_task
from needed_blender import needs_bpy
from refused_removal import refuse_removal
from warm_python import run_python

from blender_scripts.look_table import looks_for
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind
from pipeline.job.loading import load_job
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.stages import render_drawing
from pipeline.stages.render import RenderStage
from render.blender import (
    BlenderDiedError,
    BlenderUnavailableError,
    ChildRenderer,
    FrameRenderError,
    build_argv,
    open_renderer,
    parse_blender_version,
    require_supported_executable,
    run_script,
    script_argv,
)
from render.gpus import find_gpus
from render.parameters import CameraParameters, MaterialParameters, SetParameters
from render.spec import MeshObject, RenderSpec
from render.temporary_folder import environment_of_child

pytestmark = needs_bpy


# Share of red in a pixel: 0.29 on the grey stage, about 0.7 on the ball.
MOSTLY_RED = 0.45
FAINTLY_RED = 0.33


def write_ball_frames(folder: Path) -> None:
    """Frame 0: still. 1: moved. 2: still shape that flies along x. 3: empty. 4: NaN. 5: truncated. 6: missing."""
    positions, triangles = sphere((0.0, 0.0, 0.5), 0.3)
    write_mesh(folder / "ball/000000.ply", positions, triangles, velocity=(0.0, 0.0, 0.0))
    write_mesh(folder / "ball/000001.ply", positions + np.array((0.15, 0.0, 0.0)), triangles, velocity=(0.0, 0.0, 0.0))
    write_mesh(folder / "ball/000002.ply", positions, triangles, velocity=(24.0, 0.0, 0.0))
    write_mesh(folder / "ball/000003.ply", np.zeros((0, 3)), np.zeros((0, 3), int), velocity=(0.0, 0.0, 0.0))
    broken = positions.copy()
    broken[7] = np.nan
    write_mesh(folder / "ball/000004.ply", broken, triangles)
    whole = (folder / "ball/000000.ply").read_bytes()
    (folder / "ball/000005.ply").write_bytes(whole[: len(whole) // 2])


@pytest.fixture(scope="module")
def ball_pictures(tmp_path_factory) -> tuple[Path, str]:
    """All ball frames, drawn in one process; and what it printed."""
    folder = tmp_path_factory.mktemp("ball")
    write_ball_frames(folder)
    spec_of(BALL, samples=16).write(folder / "spec.json")
    return folder, run_python(RENDER_FRAMES, str(folder), ".{frame:06d}.png.part#1", "0,1,2,3,4,5,6,0")


def test_the_mask_of_a_sphere_has_the_area_of_its_projection(ball_pictures):
    folder, _ = ball_pictures
    mask = redness(read(folder / ".000000.png.part#1")) > MOSTLY_RED
    # A sphere of radius r at distance d is seen under tan = r / sqrt(d² - r²); 50 mm on a 36 mm sensor.
    pixels_per_tangent = RESOLUTION[0] * 50.0 / 36.0
    radius = pixels_per_tangent * 0.3 / np.sqrt(2.5**2 - 0.3**2)
    # Half a pixel of radius either way is what a rim of mixed pixels is worth; shading at the rim takes a little more.
    assert np.sqrt(mask.sum() / np.pi) == pytest.approx(radius, abs=0.8)


def test_neighbouring_frames_differ_where_the_mesh_moved(ball_pictures):
    folder, _ = ball_pictures
    columns = [
        np.nonzero(redness(read(folder / f".{frame:06d}.png.part#1")) > MOSTLY_RED)[1].mean() for frame in (0, 1)
    ]
    moved = RESOLUTION[0] * 50.0 / 36.0 * 0.15 / 2.5
    # Centroids of masks of 160 pixels are good to a fraction of a pixel.
    assert columns[1] - columns[0] == pytest.approx(moved, abs=0.6)


def test_velocity_attribute_blurs_the_edges_by_speed_times_shutter(ball_pictures):
    folder, _ = ball_pictures
    row = RESOLUTION[1] // 2
    still, flying = (
        int((redness(read(folder / f".{frame:06d}.png.part#1"))[row] > FAINTLY_RED).sum()) for frame in (0, 2)
    )
    travelled = RESOLUTION[0] * 50.0 / 36.0 * (24.0 * 0.5 / 60.0) / 2.5
    # The trace is as much wider as the ball travels while the shutter is open, less its two thinnest ends, where
    # less than a quarter of the exposure shows red; and two pixels because the edges fall anywhere inside a pixel.
    assert 0.5 * travelled - 1 <= flying - still <= travelled + 1


def test_an_empty_mesh_draws_nothing(ball_pictures):
    assert (redness(read(ball_pictures[0] / ".000003.png.part#1")) < 0.5).all()


def test_broken_input_is_refused_with_frame_and_file(ball_pictures):
    folder, printed = ball_pictures
    refused = [line for line in printed.splitlines() if line.startswith("REFUSED")]
    assert len(refused) == 3
    assert "frame 4:" in refused[0] and "vertices of vertex 7 are not finite" in refused[0]
    assert "frame 5:" in refused[1] and "truncated" in refused[1]
    assert "frame 6:" in refused[2] and "000006.ply" in refused[2] and "No such file" in refused[2]
    assert not (folder / ".000004.png.part#1").exists()


def test_a_denoised_frame_does_not_depend_on_the_process_or_its_threads(tmp_path):
    both = ""
    for quality in ("draft", "preview"):
        folder = tmp_path / quality
        write_ball_frames(folder)
        spec_of(BALL, denoise=True, quality=quality, motion_blur=True).write(folder / "spec.json")
        run_python(RENDER_FRAMES, str(folder), "warm-{frame}.png", "2", "1")
        both += f"\nsys.argv[1:] = [{str(folder)!r}, 'fresh-{{frame}}.png', '2', '2']\n" + dedent(RENDER_FRAMES)
    run_fresh_python("import sys" + both)
    for quality in ("draft", "preview"):
        assert (tmp_path / quality / "warm-2.png").read_bytes() == (tmp_path / quality / "fresh-2.png").read_bytes()


@pytest.fixture
def blender_stand_in(tmp_path) -> Path:
    return write_blender_stand_in(tmp_path)


@pytest.fixture
def temporary(tmp_path, monkeypatch) -> Path:
    """The folder of all temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def require_own_folder(temporary: Path) -> None:
    (own,) = temporary.iterdir()
    assert list(own.glob("blender_*"))  # Blender's own folder lies there


def test_an_executable_draws_the_same_bytes_as_the_module_and_leaves_no_temporary_files(
    ball_pictures, blender_stand_in, temporary
):
    folder, printed = ball_pictures
    assert "DEVICE CPU" in printed
    renderer = open_renderer(folder / "spec.json", threads=1, blender=str(blender_stand_in))
    try:
        assert renderer.device == "CPU"
        require_own_folder(temporary)
        renderer.render(0, folder / "external 0.png")
        with pytest.raises(FrameRenderError, match=r"frame 4: .*not finite"):
            renderer.render(4, folder / "external 4.png")
        renderer.render(1, folder / "external 1.png")
    finally:
        renderer.close()
    for frame in (0, 1):
        expected = (folder / f".{frame:06d}.png.part#1").read_bytes()
        assert (folder / f"external {frame}.png").read_bytes() == expected
    assert isinstance(renderer, ChildRenderer)
    assert renderer._process.poll() is not None
    assert list(temporary.iterdir()) == []


def test_a_killed_executable_is_reported_with_its_last_lines_and_leaves_no_temporary_files(
    ball_pictures, blender_stand_in, temporary
):
    folder, _ = ball_pictures
    renderer = ChildRenderer(folder / "spec.json", threads=1, blender=str(blender_stand_in))
    require_own_folder(temporary)
    renderer._process.kill()
    renderer._process.wait()
    with pytest.raises(BlenderDiedError, match=r"(?s)exit code -9; .*noise that Blender prints") as death:
        renderer.render(0, folder / "never.png")
    assert (death.value.frame, death.value.returncode) == (0, -9)
    again = pickle.loads(pickle.dumps(death.value))
    assert (str(again), again.returncode) == (str(death.value), -9)
    renderer.close()
    assert list(temporary.iterdir()) == []


def test_a_script_leaves_no_temporary_files_however_it_ends(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code = "import bpy, os; print(bpy.app.tempdir, flush=True); os._exit(1)"
    told = run_script([sys.executable, "-c", code], timeout_s=120.0, purpose="end").stdout
    assert told.startswith(f"{tmp_path}/")
    assert list(tmp_path.iterdir()) == []


def test_a_full_temporary_disk_is_not_told_as_a_blender_that_cannot_be_started(monkeypatch):
    def full(**_options):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/temporary/blender-1")

    monkeypatch.setattr("render.temporary_folder.mkdtemp", full)
    with pytest.raises(OSError, match="/temporary/blender-1"):
        run_script(["blender"], timeout_s=1.0, purpose="end")
    assert "/temporary/blender-1" in find_gpus("blender").trouble


def test_a_temporary_folder_that_cannot_be_removed_costs_no_picture(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with environment_of_child("blender") as environment:
        refuse_removal(monkeypatch, tmp_path)
    assert environment["TMPDIR"].startswith(f"{tmp_path}/")


def test_blender_up_to_4_5_asks_for_its_temporary_folder_by_another_name_first(tmp_path, monkeypatch):
    monkeypatch.setenv("TMP", "/elsewhere")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with environment_of_child("blender") as environment:
        assert environment["TMP"] == environment["TMPDIR"] != "/elsewhere"


def test_an_executable_killed_between_frames_or_while_it_draws_costs_an_attempt(tmp_path, blender_stand_in):
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    layout.job_file.write_text(
        'name = "still"\nframes = 3\n[render]\nresolution = [64, 36]\nquality = "draft"\nsamples = 1\ndenoise = false\n'
        f"blender = '{blender_stand_in}'\n"
    )
    tasks = RenderStage().plan(load_job(layout.job_file), layout)

    def attempt(frame: int, number: int) -> TaskEvent:
        return run_task(tasks[frame], layout, attempt=number)

    def kill_blender(renderer: ChildRenderer) -> None:
        renderer._process.kill()
        renderer._process.wait()

    assert isinstance(attempt(0, 1), Finished)
    (renderer,) = render_drawing._WARM.values()
    kill_blender(renderer)
    lost = attempt(1, 1)
    assert isinstance(lost, Failed)
    assert lost.kind is FailureKind.WORKER_LOST
    assert isinstance(attempt(1, 2), Finished)

    (renderer,) = render_drawing._WARM.values()
    os.kill(renderer._process.pid, signal.SIGSTOP)  # it has been asked for the frame, and has not drawn it
    killer = threading.Timer(0.5, kill_blender, (renderer,))
    killer.start()
    lost = attempt(2, 1)
    killer.join()
    assert isinstance(lost, Failed)
    assert lost.kind is FailureKind.WORKER_LOST
    assert isinstance(attempt(2, 2), Finished)
    render_drawing.close_renderers()


def test_missing_spec_is_refused_by_the_executable(tmp_path, blender_stand_in):
    with pytest.raises(BlenderUnavailableError, match=r"cannot read the render specification .*nothing\.json"):
        open_renderer(tmp_path / "nothing.json", threads=1, blender=str(blender_stand_in))


def test_smoke_is_drawn_where_it_is_and_unfit_volumes_are_refused(tmp_path):
    smoke = smoke_object(MaterialParameters(look="smoke", color=(0.02, 0.02, 0.02), density=200.0))
    spec_of(smoke).write(tmp_path / "spec.json")
    (tmp_path / "smoke").mkdir()
    (tmp_path / "smoke/000001.vdb").write_bytes(b"this is no volume")
    cells = 16
    for frame, filled in ((2, slice(0, 0)), (3, slice(0, cells // 2))):
        density = np.zeros((cells,) * 3, np.float32)
        density[filled] = 1.0
        write_frame(tmp_path, frame, density, kelvin=300.0)
    printed = run_python(RENDER_FRAMES, str(tmp_path), "{frame}.png", "0,1,2,3")
    assert "frame 0: the volume" in printed and "000000.vdb does not exist" in printed
    assert "frame 1: cannot read the volume" in printed
    assert not (tmp_path / "0.png").exists() and not (tmp_path / "1.png").exists()
    empty, half_full = (read(tmp_path / f"{frame}.png").mean(axis=2) for frame in (2, 3))
    darkening = (empty - half_full)[10:26]
    # Black, dense smoke fills the left half of a 0.6 m cube: there the picture darkens to a fraction, while the right
    # half only loses some light that was reflected by the floor.
    assert darkening[:, 24:30].mean() > 0.5 * empty[10:26, 24:30].mean()
    assert abs(darkening[:, 36:42]).mean() < 0.15 * empty[10:26, 36:42].mean()


def test_every_look_and_set_builds_and_draws(tmp_path):
    positions, triangles = sphere((0.0, 0.0, 0.0), 0.12, rings=8, segments=12)
    write_mesh(tmp_path / "ball.ply", positions, triangles)
    objects = tuple(
        MeshObject(
            name=look,
            file="ball.ply",
            position=(-0.45 + 0.3 * (index % 4), 0.0, 0.15 + 0.3 * (index // 4)),
            material=MaterialParameters(look=look, density=5.0),
        )
        for index, look in enumerate(looks_for("rigid"))
    )
    night = SetParameters(name="night", strength=30.0)
    window = SetParameters(name="window", ground="stone")
    camera = still_camera(CameraParameters())
    for stage in (SetParameters(name="studio", tank=True), SetParameters(name="outdoor"), night, window):
        spec = spec_of(*objects, samples=2).model_copy(update={"set": stage, "camera": camera})
        spec.write(tmp_path / "spec.json")
        run_python(RENDER_FRAMES, str(tmp_path), f"{stage.name}.png", "0")
        assert 10 < read(tmp_path / f"{stage.name}.png").mean() < 245


def test_spec_survives_its_json(tmp_path):
    spec = spec_of(BALL, seed=7)
    spec.write(tmp_path / "spec.json")
    assert RenderSpec.model_validate_json((tmp_path / "spec.json").read_text()) == spec


def test_argv_starts_blender_without_the_users_settings():
    argv = build_argv("/opt/blender", Path("/job/spec.json"), threads=3, gpu=None)
    script = argv[argv.index("--python") + 1]
    start = ["/opt/blender", "--background", "--factory-startup", "--disable-autoexec", "--threads", "3", "--python"]
    assert argv[: len(start)] == start
    assert Path(script).is_file()
    assert argv[argv.index("--") + 1 :] == ["/job/spec.json", "--threads", "3", "--gpu", "none"]
    assert script_argv(None, "gpus.py", ["a word"]) == [
        sys.executable,
        str(Path(script).with_name("gpus.py")),
        "a word",
    ]


@pytest.mark.parametrize(
    ("text", "version"),
    [
        ("Blender 4.5.3 LTS\n\tbuild date: 2025-09-09\n", (4, 5, 3)),
        ("Color management: warning\nBlender 5.2.0 LTS\n", (5, 2, 0)),
        ("GNU coreutils 9.1\n", None),
    ],
)
def test_version_is_read_from_what_blender_prints(text, version):
    assert parse_blender_version(text) == version


def test_old_and_foreign_and_missing_executables_are_refused(tmp_path):
    def executable(name: str, text: str) -> str:
        path = tmp_path / name
        path.write_text(f"#!/bin/sh\necho '{text}'\n")
        path.chmod(0o755)
        return str(path)

    with pytest.raises(BlenderUnavailableError, match=r"is Blender 4\.2\.1; 4\.5 LTS or newer"):
        require_supported_executable(executable("old", "Blender 4.2.1 LTS"))
    with pytest.raises(BlenderUnavailableError, match="is not a Blender executable"):
        require_supported_executable(executable("foreign", "hello"))
    with pytest.raises(BlenderUnavailableError, match=r"cannot start .*No such file"):
        require_supported_executable(str(tmp_path / "missing"))
