"""Records of jobs with many tasks, written through the record itself; nothing of them is run."""

import time

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import FailureKind, Task, TaskId, TaskState
from pipeline.record.manifest import Manifest
from pipeline.run.events import JobOutcome
from pipeline.store.receipts import Receipt

STAGES = ("surface", "render")


def plan(tasks: int) -> list[Task]:
    """A simulation, and half of the other tasks each surfaces and pictures."""
    parameters = {name: ParameterSet.of(stage=name, version=1, tools={}) for name in ("simulate", *STAGES)}
    frames = (tasks - 1) // 2
    caches = tuple(JobLayout.frame_cache(frame) for frame in range(frames))
    found = [Task(TaskId("simulate"), "simulate", (), caches, parameters["simulate"], checkpointed=True)]
    for frame in range(frames):
        surface, picture = JobLayout.surface("water", frame), JobLayout.picture(frame)
        number = f"{frame:06d}"
        found.append(
            Task(
                TaskId(f"surface/{number}"), "surface", (caches[frame],), (surface,), parameters["surface"], frame=frame
            )
        )
        found.append(
            Task(TaskId(f"render/{number}"), "render", (surface,), (picture,), parameters["render"], frame=frame)
        )
    return found


def build(layout: JobLayout, tasks: list[Task], share: float, *, runs: bool) -> None:
    """The record of a job of which this share is done, with attempts and artifacts."""
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(f'name = "{layout.root.name}"\n')
    done = tasks[: round(len(tasks) * share)]
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run(layout.root.name, run="benchmark")
        manifest.record_plan(tasks)
        with manifest.transaction():
            manifest.record_artifacts(_receipt(task, output) for task in done for output in task.outputs)
            for index, task in enumerate(done):
                number = manifest.start_attempt(task.id)
                failure = FailureKind.TIMED_OUT if index % 500 == 499 else None
                state = TaskState.SUCCEEDED if failure is None else TaskState.FAILED
                message = "" if failure is None else "it took longer than 600 s"
                manifest.finish_attempt(
                    task.id, number, failure=failure, message=message, seconds=1.0 + index % 7, state=state
                )
            if runs:
                for task in tasks[len(done) : len(done) + 8]:
                    manifest.start_attempt(task.id)
        for index in range(200):
            manifest.log_event("note", f"a note, the {index}th")
        if not runs:
            manifest.end_run(JobOutcome.SUCCEEDED if share == 1.0 else JobOutcome.FAILED)


def _receipt(task: Task, output: str) -> Receipt:
    return Receipt(
        artifact=output,  # type: ignore[arg-type]
        task=task.id,
        stage=task.stage,
        attempt=1,
        fingerprint="f" * 64,
        parameters=task.parameters.digest,
        size=1 << 20,
        mtime_ns=time.time_ns(),
        hash="0" * 64,
        inputs=dict.fromkeys(task.inputs, "0" * 64),
    )
