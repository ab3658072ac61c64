"""How long the dashboard's pages take with large jobs: `python -m benchmarks.dashboard`. Prints JSON.

A farm of 10 jobs of 10,000 tasks each, written through the record itself: three run, with attempts that are open, the
others are done, failed in part or not begun. The command `pipeline dashboard` serves it in a process of its own, and a
client asks it over a connection of its own each time, as a browser's first request does. Milliseconds from before the
connection to the first byte of the answer, and to its last; `first` is the first request of its kind, `median` and
`most` are of the repeats. The server's processor time, mean of the repeats, does not depend on what else runs. For
`changing` a runner writes to each running job before each request, so that nothing that is kept helps. Promised: 200 ms
for a whole page.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import psutil

from pipeline.layout import JobLayout
from pipeline.lease import Lease
from pipeline.manifest import Manifest
from pipeline.parameter_set import ParameterSet
from pipeline.receipts import Receipt
from pipeline.scheduler_events import JobOutcome
from pipeline.task import FailureKind, Task, TaskId, TaskState

ROOT = Path(__file__).resolve().parents[1]
STAGES = ("surface", "render")
RUNNING = 3
PAGES = {
    "jobs": "/",
    "jobs, what has changed": "/parts",
    "job": "/jobs/{running}",
    "job, what has changed": "/jobs/{running}/parts",
    "job, last page of tasks": "/jobs/{running}?page=200",
    "job, a task's story": "/jobs/{running}?task=render/000001",
    "job, tasks found by text": "/jobs/{running}?text=99&state=done",
    "job that is done": "/jobs/{done}",
}


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


class Client:
    """Asks a dashboard, in one session."""

    def __init__(self, address: str, server: int) -> None:
        self._place = urlsplit(address).netloc
        self._server = psutil.Process(server)
        self._cookie = ""

    def processor_s(self) -> float:
        """Processor time that the server has taken so far [s]."""
        times = self._server.cpu_times()
        return float(times.user + times.system)

    def ask(self, path: str) -> tuple[float, float, int]:
        """Milliseconds to the first byte and to the last, and how many bytes; of an answer that is all right."""
        began = time.perf_counter()
        connection = http.client.HTTPConnection(self._place, timeout=60)
        connection.request("GET", path, headers={"Cookie": self._cookie, "Accept-Encoding": "identity"})
        answer = connection.getresponse()
        first = answer.read(1)
        at_first = time.perf_counter()
        content = first + answer.read()
        at_last = time.perf_counter()
        assert answer.status == 200, f"{path}: {answer.status} {content[:200]!r}"
        self._cookie = self._cookie or (answer.getheader("set-cookie") or "").partition(";")[0]
        connection.close()
        return 1e3 * (at_first - began), 1e3 * (at_last - began), len(content)


def times_of(client: Client, path: str, repeats: int, before: Callable[[], None] = lambda: None) -> dict[str, object]:
    """What requests for one page take [ms]."""
    asked, spent_s = [], client.processor_s()
    for _ in range(repeats):
        before()
        asked.append(client.ask(path))
    spent_s = client.processor_s() - spent_s
    first, whole, sizes = zip(*asked, strict=True)
    return {
        "first": round(whole[0], 1),
        "first byte, median": round(statistics.median(first), 1),
        "whole, median": round(statistics.median(whole), 1),
        "whole, most": round(max(whole), 1),
        "processor time of the server, mean": round(1e3 * spent_s / repeats, 1),
        "bytes": sizes[-1],
    }


def measure(folder: Path, jobs: int, count: int, repeats: int) -> dict[str, object]:
    """Build the farm, serve it, and ask for each page."""
    farm, tasks = folder / "renders", plan(count)
    layouts = [JobLayout(farm / f"job-{index}") for index in range(jobs)]
    shares = [0.3 + 0.2 * index if index < RUNNING else (1.0, 0.0, 0.7)[index % 3] for index in range(jobs)]
    began = time.perf_counter()
    for index, (layout, share) in enumerate(zip(layouts, shares, strict=True)):
        build(layout, tasks, share, runs=index < RUNNING)
    built_s = time.perf_counter() - began
    command = [sys.executable, "-m", "pipeline", "dashboard", "--output", str(farm), "--port", "0"]
    with ExitStack() as open_now:
        manifests = []
        for layout in layouts[:RUNNING]:  # as runners hold them
            open_now.enter_context(Lease.acquire(layout.lease))
            manifests.append(open_now.enter_context(Manifest(layout.manifest)))
        began = time.perf_counter()
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
        )
        open_now.callback(server.wait)
        open_now.callback(server.terminate)
        assert server.stdout is not None
        client = Client(server.stdout.readline().strip(), server.pid)
        ready_s = time.perf_counter() - began

        def change() -> None:
            for manifest in manifests:
                manifest.log_event("note", "something happened")
            time.sleep(0.6)  # until the farm is looked at again

        done = next(layout.root.name for layout, share in zip(layouts, shares, strict=True) if share == 1.0)
        paths = {name: path.format(running=layouts[0].root.name, done=done) for name, path in PAGES.items()}
        pages: dict[str, object] = {name: times_of(client, path, repeats) for name, path in paths.items()}
        for name in ("jobs", "job"):
            pages[f"{name}, changing"] = times_of(client, paths[name], max(3, repeats // 3), change)
        memory = psutil.Process(server.pid).memory_info().rss
    return {
        "jobs": jobs,
        "tasks of each": len(tasks),
        "machine": f"{psutil.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "build [s]": round(built_s, 1),
        "start until the address is printed [s]": round(ready_s, 2),
        "memory of the server [MB]": round(memory / 1e6, 1),
        "pages [ms]": pages,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=10)
    parser.add_argument("--tasks", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--folder", type=Path, help="build the farm here, and leave it there")
    options = parser.parse_args()
    if options.folder is not None:
        print(json.dumps(measure(options.folder, options.jobs, options.tasks, options.repeats), indent=1))
        return
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(Path(folder), options.jobs, options.tasks, options.repeats), indent=1))


if __name__ == "__main__":
    main()
