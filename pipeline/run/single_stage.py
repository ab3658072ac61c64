"""One stage of a job, or some of its frames, run by themselves: for farms that have a manager of their own.

No manifest and no lease: what is done is what has a receipt, so any number of machines may work on different frames of
the same job folder at once. `pipeline resume` later takes all of it over into the record.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count

from pipeline.base.errors import PipelineError
from pipeline.base.files import make_folder
from pipeline.base.layout import JobLayout
from pipeline.base.places import check_places
from pipeline.base.resources import claim
from pipeline.base.task import ArtifactPath, FailureKind, Resources, Task, task_fingerprint
from pipeline.model.gpus import first_gpu
from pipeline.model.job import Job
from pipeline.run.control import Selection
from pipeline.run.events import Failed, Progress, TaskEvent
from pipeline.run.executors.attempt import STAGES_REFERENCE, load_stages, run_attempt
from pipeline.run.executors.base import Assignment
from pipeline.run.plan import plan_job
from pipeline.store.receipts import Receipt, is_committed, read_receipt, verify_artifact

_STOPS = frozenset({FailureKind.DISK_FULL, FailureKind.OUTGROWN, FailureKind.CANCELLED})
"""Failures after which no further task is tried."""


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """How many tasks ran, how many had been done before, and those that failed."""

    ran: int
    up_to_date: int
    failures: tuple[Failed, ...]


def run_stage(
    job: Job,
    layout: JobLayout,
    stage: str,
    frames: frozenset[int] | None = None,
    *,
    capacity: Resources,
    tell: Callable[[float, str], None],
    stages: str = STAGES_REFERENCE,
    stop_requested: Callable[[], bool] = lambda: False,
) -> StageOutcome:
    """Run the tasks of a stage, or of some of its frames; see `run_tasks`. Raises PlanError if there are none such."""
    tasks = plan_job(job, layout, load_stages(stages))
    chosen = Selection(frozenset({stage}), frames).of(tasks)
    todo = [task for task in tasks if task.id in chosen]
    return run_tasks(todo, layout, capacity=capacity, stages=stages, stop_requested=stop_requested, tell=tell)


def run_tasks(
    todo: Sequence[Task],
    layout: JobLayout,
    *,
    capacity: Resources,
    tell: Callable[[float, str], None],
    stages: str = STAGES_REFERENCE,
    stop_requested: Callable[[], bool] = lambda: False,
) -> StageOutcome:
    """Run those of these tasks, makers before users, that are not done, one after another, in this process.

    What else they read is in the job's folder. `tell` takes the share that is done, 0 to 1, and a sentence. Once
    `stop_requested` says so a task writes a checkpoint, and no other one follows.

    Raises PipelineError: an input is not there, or something is in the place of a file or a folder of the job.
    """
    check_places(layout, (artifact for task in todo for artifact in task.outputs))
    ran, up_to_date, failures = 0, 0, list[Failed]()
    for index, task in enumerate(todo):
        assignment = _assignment(task, layout, capacity=capacity, stages=stages)
        if assignment is None:
            up_to_date += 1
            continue
        ending = list[Failed]()

        def emit(event: TaskEvent, index: int = index, task: Task = task, ending: list[Failed] = ending) -> None:
            if isinstance(event, Progress):
                tell((index + event.done / event.total) / len(todo), f"{task.id} {event.message}".rstrip())
            elif isinstance(event, Failed):
                ending.append(event)

        run_attempt(assignment, emit, stop_requested=stop_requested)
        ran += not ending
        failures += ending
        if stop_requested() or any(failed.kind in _STOPS for failed in ending):
            break
        tell((index + 1) / len(todo), task.id)
    return StageOutcome(ran, up_to_date, tuple(failures))


def _assignment(task: Task, layout: JobLayout, *, capacity: Resources, stages: str) -> Assignment | None:
    """A new attempt of a task; None if its outputs are there."""
    receipts = {artifact: _receipt_of_input(task, artifact, layout) for artifact in task.inputs}
    inputs = {artifact: receipt.hash for artifact, receipt in receipts.items()}
    fingerprint = task_fingerprint(task, inputs)
    if all(is_committed(layout, artifact, fingerprint) for artifact in task.outputs):
        return None
    need = claim(task.resources, capacity)
    return Assignment(
        task=task,
        attempt=_open_attempt(task, layout),
        fingerprint=fingerprint,
        inputs=inputs,
        threads=need.cores,
        job_file=layout.job_file,
        root=layout.root,
        stages=stages,
        need=need,
        gpu=first_gpu(task) if need.gpus else None,
    )


def _receipt_of_input(task: Task, artifact: ArtifactPath, layout: JobLayout) -> Receipt:
    receipt = read_receipt(layout, artifact)
    problem = "it was never made" if receipt is None else verify_artifact(layout, receipt)
    if receipt is None or problem:
        raise PipelineError(f"{task.id} needs {artifact}: {problem}; run the stage that makes it first")
    return receipt


def _open_attempt(task: Task, layout: JobLayout) -> int:
    """A number that no other attempt has, on any machine: the log of that name is made, and was not there before."""
    committed = [read_receipt(layout, artifact) for artifact in task.outputs]
    first = 1 + max((receipt.attempt for receipt in committed if receipt and receipt.task == task.id), default=0)
    make_folder(layout.log(task.id, first).parent, within=layout.root)
    for number in count(first):
        try:
            descriptor = os.open(layout.log(task.id, number), os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            continue
        with os.fdopen(descriptor, "w") as log:
            log.write("run by `pipeline work --stage`; what it printed is in the log of whoever started that\n")
        return number
    raise AssertionError("numbers do not end")
