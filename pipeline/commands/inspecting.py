"""Commands that only look: plan, status, logs, explain."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline import wording
from pipeline.commands.arguments import (
    find_job,
    job_options,
    json_option,
    output_option,
    print_warnings,
    require_own_programs,
    submission_folder,
    submitted_job_argument,
)
from pipeline.errors import JobFileError, PipelineError
from pipeline.layout import JobLayout
from pipeline.task import TaskId, TaskState

if TYPE_CHECKING:
    from pipeline.manifest_reader import AttemptRow, ManifestReader, StageSummary
    from pipeline.plan import Assessment

FOLLOW_INTERVAL_S = 0.5

_VERDICT_WORDING = {
    "up to date": "up to date",
    "stale": "would run",
    "downstream": "would run if its inputs turn out different",
}


@click.command()
@job_options
@output_option
@json_option
def plan(job_file: Path, overrides: tuple[str, ...], preview: bool, output: Path, as_json: bool) -> None:
    """Say what submitting a job would run, and why; runs nothing.

    \b
    pipeline plan jobs/quickstart.toml
    pipeline plan dam.toml --set 'camera.position=[0, -3, 1]'
    """
    from pipeline.assessing import assess_job
    from pipeline.job.checks import load_checked_job
    from pipeline.job.loading import read_job
    from pipeline.plan import Verdict, estimate, summarize

    require_own_programs(read_job(job_file, overrides, preview=preview), overrides)
    loaded, _ = load_checked_job(job_file, overrides, preview=preview)
    layout = submission_folder(job_file, loaded.job.name, output, is_changed=bool(overrides) or preview)
    assessments, estimates, _ = assess_job(loaded.job, layout)
    if as_json:
        click.echo(json.dumps([_assessment_as_json(each) for each in assessments], indent=1))
        return
    print_warnings(loaded.warnings)
    for line in summarize(assessments):
        click.echo(line)
    for each in estimate(assessments, estimates):
        if each.seconds is not None and each.bytes is not None:
            click.echo(f"{each.stage}: about {wording.duration(each.seconds)} of work, {wording.size(each.bytes)}")
    todo = sum(len(each.rebuilds) for each in assessments)
    at_most = "at most " if any(each.verdict is Verdict.DOWNSTREAM for each in assessments) else ""
    click.echo(f"{at_most}{todo} of {sum(len(each.task.outputs) for each in assessments)} files to make")


@click.command()
@submitted_job_argument
@json_option
def status(job: str, output: Path, as_json: bool) -> None:
    """Say how far a job is, whether it runs, what failed, and what the solvers tell.

    \b
    pipeline status quickstart
    pipeline status quickstart --json
    """
    from pipeline.lease import live_holder
    from pipeline.manifest_reader import ManifestReader
    from pipeline.solver_numbers import simulation_numbers

    layout = find_job(job, output)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        summary, failures, events = manifest.summary(), manifest.failures(), manifest.events(limit=5)
        drawn_on, is_empty = manifest.devices("render"), manifest.is_empty()
    holder = live_holder(layout.lease)
    numbers = simulation_numbers(layout)
    so_far = layout.film_so_far if layout.film_so_far.exists() else None
    if as_json:
        click.echo(
            json.dumps(
                {
                    "folder": str(layout.root),
                    "runner": None if holder is None else asdict(holder),
                    "stages": {stage.stage: dict(stage.counts) for stage in summary},
                    "failures": [_attempt_as_json(attempt) for attempt in failures],
                    "events": [event._asdict() for event in events],
                    "drawn_on": drawn_on,
                    "simulation": numbers.as_json(),
                    "film_so_far": None if so_far is None else str(so_far),
                },
                indent=1,
            )
        )
        return
    activity = _activity(holder.pid if holder else None, summary) or _activity_before_runs(layout, is_empty=is_empty)
    click.echo(f"{layout.root}: {activity}")
    for stage in summary:
        counts = ", ".join(
            f"{count} {'interrupted' if state is TaskState.RUNNING and holder is None else state}"
            for state, count in stage.counts.items()
        )
        click.echo(f"  {stage.stage:>9}  {counts}")
    if so_far is not None:
        click.echo(f"  the film so far: {so_far}")
    for line in numbers.lines():
        click.echo(f"  {line}")
    for sentence in [*numbers.warnings(), *wording.mixed_devices(drawn_on)]:
        click.secho(f"  warning: {sentence}", fg="yellow")
    for attempt in failures[:10]:
        click.secho(f"  {attempt.task} {attempt.outcome}: {attempt.message}", fg="red")
    if len(failures) > 10:
        click.echo(f"  ... and {len(failures) - 10} more")


@click.command()
@submitted_job_argument
@click.argument("task", required=False)
@click.option("--attempt", type=click.IntRange(min=1), help="Number of the attempt; the last one if omitted.")
@click.option("--follow", "-f", is_flag=True, help="Keep printing until the attempt ends.")
def logs(job: str, output: Path, task: str | None, attempt: int | None, follow: bool) -> None:
    """Print the log of a task.

    Without a task, list those that have a log.

    \b
    pipeline logs quickstart
    pipeline logs quickstart simulate --follow
    pipeline logs quickstart render/000012 --attempt 1
    """
    layout = find_job(job, output)
    folder = layout.root / "logs"
    if task is None:
        for path in sorted(folder.rglob("*.log")):
            name, _, number = path.relative_to(folder).as_posix().removesuffix(".log").rpartition(".")
            click.echo(f"{name}  attempt {number}  {path.stat().st_size:,} bytes")
        return
    attempts = _attempts_with_log(layout, TaskId(task))
    if not attempts:
        raise PipelineError(f'no log of a task "{task}" in {folder}; the tasks that have one: pipeline logs {job}')
    chosen = max(attempts) if attempt is None else attempt
    if chosen not in attempts:
        raise PipelineError(f"no log of attempt {chosen}; there are {', '.join(map(str, sorted(attempts)))}")
    with attempts[chosen].open("r", encoding="utf-8", errors="replace") as log:
        while True:
            ended = not follow or not _is_running(layout, TaskId(task), chosen)
            for text in iter(partial(log.read, 1 << 16), ""):
                click.echo(text, nl=False)
            if ended:
                return
            time.sleep(FOLLOW_INTERVAL_S)


@click.command()
@submitted_job_argument
@click.argument("task")
@json_option
def explain(job: str, output: Path, task: str, as_json: bool) -> None:
    """Tell the whole story of one task, or of one file.

    Its inputs, its outputs, every attempt, why it would run again, and what its files were made from: job file,
    parameters, versions and machine.

    \b
    pipeline explain quickstart render/000012
    pipeline explain quickstart frames/000012.png
    pipeline explain quickstart simulate --json
    """
    from pipeline.assessing import assess_job
    from pipeline.job.loading import load_job
    from pipeline.manifest_reader import ManifestReader
    from pipeline.origins import origins_of
    from pipeline.receipts import read_receipt, verify_artifact

    layout = find_job(job, output)
    assessments, _, _ = assess_job(load_job(layout.job_file), layout)
    found = next((each for each in assessments if each.task.id == task or task in each.task.outputs), None)
    if found is None:
        raise PipelineError(f'the job has no task "{task}"{_nearest(task, [each.task.id for each in assessments])}')
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        state, history = _state(manifest, found.task.id), manifest.history(found.task.id)
        events = manifest.events(task=found.task.id)
    receipts = [(output_path, read_receipt(layout, output_path)) for output_path in found.task.outputs]
    origins = [origin.as_json() for origin in origins_of(layout, [receipt for _, receipt in receipts if receipt])]
    if as_json:
        story = {
            **_assessment_as_json(found),
            "state": state,
            "parameters": json.loads(found.task.parameters.canonical),
            "inputs": list(found.task.inputs),
            "receipts": [json.loads(receipt.to_json()) for _, receipt in receipts if receipt is not None],
            "provenance": origins,
            "attempts": [_attempt_as_json(attempt) for attempt in history],
        }
        click.echo(json.dumps(story, indent=1))
        return
    states = dict.fromkeys([state or "not planned yet", _VERDICT_WORDING[found.verdict.value]])
    click.echo(f"{found.task.id}: {', '.join(states)}")
    for reason in found.reasons:
        click.echo(f"  {reason.text}")
    click.echo(f"reads   {_shortened(found.task.inputs) or 'the job file only'}")
    for path, receipt in receipts[:3]:
        if receipt is None:
            click.echo(f"makes   {path}: not there yet")
        else:
            flaw = verify_artifact(layout, receipt, deep=False)
            click.echo(
                f"makes   {path}: {wording.size(receipt.size)}, attempt {receipt.attempt}, {flaw or 'as committed'}"
            )
    if len(receipts) > 3:
        there = sum(receipt is not None for _, receipt in receipts)
        click.echo(f"        ... {there} of {len(receipts)} files are there")
    click.echo(f"key     {found.task.parameters.digest[:16]} (its parameters: pipeline explain ... --json)")
    for origin in origins_of(layout, [receipt for _, receipt in receipts if receipt is not None]):
        for line in origin.lines():
            click.echo(line)
    for attempt in history:
        click.echo(_attempt_line(attempt))
    for event in events:
        click.echo(f"  {wording.moment(event.time)}  {event.kind}: {event.message}")


def _state(manifest: ManifestReader, task: TaskId) -> TaskState | None:
    return manifest.states().get(task)


def _activity(pid: int | None, summary: Sequence[StageSummary]) -> str:
    """What happens to a job; "" of one without tasks, which never ran."""
    if pid is not None:
        return f"running, process {pid}"
    done = sum(
        count
        for stage in summary
        for state, count in stage.counts.items()
        if state in (TaskState.SUCCEEDED, TaskState.UP_TO_DATE)
    )
    total = sum(stage.total for stage in summary)
    if not total:
        return ""
    return "done" if done == total else f"not running, {done} of {total} tasks done"


def _activity_before_runs(layout: JobLayout, *, is_empty: bool) -> str:
    """How a job stands whose record has no tasks: a take, a new job, or one whose record was lost."""
    from pipeline.artifacts import holds_frames

    if layout.take_story.exists():
        return _activity_of_take(layout)
    is_new = is_empty and not holds_frames(layout)
    return "not started" if is_new else "not running; its record does not tell of tasks"


def _activity_of_take(layout: JobLayout) -> str:
    """What submitting a take would do."""
    from pipeline.crashed_take import frames_of_crashed_take, is_job_of_take

    film = f"submitting {layout.job_file} makes the film"
    try:
        if not is_job_of_take(layout):
            return f"a take, but {layout.job_file} is not its job: submitting that makes no film of its frames"
    except JobFileError:
        return f"a take, whose job file is damaged; see: pipeline check {layout.job_file}"
    found = frames_of_crashed_take(layout)
    if found is None:
        return f"a take; {film}"
    short = "a take that was cut short"
    if not found.whole:
        return f"{short}: {found.flaw}" if found.is_cut else f"{short} before its first frame"
    short += f" with {found.whole} frame{'' if found.whole == 1 else 's'}"
    return f"{short}, and {found.flaw}; {film} of those before it" if found.is_cut else f"{short}; {film} of all"


def _attempts_with_log(layout: JobLayout, task: TaskId) -> dict[int, Path]:
    first = layout.log(task, 1)
    stem = first.name.removesuffix(".1.log")
    logs = first.parent.glob(f"{stem}.*.log") if first.is_relative_to(layout.root / "logs") else iter(())
    return {int(path.name.split(".")[-2]): path for path in logs if path.name.split(".")[-2].isdigit()}


def _is_running(layout: JobLayout, task: TaskId, attempt: int) -> bool:
    from pipeline.lease import live_holder
    from pipeline.manifest_reader import ManifestReader

    if live_holder(layout.lease) is None:
        return False
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        return any((row.task, row.number) == (task, attempt) for row in manifest.running_attempts())


def _nearest(name: str, names: Sequence[str]) -> str:
    from difflib import get_close_matches

    close = get_close_matches(name, names, n=1)
    return f'; did you mean "{close[0]}"?' if close else ""


def _assessment_as_json(assessment: Assessment) -> dict[str, Any]:
    return {
        "task": assessment.task.id,
        "stage": assessment.task.stage,
        "frame": assessment.task.frame,
        "verdict": assessment.verdict.value,
        "reasons": [reason.text for reason in assessment.reasons],
        "rebuilds": list(assessment.rebuilds),
    }


def _attempt_as_json(attempt: AttemptRow) -> dict[str, Any]:
    return attempt._asdict()


def _attempt_line(attempt: AttemptRow) -> str:
    if attempt.finished is None:
        how = "running"
    else:
        how = f"{attempt.outcome}" + (f" in {wording.duration(attempt.seconds)}" if attempt.seconds is not None else "")
        how += f", peak {wording.size(attempt.peak_memory_bytes)}" if attempt.peak_memory_bytes else ""
        how += f": {attempt.message}" if attempt.message else ""
    return f"  {wording.moment(attempt.started)}  attempt {attempt.number} on {attempt.host}: {how}"


def _shortened(paths: Sequence[str]) -> str:
    return ", ".join(paths) if len(paths) <= 4 else f"{paths[0]} ... {paths[-1]} ({len(paths)} files)"
