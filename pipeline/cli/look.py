"""Commands that look at jobs and their tasks: status, explain."""

from __future__ import annotations

import json
import sys
import time
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base import wording
from pipeline.base.errors import JobFileError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import TaskId
from pipeline.base.wording import print_warnings
from pipeline.cli.arguments import (
    complete_jobs,
    find_job,
    job_folder,
    json_option,
    nearest,
    output_option,
    place,
    submitted_job_argument,
)
from pipeline.cli.make import assessment_as_json

if TYPE_CHECKING:
    from pipeline.queue.job_queue import QueuedJob
    from pipeline.queue.states import JobState
    from pipeline.record.reader import AttemptRow, StageSummary
    from pipeline.run.plan import Assessment

FOLLOW_INTERVAL_S = 0.5
_WIDTH = 11  # of the first column; the longest word is `interrupted`

_VERDICT_WORDING = {
    "up to date": "up to date",
    "stale": "would run",
    "downstream": "would run if its inputs turn out different",
}


@click.command()
@click.argument("job", metavar="[JOB]", required=False, shell_complete=complete_jobs)
@output_option
@json_option
@click.option(
    "--follow", "-f", is_flag=True, help="Show the job's progress until it ends; Ctrl-C ends the watching only."
)
def status(job: str | None, output: Path, as_json: bool, follow: bool) -> None:
    """List all jobs, or say how far one is and what went wrong.

    Jobs of the queue come first, in the order in which they run. Of one job: whether it runs, how far its stages are,
    what failed, and the solvers' numbers.

    With --follow it exits with 0 if the job is done, 8 if it was paused or cancelled, 5 if it failed.

    \b
    pipeline status
    pipeline status --farm /data/renders --json
    pipeline status my-film
    pipeline status my-film --follow
    """
    if follow and (job is None or as_json):
        raise click.UsageError("--follow shows one job to people: pipeline status my-film --follow")
    if job is None:
        _list_jobs(output, as_json=as_json)
    elif follow:
        sys.exit(_follow(job, output))
    else:
        _show_job(job, output, as_json=as_json)


def _list_jobs(output: Path, *, as_json: bool) -> None:
    from pipeline.base.lease import live_holder
    from pipeline.queue.job_queue import JobQueue
    from pipeline.queue.listing import list_jobs

    queue = JobQueue(output.absolute())
    jobs, flaws = list_jobs(queue)
    holder = live_holder(queue.lease)
    if as_json:
        runner = None if holder is None else asdict(holder)
        click.echo(json.dumps({"runner": runner, "jobs": [asdict(each) for each in jobs], "flaws": flaws}, indent=1))
        return
    if not jobs:
        click.echo(f"no job in {output}; begin with: pipeline new my-film")
    for each in jobs:
        priority = "" if each.priority is None else each.priority
        progress = f"{each.done}/{each.tasks}" if each.tasks else "-"
        note = f"  {each.note}" if each.note else ""
        when = wording.moment(each.changed)
        click.echo(f"{each.state:>{_WIDTH}}  {priority:>4}  {progress:>13}  {when}  {each.name}{note}")
    print_warnings(flaws)
    if holder is not None:
        click.echo(f"run by process {holder.pid} on {holder.host} since {wording.moment(holder.acquired)}")
    elif queue.waiting():
        click.echo(f"nobody runs the queue; run it with: pipeline work --farm {output}")


def _follow(job: str, output: Path) -> int:
    from pipeline.queue.following import Follower, watch
    from pipeline.queue.turns import as_given

    queue, name = place(job, output)
    entry = queue.find(name)
    if entry is None:
        return watch(find_job(job, output))
    code = Follower(queue, as_given(queue.layout(name)), submission=entry.submission).follow()
    if code is None:
        raise PipelineError(f"{name} waits, and nobody runs the queue; run it with: pipeline work --farm {output}")
    return code


