"""Commands about the queue of a farm: queue, watch, pause, cancel, retry, priority, work."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline import wording
from pipeline.commands.arguments import (
    PRIORITY,
    find_job,
    job_folder,
    json_option,
    output_option,
    print_warnings,
    submitted_job_argument,
)
from pipeline.errors import ManifestError, OutdatedManifestError, PipelineError
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.spool import Spool


@click.command()
@output_option
@json_option
def queue(output: Path, as_json: bool) -> None:
    """List the jobs that wait, run, pause or have failed, in the order in which they run.

    \b
    pipeline queue
    pipeline queue --output /data/renders --json
    """
    from dataclasses import asdict

    from pipeline.lease import live_holder
    from pipeline.queue_changes import queue_state
    from pipeline.spool import Spool

    spool = Spool(output.absolute())
    listing = spool.listing()
    holder = live_holder(spool.lease)
    flaws = [*listing.flaws]
    rows = [(job, queue_state(spool, job), *_done_of(spool.layout(job.name), flaws)) for job in listing.jobs]
    if as_json:
        jobs = [
            {
                "name": job.name,
                "state": state,
                "priority": job.priority,
                "submitted": job.submitted,
                "done": done,
                "tasks": total,
                "note": job.note,
            }
            for job, state, done, total in rows
        ]
        runner = None if holder is None else asdict(holder)
        click.echo(json.dumps({"runner": runner, "jobs": jobs, "flaws": flaws}, indent=1))
        return
    if not rows:
        click.echo(f"nothing waits in {output}")
    for job, state, done, total in rows:
        progress = f"{done}/{total}" if total else "-"
        note = f"  {job.note}" if job.note else ""
        click.echo(f"{state:>8}  {job.priority:>4}  {progress:>13}  {wording.moment(job.submitted)}  {job.name}{note}")
    print_warnings(flaws)
    if holder is not None:
        click.echo(f"run by process {holder.pid} on {holder.host} since {wording.moment(holder.acquired)}")
    elif spool.waiting():
        click.echo(f"nobody runs the queue; run it with: pipeline work --output {output}")


@click.command()
@submitted_job_argument
def watch(job: str, output: Path) -> None:
    """Show a job's progress until it ends. Ctrl-C ends the watching only.

    Exits with 0 if the film is done, 8 if the job was paused or cancelled, 5 if it failed.

    \b
    pipeline watch quickstart
    """
    from pipeline.commands.watching import Follower
    from pipeline.commands.watching import watch as watch_run

    spool, name = place(job, output)
    entry = spool.find(name)
    if entry is None:
        sys.exit(watch_run(find_job(job, output)))
    code = Follower(spool, JobLayout(Path(_shown(spool, name))), ticket=entry.ticket).follow()
    if code is None:
        raise PipelineError(
            f"{entry.name} waits, and nobody runs the queue; run it with: pipeline work --output {output}"
        )
    sys.exit(code)


@click.command()
@submitted_job_argument
def pause(job: str, output: Path) -> None:
    """Stop a job for the time being; `pipeline resume` continues it.

    Frames that are being made are finished first, and a simulation writes a checkpoint. Other jobs of the queue go on.

    \b
    pipeline pause quickstart
    """
    from pipeline.queue_changes import pause_job

    spool, name = place(job, output)
    runs = pause_job(spool, name)
    click.echo(f"{name} {'pauses as soon as what runs is finished' if runs else 'pauses'}")
    click.echo(f"continue with: pipeline resume {_shown(spool, name)}")


@click.command()
@submitted_job_argument
def cancel(job: str, output: Path) -> None:
    """Stop a job at once and take it out of the queue. What it has finished stays.

    \b
    pipeline cancel quickstart
    """
    from pipeline.queue_changes import cancel_job

    spool, name = place(job, output)
    cancel_job(spool, name)
    click.echo(f"{name} is cancelled; what is finished stays in {_shown(spool, name)}")


@click.command()
@submitted_job_argument
@click.option("--detach", is_flag=True, help="Return at once; the job runs in the background.")
def retry(job: str, output: Path, detach: bool) -> None:
    """Try the failed tasks of a job again.

    If the job still runs, they are tried again as soon as its other tasks have ended.

    \b
    pipeline retry quickstart
    pipeline retry quickstart --detach
    """
    from pipeline.commands.turns import stand_in_queue
    from pipeline.queue_changes import another_try

    spool, name = place(job, output)
    again = another_try(spool, name, background=detach)
    sys.exit(stand_in_queue(spool, JobLayout(Path(_shown(spool, name))), again, detach=detach))


@click.command()
@output_option
@click.argument("job", metavar="JOB")
@click.argument("value", metavar="PRIORITY", type=PRIORITY)
def priority(job: str, output: Path, value: int) -> None:
    """Give a job of the queue another priority: higher ones go first, and interrupt lower ones without loss.

    \b
    pipeline priority quickstart 10
    pipeline priority quickstart -- -5
    """
    from pipeline.queue_changes import set_priority

    spool, name = place(job, output)
    set_priority(spool, name, value)
    click.echo(f"{name} has priority {value}")


@click.command()
@output_option
def work(output: Path) -> None:
    """Run the queue until nothing waits in it. `submit --detach` does this in the background.

    Ctrl-C, or a signal TERM, lets the running job finish what it is at and leaves the rest in the queue.

    \b
    pipeline work
    pipeline work --output /data/renders
    """
    from pipeline.commands.turns import Turns, say
    from pipeline.farm import FarmRunner
    from pipeline.lease import Lease
    from pipeline.spool import Spool

    spool = Spool(output.absolute())
    if not spool.folder.exists():
        raise PipelineError(f"{output} has no queue: nothing was ever submitted there")
    with Lease.acquire(spool.lease) as lease:
        if lease.takeover is not None:
            say(f"{lease.takeover}; its queue goes on")
        turns = Turns(spool, None)
        FarmRunner(spool, lease, turns.run, say, pause_on_signal=False, after_turn=turns.ended).work()
    left = len(spool.waiting())
    click.echo(f"{left} jobs are left in the queue" if left else "the queue is empty", err=True)


def place(job: str, output: Path) -> tuple[Spool, str]:
    """The spool and the name of a job, which may have no folder yet: by its folder, its name or its job file."""
    from pipeline.spool import Spool

    root = job_folder(job, output).root.absolute()
    return Spool(root.parent), root.name


def _shown(spool: Spool, name: str) -> str:
    from pipeline.commands.turns import as_given

    return str(as_given(spool.layout(name)).root)


def _done_of(layout: JobLayout, flaws: list[str]) -> tuple[int, int]:
    """How many of a job's tasks are done, and how many there are; none before it has first run.

    Of a record that cannot be read, none too, and a sentence about it is added to the flaws.
    """
    from pipeline.commands.watching import done_and_total

    if not layout.manifest.exists():
        return 0, 0
    try:
        return done_and_total(layout)
    except OutdatedManifestError:
        return 0, 0
    except ManifestError as error:
        flaws.append(str(error))
        return 0, 0
