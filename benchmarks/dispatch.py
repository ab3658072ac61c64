"""What running a task costs besides its own work: dispatch through the real runner, manifest and workers.

Runs a job of no-op tasks and reports the overhead a task, and what the scheduler alone takes for 100,000 tasks:

    python -m benchmarks.dispatch [--tasks 400] [--repeats 3] [--finished-tasks 10000] [--executor processes|inline]

Prints JSON. Each task commits one small file (write, decode, hash, three fsyncs, receipt) and is an attempt on record;
`bare_commit_ms` is that commit by itself, in a loop, on the same disk. Times are medians over the repeats; they scatter
with what else the machine and its disk do.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline import artifacts
from pipeline.executors.base import Committed, Executor
from pipeline.executors.inline import InlineExecutor
from pipeline.executors.processes import ProcessExecutor, WorkerLimits
from pipeline.fingerprint import task_fingerprint
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.manifest import Manifest
from pipeline.parameter_set import ParameterSet
from pipeline.receipts import Receipt, hash_file
from pipeline.run_events import RunEvent
from pipeline.runner import run_job
from pipeline.scheduler import Scheduler
from pipeline.scheduler_events import ArtifactCommitted, Finish, Instruction, JobOutcome, Start, TaskSucceeded
from pipeline.task import ArtifactPath, Resources, Task, TaskId, TaskState

if TYPE_CHECKING:
    from pipeline.stages.base import TaskContext

JOB = 'name = "dispatch"\nframes = {frames}\n'
PARAMETERS = ParameterSet.of(stage="noop", version=1, tools={})
SCHEDULED_TASKS = 100_000


def accept(path: Path) -> None:
    path.read_bytes()


class NoopStage:
    """Commits one byte a frame."""

    name = "noop"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:  # noqa: ARG002 - the protocol's signature
        return [_task("noop", frame, ()) for frame in range(job.frame_count)]

    def run(self, context: TaskContext) -> None:
        with context.committing(context.task.outputs[0], accept) as path:
            path.write_bytes(b"x")


STAGES = (NoopStage(),)


class CommitClock:
    """Notes when each commit reaches the runner."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.processor_times: list[float] = []

    def notify(self, event: RunEvent) -> None:
        if isinstance(event, Committed):
            self.times.append(time.perf_counter())
            self.processor_times.append(time.process_time())


def _task(stage: str, frame: int, inputs: tuple[ArtifactPath, ...]) -> Task:
    return Task(
        id=TaskId(f"{stage}/{frame:06d}"),
        stage=stage,
        inputs=inputs,
        outputs=(ArtifactPath(f"{stage}/{frame:06d}.bin"),),
        parameters=PARAMETERS,
        frame=frame,
    )


def run(root: Path, tasks: int, workers: int, executor: Executor, clock: CommitClock) -> None:
    outcome = run_job(
        Job(name="dispatch", frames=tasks),
        JobLayout(root),
        executor=executor,
        job_text=JOB.format(frames=tasks),
        stages="benchmarks.dispatch:STAGES",
        observer=clock,
        capacity=Resources(cores=workers),
    )
    assert outcome.kind is JobOutcome.SUCCEEDED


def dispatch_ms(root: Path, tasks: int, workers: int, executor: Executor) -> tuple[float, float]:
    """Wall time a task, from the first commit to the last [ms], and processor time of the runner a task [ms].

    Neither has the start of the workers in it.
    """
    clock = CommitClock()
    run(root, tasks, workers, executor, clock)
    count = len(clock.times) - 1
    wall = clock.times[-1] - clock.times[0]
    return wall / count * 1e3, (clock.processor_times[-1] - clock.processor_times[0]) / count * 1e3