def _show_job(job: str, output: Path, *, as_json: bool) -> None:
    from pipeline.base.lease import live_holder
    from pipeline.queue.listing import state_of_job
    from pipeline.queue.states import task_word
    from pipeline.record.reader import ManifestReader
    from pipeline.run.goal import read_goal
    from pipeline.run.solver_numbers import simulation_numbers

    queue, name = place(job, output)
    entry = queue.find(name)
    layout = find_job(job, output) if entry is None else job_folder(job, output)
    is_new = entry is not None and not layout.manifest.exists()
    state, holder = state_of_job(layout, entry), live_holder(layout.lease)
    summary, failures, events, drawn_on = [], [], [], {}
    if not is_new:
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            summary, failures, events = manifest.summary(), manifest.failures(), manifest.events(limit=5)
            drawn_on = manifest.devices("render")
    numbers = simulation_numbers(layout)
    until = read_goal(layout) if entry is None else entry.until
    preview = layout.preview_movie if layout.preview_movie.exists() else None
    if as_json:
        told = {
            "folder": str(layout.root),
            "state": state,
            "until": [*until],
            "runner": None if holder is None else asdict(holder),
            "stages": {stage.stage: dict(stage.counts) for stage in summary},
            "failures": [attempt._asdict() for attempt in failures],
            "events": [event._asdict() for event in events],
            "drawn_on": drawn_on,
            "simulation": numbers.as_json(),
            "preview_movie": None if preview is None else str(preview),
        }
        click.echo(json.dumps(told, indent=1))
        return
    click.echo(f"{layout.root}: {_activity(layout, entry, state, summary, holder.pid if holder else None)}")
    if until:
        click.echo(f"  ends after {', '.join(until)}, as submitted; the whole film: pipeline submit {job}")
    for stage in summary:
        counts: Counter[str] = Counter()
        for task_state, count in stage.counts.items():
            counts[task_word(task_state, runs=holder is not None)] += count
        click.echo(f"  {stage.stage:>10}  {', '.join(f'{count} {word}' for word, count in counts.items())}")
    if preview is not None:
        click.echo(f"  preview movie: {preview}")
    for line in numbers.lines():
        click.echo(f"  {line}")
    for sentence in [*numbers.warnings(), *wording.mixed_devices(drawn_on)]:
        click.secho(f"  warning: {sentence}", fg="yellow")
    for attempt in failures[:10]:
        click.secho(f"  {attempt.task} {attempt.outcome}: {attempt.message}", fg="red")
    if len(failures) > 10:
        click.echo(f"  ... and {len(failures) - 10} more")
    if state == "queued" and live_holder(queue.lease) is None:
        click.echo(f"nobody runs the queue; run it with: pipeline work --farm {output}")


@click.command()
@submitted_job_argument
@click.argument("task", required=False)
@json_option
@click.option("--log", is_flag=True, help="Print the task's log instead; without a task, list those that have one.")
@click.option("--attempt", type=click.IntRange(min=1), help="With --log: number of the attempt; the last if omitted.")
@click.option("--follow", "-f", is_flag=True, help="With --log: keep printing until the attempt ends.")
def explain(
    job: str, *, output: Path, task: str | None, as_json: bool, log: bool, attempt: int | None, follow: bool
) -> None:
    """Tell the whole story of one task or file, or print its log.

    Its inputs, its outputs, every attempt, why it would run again, and what its files were made from: job file,
    parameters, versions and machine.

    \b
    pipeline explain my-film render/000012
    pipeline explain my-film frames/000012.png
    pipeline explain my-film simulate --json
    pipeline explain my-film --log
    pipeline explain my-film simulate --log --follow
    pipeline explain my-film render/000012 --log --attempt 1
    """
    layout = find_job(job, output)
    task = None if task is None else unicodedata.normalize("NFC", task)  # as names of bodies are
    if log:
        if as_json:
            raise click.UsageError("a log is text; leave --json out")
        _print_log(job, layout, task, attempt, follow=follow)
        return
    if attempt is not None or follow:
        raise click.UsageError("--attempt and --follow are about a log: add --log")
    if task is None:
        raise click.UsageError(f"name a task or a file; the tasks that have a log: pipeline explain {job} --log")
    _tell_story(layout, task, as_json=as_json)


def _tell_story(layout: JobLayout, task: str, *, as_json: bool) -> None:
    from pipeline.base.lease import live_holder
    from pipeline.queue.states import task_word
    from pipeline.record.reader import ManifestReader
    from pipeline.store.provenance import origins_of
    from pipeline.store.receipts import read_receipt, verify_artifact

    found = _find_task(layout, task)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        state, history = manifest.states().get(found.task.id), manifest.history(found.task.id)
        events = manifest.events(task=found.task.id)
    receipts = {path: read_receipt(layout, path) for path in found.task.outputs}
    there = [receipt for receipt in receipts.values() if receipt is not None]
    origins = origins_of(layout, there)
    if as_json:
        story = {
            **assessment_as_json(found),
            "state": state,
            "parameters": json.loads(found.task.parameters.canonical),
            "inputs": list(found.task.inputs),
            "receipts": [json.loads(receipt.to_json()) for receipt in there],
            "provenance": [origin.as_json() for origin in origins],
            "attempts": [attempt._asdict() for attempt in history],
        }
        click.echo(json.dumps(story, indent=1))
        return
    word = "made" if there else "not planned yet"  # exports are in no plan once they are done
    if state is not None:
        word = task_word(state, runs=live_holder(layout.lease) is not None)
    click.echo(f"{found.task.id}: {word}, {_VERDICT_WORDING[found.verdict.value]}")
    for reason in found.reasons:
        click.echo(f"  {reason.text}")
    click.echo(f"reads   {_shortened(found.task.inputs) or 'the job file only'}")
    for path, receipt in list(receipts.items())[:3]:
        if receipt is None:
            click.echo(f"makes   {path}: not there yet")
        else:
            flaw = verify_artifact(layout, receipt, deep=False)
            click.echo(
                f"makes   {path}: {wording.size(receipt.size)}, attempt {receipt.attempt}, {flaw or 'as committed'}"
            )
    if len(receipts) > 3:
        click.echo(f"        ... {len(there)} of {len(receipts)} files are there")
    click.echo(f"key     {found.task.parameters.digest[:16]} (its parameters: pipeline explain ... --json)")
    for line in chain.from_iterable(origin.lines() for origin in origins):
        click.echo(line)
    for attempt in history:
        click.echo(_attempt_line(attempt))
    for event in events:
        click.echo(f"  {wording.moment(event.time)}  {event.kind}: {event.message}")


