"""One way of a frame: its description is built once, its picture decoded once, its job validated once a process."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from blender_scenes import sphere, write_mesh
from checked_jobs import load_checked_job
from inline_tasks import run_task
from PIL import Image

from pipeline.base.layout import JobLayout
from pipeline.job import loading
from pipeline.job.loading import load_job, read_job
from pipeline.model.job import Job
from pipeline.run.events import Finished
from pipeline.stages import render_drawing
from pipeline.stages.render import RenderStage
from render.spec import RenderSpec

JOB = """
name = "duck"
frames = 3
[[rigid]]
name = "ball"
kind = "static"
shape = { type = "mesh", file = "ball.ply", size = 0.5 }
position = [0.0, 0.0, 0.5]
[camera]
position = [0.0, -2.0, 0.5]
look_at = [0.0, 0.0, 0.5]
[render]
resolution = [64, 36]
device = "cpu"
"""
BALL = sphere((0.0, 0.0, 0.0), 0.25)


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each of the steps is taken that a frame needs once."""
    counted: Counter[str] = Counter()

    def count(owner: Any, name: str, key: Callable[..., str]) -> None:
        real = getattr(owner, name)

        def counting(*arguments: Any, **options: Any) -> Any:
            counted[key(*arguments)] += 1
            return real(*arguments, **options)

        monkeypatch.setattr(owner, name, counting)

    count(Job, "model_validate", lambda *_: "job validated")
    count(render_drawing, "render_spec", lambda *_: "described")
    count(RenderSpec, "model_dump_json", lambda *_: "dumped")
    count(render_drawing, "read_picture", lambda path: f"decoded {path.name.partition('.part')[0]}")
    monkeypatch.setattr(loading, "_JOBS", {})
    return counted


class Pencil(SimpleNamespace):
    """A renderer that draws without Blender."""

    device, pictures_by_uv = "CPU", frozenset[str]()

    def render(self, _frame: int, path: Path) -> None:
        Image.effect_noise((64, 36), 80.0).convert("RGB").save(path, format="PNG")

    def render_set(self, _frame: int, path: Path, *, resolution: tuple[int, int]) -> None:
        Image.new("RGB", resolution, (0, 0, 90)).save(path, format="PNG")

    def close(self) -> None:
        """Nothing is open."""


def test_a_frame_is_described_once_and_its_picture_decoded_once(tmp_path, monkeypatch, counts):
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    layout.job_file.write_text(JOB)
    write_mesh(layout.root / "ball.ply", *BALL)
    mesh = layout.path(layout.body_mesh("ball"))
    mesh.parent.mkdir(parents=True)
    write_mesh(mesh, *BALL)
    tasks = RenderStage().plan(load_job(layout.job_file), layout)
    monkeypatch.setattr("pipeline.stages.render_drawing.open_renderer", lambda *_, **__: Pencil())
    try:
        for frame in (0, 1):
            counts.clear()
            ended = run_task(tasks[frame], layout)
            assert isinstance(ended, Finished), ended
            first = {"decoded set.png": 1} if frame == 0 else {}  # the camera stands still
            assert counts == {"described": 1, "dumped": 1, f"decoded .{frame:06d}.png": 1} | first
    finally:
        render_drawing.close_renderers()


def test_a_job_is_validated_once_a_process_from_the_command_to_the_task(tmp_path, counts):
    write_mesh(tmp_path / "ball.ply", *BALL)
    (tmp_path / "duck.toml").write_text(JOB)
    overrides = ["frames=2", "set.strength=2"]
    submitted = read_job(tmp_path / "duck.toml", overrides)
    checked, _ = load_checked_job(tmp_path / "duck.toml", overrides)
    layout = JobLayout(tmp_path / "renders" / "duck")
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(checked.text)
    assert load_job(layout.job_file) == checked.job == submitted.job
    assert counts == {"job validated": 1}


def test_what_is_kept_of_a_job_is_what_its_text_says(tmp_path, monkeypatch):
    write_mesh(tmp_path / "ball.ply", *BALL)
    (tmp_path / "duck.toml").write_text(JOB + '[material.ball]\nblend = "own.blend:Old gold"\n')
    kept = read_job(tmp_path / "duck.toml")
    monkeypatch.setattr(loading, "_JOBS", {})
    (tmp_path / "elsewhere.toml").write_text(kept.text)
    anew = load_job(tmp_path / "elsewhere.toml")
    assert anew == kept.job
    assert anew.model_dump(exclude_unset=True) == kept.job.model_dump(exclude_unset=True)
    assert anew.rigid[0].shape.file == str(tmp_path / "ball.ply")
