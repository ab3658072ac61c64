"""Runs the stages of drawing_stages without a runner, and keeps the record as a runner would."""

from __future__ import annotations

import drawing_stages
from inline_tasks import run_task

from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskState, task_fingerprint
from pipeline.job.loading import load_job
from pipeline.record.manifest import Manifest
from pipeline.run.events import Finished
from pipeline.run.plan import input_hashes, plan_job
from pipeline.store.receipts import read_receipt


def draw_film(layout: JobLayout, *, frames: int | None = None) -> None:
    """Draw the frames of a job and make its film; only so many frames, and no film, if told so."""
    job = load_job(layout.job_file)
    tasks = plan_job(job, layout, drawing_stages.STAGES)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks)
        for task in tasks if frames is None else tasks[:frames]:
            hashes = input_hashes(task, manifest.artifacts())
            fingerprint = task_fingerprint(task, hashes)
            attempt = manifest.start_attempt(task.id)
            ended = run_task(
                task, layout, attempt=attempt, fingerprint=fingerprint, inputs=hashes, stages=drawing_stages.REFERENCE
            )
            assert isinstance(ended, Finished), ended
            for output in task.outputs:
                receipt = read_receipt(layout, output)
                assert receipt is not None
                manifest.record_artifact(receipt)
            manifest.finish_attempt(task.id, attempt, seconds=3.0)
            manifest.set_states({task.id: TaskState.SUCCEEDED})
