"""What the record costs: `python -m benchmarks.manifest [--frames N] [--repeats N]`. Prints JSON.

A film of N frames has 3 N + 2 tasks: simulate, one surface, picture and thumbnail a frame, and the film itself. Each
entry is [wall, processor] time in seconds, or in milliseconds where it says so; each the least of the repeats, since
a busy machine only ever adds to it.

Promised are, for 100,000 tasks: planning and assessing under 2 s, a start with nothing to do under 5 s, a status under
50 ms; and for a job of 200 artifacts a start with nothing to do under 50 ms.
"""

from __future__ import annotations

import argparse
import gc
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.artifacts import committing
from pipeline.fingerprint import task_fingerprint
from pipeline.layout import JobLayout
from pipeline.manifest import Manifest
from pipeline.parameter_set import ParameterSet
from pipeline.plan import Assessment, Verdict, assess, in_order, summarize
from pipeline.receipts import Receipt
from pipeline.reconcile import reconcile
from pipeline.task import ArtifactPath, Task, TaskId, TaskState


def film(frames: int, lens: float = 50.0) -> list[Task]:
    """simulate -> surfaces -> pictures -> thumbnails; pictures -> film."""
    parameters = {
        stage: ParameterSet.of(stage=stage, version=1, tools={"tool": "1.0"}, camera={"lens": lens})
        for stage in ("surface", "render", "thumbnail", "movie")
    }
    parameters["simulate"] = ParameterSet.of(stage="simulate", version=1, tools={}, fluid=[{"name": "water"}])
    tasks = [
        Task(
            TaskId("simulate"),
            "simulate",
            (),
            tuple(JobLayout.frame_cache(k) for k in range(frames)),
            parameters["simulate"],
            checkpointed=True,
        )
    ]
    chain: list[tuple[str, Callable[[int], ArtifactPath], Callable[[int], ArtifactPath]]] = [
        ("surface", JobLayout.frame_cache, lambda k: JobLayout.surface("water", k)),
        ("render", lambda k: JobLayout.surface("water", k), JobLayout.picture),
        ("thumbnail", JobLayout.picture, lambda k: ArtifactPath(f"thumbnails/{k:06d}.png")),
    ]
    for stage, source, product in chain:
        tasks += [
            Task(TaskId(f"{stage}/{k:06d}"), stage, (source(k),), (product(k),), parameters[stage], frame=k)
            for k in range(frames)
        ]
    pictures = tuple(JobLayout.picture(k) for k in range(frames))
    return [*tasks, Task(TaskId("film"), "movie", pictures, (JobLayout.movie(),), parameters["movie"])]


def write_film(layout: JobLayout, tasks: list[Task]) -> list[Receipt]:
    """Files and receipts as if every task had run; written plainly, for committing is measured by itself."""
    receipts: dict[ArtifactPath, Receipt] = {}
    for task in tasks:
        inputs = {path: receipts[path].hash for path in task.inputs}
        fingerprint = task_fingerprint(task, inputs)
        for output in task.outputs:
            path = layout.path(output)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(output)
            status = path.stat()
            receipt = Receipt(
                artifact=output,
                task=task.id,
                stage=task.stage,
                attempt=1,
                fingerprint=fingerprint,
                parameters=task.parameters.digest,
                size=status.st_size,
                mtime_ns=status.st_mtime_ns,
                hash=ParameterSet(output).digest,  # of the text that is in it
                inputs=inputs,
            )
            layout.receipt(output).parent.mkdir(parents=True, exist_ok=True)
            layout.receipt(output).write_text(receipt.to_json())
            receipts[output] = receipt
    return [*receipts.values()]


def fastest(repeats: int, work: Callable[[], object]) -> list[float]:
    """Least wall time and least processor time of several calls [s]."""
    times = []
    for _ in range(repeats):
        gc.collect()
        began, began_cpu = time.perf_counter(), time.process_time()
        work()
        times.append((time.perf_counter() - began, time.process_time() - began_cpu))
    return [round(min(column), 6) for column in zip(*times, strict=True)]


