"""Which frames of a job belong together, by what receipts tell of them and of what they were made from."""

import os
from pathlib import Path

import pytest
from drawing_stages import ComputeStage, DrawStage

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Task, TaskId, task_fingerprint
from pipeline.job.loading import load_job
from pipeline.model.job import Job
from pipeline.run.plan import plan_job
from pipeline.show.picture_set import PictureSet, picture_set
from pipeline.store.artifacts import committing
from pipeline.store.receipts import read_receipt

FRAMES = 6


class PictureStage(DrawStage):
    """Pictures that gravity decides by what they are drawn of alone."""

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        parameters = ParameterSet.of(stage=self.name, version=self.version, tools={}, samples=job.render.samples)
        return [
            Task(
                TaskId(f"render/{frame:06d}"),
                self.name,
                (layout.frame_cache(frame),),
                (layout.picture(frame),),
                parameters,
                frame=frame,
            )
            for frame in range(FRAMES)
        ]


@pytest.fixture
def layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> JobLayout:
    monkeypatch.setattr("pipeline.stages.STAGES", (ComputeStage(), PictureStage()))
    layout = JobLayout(tmp_path)
    write_job(layout)
    return layout


def write_job(layout: JobLayout, *, gravity: int = -9, samples: int = 8) -> None:
    layout.job_file.write_text(
        f'name = "job"\nframes = {FRAMES}\ngravity = [0.0, 0.0, {gravity}.0]\nrender.samples = {samples}\n'
        '[[rigid]]\nname = "ball"\nshape = { type = "sphere", radius = 0.1 }\n'
    )


def make(layout: JobLayout, stage: str, frames: range) -> None:
    """Commit the files of a stage for some frames, by the job as it is; no record is kept."""
    job = load_job(layout.job_file)
    for task in plan_job(job, layout, (ComputeStage(), PictureStage())):
        for frame, output in enumerate(task.outputs) if task.frame is None else [(task.frame, task.outputs[0])]:
            if task.stage != stage or frame not in frames:
                continue
            hashes = {path: receipt.hash for path in task.inputs if (receipt := read_receipt(layout, path))}
            fingerprint = task_fingerprint(task, hashes)
            with committing(
                layout, output, task=task, attempt=1, fingerprint=fingerprint, validate=lambda _: None, inputs=hashes
            ) as new:
                new.path.write_text(f"{stage} {frame} {job.gravity} {job.render.samples}")


def make_all(layout: JobLayout) -> None:
    for stage in ("simulate", "render"):
        make(layout, stage, range(FRAMES))


def shown(layout: JobLayout) -> tuple[int, int, str]:
    found: PictureSet = picture_set(load_job(layout.job_file), layout)
    return len(found.unbroken), found.earlier, found.remark


def differing(*subjects: str) -> str:
    return f"its frames are not as the job would be made now; what differs: {', '.join(subjects)}"


def test_a_film_without_a_record_is_one_set_also_when_its_caches_were_deleted(layout):
    make_all(layout)
    assert shown(layout) == (FRAMES, 0, "")
    for frame in range(FRAMES):
        layout.receipt(layout.frame_cache(frame)).unlink()
        layout.path(layout.frame_cache(frame)).unlink()
    assert shown(layout) == (FRAMES, 0, "")


def test_a_film_of_another_simulation_than_the_job_would_have_now_is_one_set_and_told(layout):
    make_all(layout)
    write_job(layout, gravity=-20)
    assert shown(layout) == (FRAMES, 0, differing("simulate"))
    make(layout, "simulate", range(3))  # and is simulated anew
    assert shown(layout) == (FRAMES, 0, differing("simulate"))
    make(layout, "simulate", range(FRAMES))
    assert shown(layout) == (FRAMES, 0, differing("simulate"))


@pytest.mark.parametrize("simulated", [3, FRAMES])
def test_frames_of_a_new_simulation_and_of_the_one_before_are_not_mixed(layout, simulated):
    make_all(layout)
    write_job(layout, gravity=-20)
    make(layout, "simulate", range(simulated))
    make(layout, "render", range(3))
    assert shown(layout) == (3, FRAMES - 3, "")


def test_frames_that_were_drawn_otherwise_than_the_last_one_are_not_mixed_in(layout):
    make_all(layout)
    write_job(layout, samples=16)
    assert shown(layout) == (FRAMES, 0, differing("render"))
    make(layout, "render", range(2))
    assert shown(layout) == (2, FRAMES - 2, "")
    write_job(layout, samples=32)
    assert shown(layout) == (2, FRAMES - 2, differing("render"))


def test_a_frame_whose_file_is_not_the_one_of_its_receipt_ends_the_set(layout):
    make_all(layout)
    picture = layout.path(layout.picture(4))
    picture.write_text("another")
    os.utime(picture, ns=(1, 1))
    assert shown(layout) == (4, 0, "")


def test_that_the_job_cannot_be_planned_is_told_and_the_frames_are_shown(layout, monkeypatch):
    make_all(layout)
    monkeypatch.setattr("pipeline.stages.STAGES", (PictureStage(),))
    count, earlier, remark = shown(layout)
    assert (count, earlier) == (FRAMES, 0)
    assert remark.startswith("whether its frames are as the job would be made now cannot be told: render/000000 reads")