def _find_task(layout: JobLayout, task: str) -> Assessment:
    """A task of the film, else of an export that was made, by its name or a file of it. Raises PipelineError."""
    from pipeline.job.loading import load_job
    from pipeline.record.reader import ManifestReader
    from pipeline.run.assessment import assess_job
    from pipeline.run.plan import frame_ranges
    from pipeline.stages import STAGES

    job = load_job(layout.job_file)
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        made = {row.task for row in manifest.artifacts().values()}
    exports = []
    for stage in (stage for stage in STAGES if stage.on_demand):
        theirs = [name for name in made if name.partition("/")[0] == stage.name]
        frames = [int(end) for name in theirs if (end := name.rpartition("/")[2]).isdecimal()]
        if theirs:
            exports.append((f"{stage.name}:{frame_ranges(frames, range(max(frames) + 1))}" if frames else stage.name,))
    known: list[str] = []
    for until in ((), *exports):
        assessments = assess_job(job, layout, until).assessments
        for each in assessments:
            if each.task.id == task or task in each.task.outputs:
                return each
        known += [each.task.id for each in assessments]
    raise PipelineError(f'the job has no task "{task}"{nearest(task, known)}')


def _print_log(job: str, layout: JobLayout, task: str | None, attempt: int | None, *, follow: bool) -> None:
    if task is None:
        for name, number, path in layout.logs():
            click.echo(f"{name}  attempt {number}  {path.stat().st_size:,} bytes")
        return
    attempts = {number: path for name, number, path in layout.logs() if name == task}
    if not attempts:
        raise PipelineError(
            f'no log of a task "{task}" in {layout.root}; those that have one: pipeline explain {job} --log'
        )
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


def _activity(
    layout: JobLayout, entry: QueuedJob | None, state: JobState, summary: Sequence[StageSummary], pid: int | None
) -> str:
    """What happens to a job, or would."""
    from pipeline.record.reader import done_and_total

    if pid is not None:
        return f"{state}, process {pid}"
    done, total = done_and_total(summary)
    if state == "recorded":
        return _activity_of_recording(layout)
    words = [state if entry is None or not entry.note else f"{state} ({entry.note})"]
    if total and (done < total or state != "done"):
        words.append(f"{done} of {total} tasks done")
    if not total and state == "interrupted":
        words.append("its record holds no tasks")
    return ", ".join(words)


def _activity_of_recording(layout: JobLayout) -> str:
    """What submitting a recording of `pipeline live` would do."""
    from pipeline.record.interrupted_recording import frames_of_interrupted_recording, is_job_of_recording

    film = f"submitting {layout.job_file} makes the film"
    try:
        if not is_job_of_recording(layout):
            return f"a recording, but {layout.job_file} is not its job: submitting that makes no film of its frames"
    except JobFileError:
        return f"a recording, whose job file is damaged; see: pipeline check {layout.job_file}"
    found = frames_of_interrupted_recording(layout)
    if found is None:
        return f"a recording; {film}"
    short = "a recording that was cut short"
    if not found.whole:
        return f"{short}: {found.flaw}" if found.is_cut else f"{short} before its first frame"
    short += f" with {wording.counted(found.whole, 'frame')}"
    return f"{short}, and {found.flaw}; {film} of those before it" if found.is_cut else f"{short}; {film} of all"


def _is_running(layout: JobLayout, task: TaskId, attempt: int) -> bool:
    from pipeline.base.lease import live_holder
    from pipeline.record.reader import ManifestReader

    if live_holder(layout.lease) is None:
        return False
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        return any((row.task, row.number) == (task, attempt) for row in manifest.running_attempts())


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
