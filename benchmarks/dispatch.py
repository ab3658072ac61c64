"""What running a task costs besides its own work: dispatch through the real runner, manifest and workers.

Runs a job of no-op tasks and reports the overhead a task, and what a run over a finished job takes:

    python -m benchmarks.dispatch [--tasks 400] [--repeats 3] [--finished-tasks 10000] [--executor processes|inline]

Prints JSON. Each task commits one small file (write, decode, hash, three fsyncs, receipt) and is an attempt on record;
`bare_commit_ms` is that commit by itself, in a loop, on the same disk. Times are medians over the repeats; they scatter
with what else the machine and its disk do.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.compare import arguments_of, run, timed
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId, TaskState, task_fingerprint
from pipeline.model.job import Job
from pipeline.record.manifest import Manifest
from pipeline.run.control import Selection
from pipeline.run.events import JobOutcome
from pipeline.run.executors.base import Executor
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor, WorkerLimits
from pipeline.run.runner import run_job
from pipeline.store import artifacts
from pipeline.store.receipts import Receipt, hash_file

if TYPE_CHECKING:
    from pipeline.stages.base import TaskContext

JOB = 'name = "dispatch"\nframes = {frames}\n'
PARAMETERS = ParameterSet.of(stage="noop", version=1, tools={})


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

    def task_ms(self) -> tuple[float, float]:
        """Wall time and the runner's processor time a task, from the first commit to the last [ms].

        Neither has the start of the workers in it.
        """
        both = (self.times, self.processor_times)
        wall, processor = (1e3 * (each[-1] - each[0]) / (len(each) - 1) for each in both)
        return wall, processor

    def notify(self, event: Any) -> None:
        if hasattr(event, "receipt"):
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


def run_noops(
    root: Path, tasks: int, executor: Executor, clock: CommitClock, *, workers: int = 1, rerun: Selection | None = None
) -> None:
    """Run the job of so many tasks, or some of them again."""
    outcome = run_job(
        Job(name="dispatch", frames=tasks),
        JobLayout(root),
        executor=executor,
        job_text=JOB.format(frames=tasks),
        stages="benchmarks.dispatch:STAGES",
        observers=[clock.notify],
        rerun=rerun,
        capacity=Resources(cores=workers),
    )
    assert outcome.kind is JobOutcome.SUCCEEDED


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
    run_noops(root, tasks, InlineExecutor(), CommitClock())  # the first one takes the states over as "up to date"
    return timed(lambda: run_noops(root, tasks, InlineExecutor(), CommitClock()))


def bare_commit_ms(root: Path, count: int) -> float:
    """Wall time of one commit in a loop without anything else [ms]."""
    layout = JobLayout(root)
    began = time.perf_counter()
    for frame in range(count):
        task = _task("bare", frame, ())
        output = task.outputs[0]
        with artifacts.committing(layout, output, task=task, attempt=1, fingerprint="", validate=accept) as commit:
            commit.path.write_bytes(b"x")
    return (time.perf_counter() - began) / count * 1e3


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--tasks", type=int, default=400)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--finished-tasks", type=int, default=10_000)
    parser.add_argument("--executor", choices=("processes", "inline"), default="processes")
    options = parser.parse_args()
    fresh, bare = [], []
    for _ in range(options.repeats):
        processes = ProcessExecutor(WorkerLimits(tasks_per_worker=options.tasks + 1))
        executor = InlineExecutor() if options.executor == "inline" else processes
        clock = CommitClock()
        with tempfile.TemporaryDirectory() as folder, executor:
            run_noops(Path(folder, "job"), options.tasks, executor, clock, workers=options.workers)
            fresh.append(clock.task_ms())
            bare.append(bare_commit_ms(Path(folder, "bare"), options.tasks))
    with tempfile.TemporaryDirectory() as folder:
        idle_s, idle_processor_s = nothing_to_do_s(Path(folder, "job"), options.finished_tasks)
    task_ms, runner_ms = (statistics.median(column) for column in zip(*fresh, strict=True))
    return {
        "tasks": options.tasks,
        "executor": options.executor,
        "workers": options.workers,
        "task_ms": round(task_ms, 3),
        "bare_commit_ms": round(statistics.median(bare), 3),
        "overhead_ms": round(task_ms - statistics.median(bare), 3),
        "runner_processor_ms": round(runner_ms, 3),
        "finished_tasks": options.finished_tasks,
        "nothing_to_do_s": round(idle_s, 3),
        "nothing_to_do_processor_s": round(idle_processor_s, 3),
    }


if __name__ == "__main__":
    run(main)
