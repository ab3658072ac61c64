"""What the farm costs a task, from a thousand tasks to a hundred thousand.

    python -m benchmarks.scale [--tasks 1000 10000 100000] [--dispatched 300] [--plot docs/performance-scale.svg]

Prints JSON. The job has one no-op stage, a task and a small file a frame (`benchmarks.dispatch`). Each size is measured
in a process of its own, whose largest resident memory is the runner's:

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
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks import dispatch
from benchmarks.manifest import fastest, status
from pipeline.executors.inline import InlineExecutor
from pipeline.executors.processes import ProcessExecutor, WorkerLimits
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.plan import assess, plan_job
from pipeline.run_control import Selection
from pipeline.runner import run_job
from pipeline.task import Resources

SIZES = (1_000, 10_000, 100_000)
STAGES = "benchmarks.dispatch:STAGES"


def measure(folder: Path, tasks: int, dispatched: int, repeats: int) -> dict[str, Any]:
    """All figures of one size; call it in a fresh process."""
    job = Job(name="dispatch", frames=tasks)
    layout = JobLayout(folder / "renders" / job.name)

    def plan() -> None:
        assess(plan_job(job, layout, dispatch.STAGES), {}, {}, parameters=lambda _: None)

    figures: dict[str, Any] = {"tasks": tasks, "plan": fastest(repeats, plan)}
    idle = [dispatch.nothing_to_do_s(layout.root, tasks)]
    idle += [_timed(lambda: _run(job, layout, InlineExecutor(), dispatch.CommitClock())) for _ in range(repeats - 1)]
    figures["nothing to do"] = [round(min(column), 3) for column in zip(*idle, strict=True)]
    figures["status"] = fastest(5 * repeats, lambda: status(layout))
    (folder / "dispatch.toml").write_text(dispatch.JOB.format(frames=tasks))
    layout.job_file.write_text(dispatch.JOB.format(frames=tasks))
    for name, arguments in (("submit", ("submit", "dispatch.toml")), ("status command", ("status", job.name))):
        figures[name] = [round(min(column), 3) for column in zip(*(_command(folder, arguments),), strict=True)]
    clock = dispatch.CommitClock()
    with ProcessExecutor(WorkerLimits(tasks_per_worker=dispatched + 1)) as executor:
        _run(job, layout, executor, clock, Selection(frames=frozenset(range(dispatched))))
    count = len(clock.times) - 1
    figures["dispatch [ms]"] = [
        round(1e3 * (times[-1] - times[0]) / count, 3) for times in (clock.times, clock.processor_times)
    ]
    figures["bare commit [ms]"] = round(dispatch.bare_commit_ms(folder / "bare", dispatched), 3)
    figures["memory [MB]"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, 1)
    return figures


def _run(
    job: Job,
    layout: JobLayout,
    executor: InlineExecutor | ProcessExecutor,
    clock: dispatch.CommitClock,
    rerun: Selection | None = None,
) -> None:
    run_job(
        job,
        layout,
        executor=executor,
        job_text=dispatch.JOB.format(frames=job.frame_count),
        stages=STAGES,
        observer=clock,
        rerun=rerun,
        capacity=Resources(cores=1),
    )


def _timed(work: Callable[[], object]) -> tuple[float, float]:
    began = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - began[0], time.process_time() - began[1]


def _command(folder: Path, arguments: tuple[str, ...]) -> tuple[float, float]:
    """Wall and processor time [s] of a command of the command line, over the no-op stage."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.perf_counter()
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    module = ("benchmarks.scale", "--command") if arguments[0] == "submit" else ("pipeline",)
    command = [sys.executable, "-m", *module, *arguments]
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - began, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run_command(arguments: list[str]) -> None:
    """The command line over the no-op stage; does not return."""
    import pipeline.commands.turns
    import pipeline.stages
    from pipeline.cli import main as command_line

    pipeline.stages.STAGES = dispatch.STAGES  # type: ignore[assignment]
    pipeline.commands.turns.STAGES_REFERENCE = STAGES
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


def main() -> None:
    if sys.argv[1:2] == ["--command"]:
        run_command(sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", type=int, nargs="+", default=list(SIZES))
    parser.add_argument("--dispatched", type=int, default=300, help="how many tasks are run again")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--plot", type=Path, help="write the plot here")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        [tasks] = options.tasks
        print(json.dumps(measure(options.measure, tasks, min(options.dispatched, tasks), options.repeats)))
        return
    results = []
    for tasks in options.tasks:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "benchmarks.scale", "--measure", folder, "--tasks", str(tasks)]
            command += ["--dispatched", str(options.dispatched), "--repeats", str(options.repeats)]
            measured = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            results.append(json.loads(measured.stdout))
            print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    print(json.dumps(results, indent=1))
    if options.plot is not None:
        plot(results, options.plot)


if __name__ == "__main__":
    main()
