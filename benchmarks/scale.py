"""What the farm costs a task, from a thousand tasks to a hundred thousand.

    python -m benchmarks.scale [--tasks 1000 10000 100000] [--dispatched 300] [--plot docs/performance-scale.svg]

Prints JSON. The job has one no-op stage, a task and a small file a frame. Each size is measured in a process of
its own, whose largest resident memory is the runner's:

    plan            tasks planned and held against an empty record
    nothing to do   a whole run of a finished job: record, files, plan, nothing to start
    submit          the command `pipeline submit` on a finished job, from its start to its end
    status          the query behind `pipeline status`, and the command
    dispatch        tasks run again in the finished job, through the real runner and a worker process

Times are [wall, processor] seconds, dispatch in milliseconds a task; the least of the repeats, since a busy machine
only adds to it. `bare commit` is a commit (write, decode, hash, three syncs, receipt) in a loop on the same disk: it is
work that a task does itself, so that dispatch costs what is left. Promised for 100,000 tasks: plan 2 s, nothing to do
5 s, status 50 ms, dispatch 5 ms a task, memory 500 MB.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.compare import HERE, arguments_of, child, run, timed
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
from pipeline.run.plan import assess, plan_job
from pipeline.run.runner import run_job
from pipeline.store import artifacts
from pipeline.store.receipts import Receipt, hash_file

if TYPE_CHECKING:
    from pipeline.stages.base import TaskContext

SIZES = (1_000, 10_000, 100_000)

JOB = 'name = "dispatch"\nframes = {frames}\n'
PARAMETERS = ParameterSet.of(stage="noop", version=1, tools={})


def accept(path: Path) -> None:
    path.read_bytes()


class NoopStage:
    """Commits one byte a frame."""

    name = "noop"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:  # noqa: ARG002 - the protocol's signature
        return [_task("noop", frame) for frame in range(job.frame_count)]

    def run(self, context: TaskContext) -> None:
        with context.committing(context.task.outputs[0], accept) as path:
            path.write_bytes(b"x")


STAGES = (NoopStage(),)
STAGES_REFERENCE = "benchmarks.scale:STAGES"


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


def _task(stage: str, frame: int) -> Task:
    return Task(
        id=TaskId(f"{stage}/{frame:06d}"),
        stage=stage,
        inputs=(),
        outputs=(ArtifactPath(f"{stage}/{frame:06d}.bin"),),
        parameters=PARAMETERS,
        frame=frame,
    )


def run_noops(
    root: Path, tasks: int, executor: Executor, clock: CommitClock, *, rerun: Selection | None = None
) -> None:
    """Run the job of so many tasks, or some of them again."""
    outcome = run_job(
        Job(name="dispatch", frames=tasks),
        JobLayout(root),
        executor=executor,
        job_text=JOB.format(frames=tasks),
        stages=STAGES_REFERENCE,
        observers=[clock.notify],
        rerun=rerun,
        capacity=Resources(cores=1),
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
    root.mkdir()
    began = time.perf_counter()
    for frame in range(count):
        task = _task("bare", frame)
        output = task.outputs[0]
        with artifacts.committing(layout, output, task=task, attempt=1, fingerprint="", validate=accept) as commit:
            commit.path.write_bytes(b"x")
    return (time.perf_counter() - began) / count * 1e3


def measure(folder: Path, tasks: int, dispatched: int, repeats: int) -> dict[str, Any]:
    """All figures of one size; call it in a fresh process."""
    job = Job(name="dispatch", frames=tasks)
    layout = JobLayout(folder / "renders" / job.name)

    def plan() -> None:
        assess(plan_job(job, layout, STAGES), {}, {}, parameters=lambda _: None)

    figures: dict[str, Any] = {"tasks": tasks, "plan": fastest(repeats, plan)}
    idle = [nothing_to_do_s(layout.root, tasks)]
    again = partial(run_noops, layout.root, tasks, InlineExecutor(), CommitClock())
    idle += [timed(again) for _ in range(repeats - 1)]
    figures["nothing to do"] = least(idle)
    figures["status"] = fastest(5 * repeats, lambda: status(layout))
    (folder / "dispatch.toml").write_text(JOB.format(frames=tasks))
    layout.job_file.write_text(JOB.format(frames=tasks))
    for name, arguments in (("submit", ("submit", "dispatch.toml")), ("status command", ("status", job.name))):
        figures[name] = least(_command(folder, arguments) for _ in range(repeats))
    clock = CommitClock()
    with ProcessExecutor(WorkerLimits(tasks_per_worker=dispatched + 1)) as executor:
        chosen = Selection(frames=frozenset(range(dispatched)))
        run_noops(layout.root, tasks, executor, clock, rerun=chosen)
    figures["dispatch [ms]"] = [round(each, 3) for each in clock.task_ms()]
    figures["bare commit [ms]"] = round(bare_commit_ms(folder / "bare", dispatched), 3)
    figures["memory [MB]"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, 1)
    return figures


def fastest(repeats: int, work: Callable[[], object]) -> list[float]:
    """Least wall time and least processor time of several calls [s]."""
    gc.collect()
    return least(timed(work) for _ in range(repeats))


def least(times: Iterable[tuple[float, float]]) -> list[float]:
    """Of wall and processor times the least of each [s]."""
    return [round(min(column), 6) for column in zip(*times, strict=True)]


def status(layout: JobLayout) -> None:
    """The query behind `pipeline status`."""
    with Manifest.open_readonly(layout.manifest) as reader:
        reader.summary()


def _command(folder: Path, arguments: tuple[str, ...]) -> tuple[float, float]:
    """Wall and processor time [s] of a command of the command line, over the no-op stage."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "PYTHONPATH": str(HERE)}
    module = ("benchmarks.scale", "--command") if arguments[0] == "submit" else ("pipeline",)
    command = [sys.executable, "-m", *module, *arguments]
    wall, _ = timed(lambda: subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run_command(arguments: list[str]) -> None:
    """The command line over the no-op stage, of which nothing has to run; does not return."""
    import pipeline.stages
    from pipeline.cli.main import main as command_line

    pipeline.stages.STAGES = STAGES
    command_line(arguments)


def plot(results: list[dict[str, Any]], path: Path) -> None:
    """Cost a task against the number of tasks, as SVG; flat lines are what is promised."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    mpl.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "scale"})
    figure = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = figure.subplots()
    tasks = [each["tasks"] for each in results]
    for name in ("plan", "nothing to do", "submit"):
        axes.plot(tasks, [1e6 * each[name][1] / each["tasks"] for each in results], "o-", label=f"{name} [µs a task]")
    axes.plot(tasks, [1e3 * each["dispatch [ms]"][1] for each in results], "s-", label="dispatch [µs a task that runs]")
    axes.set(xscale="log", yscale="log", xlabel="tasks of the job", ylabel="processor time a task [µs]")
    axes.grid(visible=True, which="major", alpha=0.3)
    figure.legend(fontsize="small", ncols=2, loc="outside upper center")
    figure.savefig(path, metadata={"Date": None})


def main() -> Any:
    parser = arguments_of(__doc__)
    parser.add_argument("--tasks", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--dispatched", type=int, default=300, help="how many tasks are run again")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--plot", type=Path, help="write the plot here")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        [tasks] = options.tasks
        return measure(options.measure, tasks, min(options.dispatched, tasks), options.repeats)
    results = []
    for tasks in options.tasks:
        with tempfile.TemporaryDirectory() as folder:
            command = ["-m", "benchmarks.scale", "--measure", folder, "--tasks", str(tasks)]
            command += ["--dispatched", str(options.dispatched), "--repeats", str(options.repeats)]
            results.append(child(command))
            print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    if options.plot is not None:
        plot(results, options.plot)
    return results


if __name__ == "__main__":
    if sys.argv[1:2] == ["--command"]:
        run_command(sys.argv[2:])
    run(main)