def start_with_nothing_to_do(layout: JobLayout, frames: int) -> list[Assessment]:
    """What a submit of a finished job does: open, reconcile, plan, assess, record the plan, close."""
    with Manifest(layout.manifest) as manifest:
        found = reconcile(manifest, layout, clean=manifest.begin_run("film"))
        tasks = in_order(film(frames))
        assessments = assess(tasks, found.rows, found.problems, parameters=manifest.parameters)
        manifest.record_plan(tasks, {task.id: TaskState.UP_TO_DATE for task in tasks})
        manifest.end_run()
    assert all(assessment.verdict is Verdict.UP_TO_DATE for assessment in assessments)
    return assessments


def measure_job(folder: Path, frames: int, repeats: int) -> dict[str, object]:
    """A film of that many frames, from its first plan to a start with nothing to do."""
    layout = JobLayout(folder)
    folder.mkdir()
    tasks = film(frames)
    receipts = write_film(layout, tasks)
    changed = film(frames, lens=35.0)

    def plan() -> None:
        assess(in_order(film(frames)), {}, {}, parameters=lambda _: None)

    with Manifest(layout.manifest) as manifest:
        results: dict[str, object] = {
            "tasks": len(tasks),
            "artifacts": len(receipts),
            "plan and assess, nothing made": fastest(repeats, plan),
            "record_plan, first": fastest(1, lambda: manifest.record_plan(tasks)),
            "record_artifacts, all at once": fastest(1, lambda: manifest.record_artifacts(receipts)),
            "rows": fastest(repeats, manifest.artifacts),
            "status: open_readonly and summary": fastest(repeats, lambda: status(layout)),
        }
        rows = manifest.artifacts()
        results["assess, all up to date"] = fastest(
            repeats, lambda: assess(tasks, rows, {}, parameters=manifest.parameters)
        )
        results["assess and summarize, camera changed"] = fastest(
            repeats, lambda: summarize(assess(changed, rows, {}, parameters=manifest.parameters))
        )
        manifest.begin_run("film")
        manifest.end_run()
    results["nothing to do"] = fastest(repeats, lambda: start_with_nothing_to_do(layout, frames))
    layout.manifest.unlink()
    results["rebuild from receipts"] = fastest(1, lambda: start_with_nothing_to_do(layout, frames))
    return results


def status(layout: JobLayout) -> None:
    with Manifest.open_readonly(layout.manifest) as reader:
        reader.summary()


def measure_steps(folder: Path, repeats: int) -> dict[str, list[float]]:
    """Single steps of a running job [ms]."""
    layout = JobLayout(folder)
    folder.mkdir()
    tasks = film(1000)
    simulate = tasks[0]
    fingerprint = task_fingerprint(simulate, {})

    def commit(artifact: ArtifactPath, content: bytes) -> Receipt:
        handle = committing(
            layout, artifact, task=simulate, attempt=1, fingerprint=fingerprint, validate=lambda _: None
        )
        with handle:
            handle.path.write_bytes(content)
        return handle.receipt

    kilobyte, megabytes = bytes(1 << 10), bytes(16 << 20)
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(tasks)
        receipt = commit(simulate.outputs[0], kilobyte)

        def attempt() -> None:
            number = manifest.start_attempt(simulate.id)
            manifest.record_artifact(receipt)
            manifest.finish_attempt(simulate.id, number, seconds=1.0, state=TaskState.SUCCEEDED)

        steps = {
            "commit 1 KiB": lambda: commit(simulate.outputs[0], kilobyte),
            "commit 16 MiB": lambda: commit(simulate.outputs[1], megabytes),
            "attempt: start, artifact, finish": attempt,
            "set_states of one": lambda: manifest.set_states({simulate.id: TaskState.RUNNING}),
            "log_event": lambda: manifest.log_event("note", "text"),
        }
        return {
            f"{name} [ms]": [round(1000 * least, 3) for least in fastest(20 * repeats, step)]
            for name, step in steps.items()
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=33_333)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        results = {
            "steps": measure_steps(Path(folder, "steps"), arguments.repeats),
            "small job": measure_job(Path(folder, "small"), 50, 5 * arguments.repeats),
            "large job": measure_job(Path(folder, "large"), arguments.frames, arguments.repeats),
        }
        print(json.dumps(results, indent=1), flush=True)  # before a quarter of a million files are removed


if __name__ == "__main__":
    main()