def nothing_to_do_s(root: Path, tasks: int) -> tuple[float, float]:
    """Wall and processor time of a whole run over a finished job [s]; its files are made up, and put on record."""
    layout = JobLayout(root)
    (root / NoopStage.name).mkdir(parents=True)
    plan = NoopStage().plan(Job(name="dispatch", frames=tasks), layout)
    receipts = []
    for task in plan:
        path = layout.path(task.outputs[0])
        path.write_bytes(b"x")
        status = path.stat()
        receipts.append(
            Receipt(
                artifact=task.outputs[0],
                task=task.id,
                stage=task.stage,
                attempt=1,
                fingerprint=task_fingerprint(task, {}),
                parameters=task.parameters.digest,
                size=status.st_size,
                mtime_ns=status.st_mtime_ns,
                hash=hash_file(path),
            )
        )
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("dispatch")
        manifest.record_plan(plan, {task.id: TaskState.SUCCEEDED for task in plan})
        manifest.record_artifacts(receipts)
        manifest.end_run()
    run(root, tasks, 1, InlineExecutor(), CommitClock())  # the first one takes the states over as "up to date"
    began = time.perf_counter(), time.process_time()
    run(root, tasks, 1, InlineExecutor(), CommitClock())
    return time.perf_counter() - began[0], time.process_time() - began[1]


def bare_commit_ms(root: Path, count: int) -> float:
    """Wall time of one commit in a loop without anything else [ms]."""
    layout = JobLayout(root)
    began = time.perf_counter()
    for frame in range(count):
        task = _task("bare", frame, ())
        commit = artifacts.committing(layout, task.outputs[0], task=task, attempt=1, fingerprint="", validate=accept)
        with commit:
            commit.path.write_bytes(b"x")
    return (time.perf_counter() - began) / count * 1e3


def scheduler_us() -> tuple[float, float]:
    """Processor time to set a scheduler up for 100,000 tasks [s], and a task to run through them [µs]."""
    frames = SCHEDULED_TASKS // 3
    tasks: list[Task] = []
    for frame in range(frames):
        inputs: tuple[ArtifactPath, ...] = ()
        for stage in ("simulate", "surface", "render"):
            tasks.append(_task(stage, frame, inputs))
            inputs = tasks[-1].outputs
    began = time.process_time()
    scheduler = Scheduler(tasks, capacity=Resources(cores=16))
    set_up = time.process_time()
    todo: list[Instruction] = scheduler.start()
    for instruction in todo:  # grows while it is walked through
        if isinstance(instruction, Start):
            task = instruction.task
            todo += scheduler.handle(ArtifactCommitted(task.id, task.outputs[0]))
            todo += scheduler.handle(TaskSucceeded(task.id))
    ended = time.process_time()
    assert isinstance(todo[-1], Finish)
    return set_up - began, (ended - set_up) / len(tasks) * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, default=400)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--finished-tasks", type=int, default=10_000)
    parser.add_argument("--executor", choices=("processes", "inline"), default="processes")
    options = parser.parse_args()
    fresh, runner, bare = [], [], []
    for _ in range(options.repeats):
        executor = (
            InlineExecutor()
            if options.executor == "inline"
            else ProcessExecutor(WorkerLimits(tasks_per_worker=options.tasks + 1))
        )
        with tempfile.TemporaryDirectory() as folder, executor:
            fresh_ms, runner_ms = dispatch_ms(Path(folder, "job"), options.tasks, options.workers, executor)
            fresh.append(fresh_ms)
            runner.append(runner_ms)
            bare.append(bare_commit_ms(Path(folder, "bare"), options.tasks))
    set_up_s, scheduled_us = scheduler_us()
    with tempfile.TemporaryDirectory() as folder:
        idle_s, idle_processor_s = nothing_to_do_s(Path(folder, "job"), options.finished_tasks)
    print(
        json.dumps(
            {
                "tasks": options.tasks,
                "executor": options.executor,
                "workers": options.workers,
                "task_ms": round(statistics.median(fresh), 3),
                "bare_commit_ms": round(statistics.median(bare), 3),
                "overhead_ms": round(statistics.median(fresh) - statistics.median(bare), 3),
                "runner_processor_ms": round(statistics.median(runner), 3),
                "finished_tasks": options.finished_tasks,
                "nothing_to_do_s": round(idle_s, 3),
                "nothing_to_do_processor_s": round(idle_processor_s, 3),
                "scheduler_set_up_s_for_100000": round(set_up_s, 3),
                "scheduler_us_a_task": round(scheduled_us, 2),
            },
            indent=1,
        )
    )


if __name__ == "__main__":
    main()
