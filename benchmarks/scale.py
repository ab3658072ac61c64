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
import gc
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import dispatch
from benchmarks.compare import HERE, arguments_of, child, run, timed
from pipeline.base.layout import JobLayout
from pipeline.model.job import Job
from pipeline.record.manifest import Manifest
from pipeline.run.control import Selection
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor, WorkerLimits
from pipeline.run.plan import assess, plan_job

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
    again = partial(dispatch.run_noops, layout.root, tasks, InlineExecutor(), dispatch.CommitClock())
    idle += [timed(again) for _ in range(repeats - 1)]
    figures["nothing to do"] = [round(min(column), 3) for column in zip(*idle, strict=True)]
    figures["status"] = fastest(5 * repeats, lambda: status(layout))
    (folder / "dispatch.toml").write_text(dispatch.JOB.format(frames=tasks))
    layout.job_file.write_text(dispatch.JOB.format(frames=tasks))
    for name, arguments in (("submit", ("submit", "dispatch.toml")), ("status command", ("status", job.name))):
        figures[name] = [round(seconds, 3) for seconds in _command(folder, arguments)]
    clock = dispatch.CommitClock()
    with ProcessExecutor(WorkerLimits(tasks_per_worker=dispatched + 1)) as executor:
        chosen = Selection(frames=frozenset(range(dispatched)))
        dispatch.run_noops(layout.root, tasks, executor, clock, rerun=chosen)
    figures["dispatch [ms]"] = [round(each, 3) for each in clock.task_ms()]
    figures["bare commit [ms]"] = round(dispatch.bare_commit_ms(folder / "bare", dispatched), 3)
    figures["memory [MB]"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6, 1)
    return figures


def fastest(repeats: int, work: Callable[[], object]) -> list[float]:
    """Least wall time and least processor time of several calls [s]."""
    gc.collect()
    return [round(min(column), 6) for column in zip(*(timed(work) for _ in range(repeats)), strict=True)]


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
    """The command line over the no-op stage; does not return."""
    import pipeline.queue.turns
    import pipeline.stages
    from pipeline.cli.main import main as command_line

    pipeline.stages.STAGES = dispatch.STAGES  # type: ignore[assignment]
    pipeline.queue.turns.STAGES_REFERENCE = STAGES
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
