"""Stills: one frame of a job drawn otherwise, of what the job has computed and without touching what it has made.

A still is made in a scratch folder that looks like a job's: what the job has committed is linked into it with its
receipts, what is missing of that one frame is made there. So the job's record, its frames and a runner at work on it
see nothing of it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.errors import PipelineError
from pipeline.executors.attempt import load_stages
from pipeline.fingerprint import task_fingerprint
from pipeline.job.loading import LoadedJob
from pipeline.layout import JobLayout
from pipeline.plan import plan_job
from pipeline.receipts import Receipt, is_committed, read_receipt
from pipeline.stage_run import run_tasks
from pipeline.task import ArtifactPath, Resources, Task

SIMULATION = "simulate"


@dataclass(frozen=True, slots=True)
class StillPlan:
    """What a still is made of.

    Attributes:
        task: draws it.
        committed: what the job has of it, by its receipts.
        todo: what is to be made, makers first; `task` is the last.
        lacking: a frame of the simulation that is not there as this job has it; None: all are.
    """

    task: Task
    committed: tuple[Receipt, ...]
    todo: tuple[Task, ...]
    lacking: ArtifactPath | None


def plan_still(loaded: LoadedJob, layout: JobLayout, frame: int, *, stages: str) -> StillPlan:
    """What has to be made to draw one frame of a job.

    Args:
        loaded: the job, changed as the still is to be.
        layout: the folder of the job that was submitted.
        frame: which frame.
        stages: where the stages are, as `module:ATTRIBUTE`.

    Raises:
        PipelineError: the job has no such frame.
    """
    job = loaded.job
    if frame >= job.frame_count:
        raise PipelineError(f"{job.name} has no frame {frame}; its frames are 0-{job.frame_count - 1}")
    tasks = plan_job(job, layout, load_stages(stages))
    task = next(each for each in tasks if each.outputs == (layout.picture(frame),))
    needed = _ancestors(task, tasks)
    receipts: dict[ArtifactPath, Receipt] = {}
    todo: list[Task] = []
    lacking = None
    for each in needed:
        found = None if each is task else _committed(each, layout, receipts, needed)
        if found is not None:
            receipts.update(found)
        elif each.stage == SIMULATION:
            lacking = _needed_outputs(each, needed)[-1]
        else:
            todo.append(each)
    return StillPlan(task, tuple(receipts.values()), tuple(todo), lacking)


def make_still(
    loaded: LoadedJob,
    plan: StillPlan,
    layout: JobLayout,
    target: Path,
    *,
    capacity: Resources,
    stages: str,
    say: Callable[[str], None],
) -> None:
    """Make what is missing of a still, draw it, and put it where it belongs.

    Args:
        loaded: as for `plan_still`.
        plan: what `plan_still` found; nothing of the simulation is lacking.
        layout: the folder of the job that was submitted.
        target: the picture to write; replaced if it is there.
        capacity: what a task may use.
        stages: where the stages are, as `module:ATTRIBUTE`.
        say: is told what begins.

    Raises:
        PipelineError: it could not be made; says why.
    """
    with _scratch(loaded, plan, layout) as scratch:
        for task in plan.todo:
            say(task.id)
            outcome = run_tasks(
                [task],
                scratch,
                capacity=capacity,
                stages=stages,
                stop_requested=lambda: False,
                tell=lambda _share, _sentence: None,
            )
            for failed in outcome.failures:
                raise PipelineError(f"{failed.task_id}: {failed.message}")
        target.parent.mkdir(parents=True, exist_ok=True)
        part = target.with_name(f".{target.name}.part")
        try:
            shutil.copyfile(scratch.path(plan.task.outputs[0]), part)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)


@contextmanager
def _scratch(loaded: LoadedJob, plan: StillPlan, layout: JobLayout) -> Iterator[JobLayout]:
    """A job's folder of its own, in which what is committed is there by link; gone at the end of the block."""
    with TemporaryDirectory(prefix="still-") as folder:
        scratch = JobLayout(Path(folder).resolve())
        scratch.job_file.write_text(loaded.text, encoding="utf-8")
        for receipt in plan.committed:
            path, copy = scratch.path(receipt.artifact), scratch.receipt(receipt.artifact)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(layout.path(receipt.artifact).resolve())
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(receipt.to_json(), encoding="utf-8")
        yield scratch


def _ancestors(task: Task, tasks: list[Task]) -> list[Task]:
    """The task and all that it is made from, makers first."""
    makers = {output: each for each in tasks for output in each.outputs}
    needed, waiting = {task.id}, [task]
    while waiting:
        for artifact in waiting.pop().inputs:
            maker = makers[artifact]
            if maker.id not in needed:
                needed.add(maker.id)
                waiting.append(maker)
    return [each for each in tasks if each.id in needed]


def _committed(
    task: Task, layout: JobLayout, receipts: dict[ArtifactPath, Receipt], needed: list[Task]
) -> dict[ArtifactPath, Receipt] | None:
    """Receipts of those outputs that are needed; None if one is not there as this task would make it."""
    if any(artifact not in receipts for artifact in task.inputs):
        return None
    fingerprint = task_fingerprint(task, {artifact: receipts[artifact].hash for artifact in task.inputs})
    found = {}
    for artifact in _needed_outputs(task, needed):
        receipt = read_receipt(layout, artifact)
        if receipt is None or not is_committed(layout, artifact, fingerprint):
            return None
        found[artifact] = receipt
    return found


def _needed_outputs(task: Task, needed: list[Task]) -> list[ArtifactPath]:
    read = {artifact for each in needed for artifact in each.inputs}
    return [artifact for artifact in task.outputs if artifact in read]
