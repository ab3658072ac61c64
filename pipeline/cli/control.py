"""Commands that control jobs which run or wait: pause, resume, cancel, priority, work."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base.errors import DiskFullError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.signals import signals_to
from pipeline.cli.arguments import (
    PRIORITY,
    claim_cores,
    complete_jobs,
    find_job,
    output_option,
    parse_frames,
    place,
    queue_options,
    submitted_job_argument,
)
from pipeline.queue.submitting import QueueOptions, is_finished, look_at, run, stages_to_run

if TYPE_CHECKING:
    from pipeline.base.lease import Lease
    from pipeline.queue.job_queue import JobQueue

LOOK_INTERVAL_S = 0.5
STOPPED_EXIT_CODE = 143  # as shells report a program that SIGTERM ended
FAILED_EXIT_CODE = 5


@click.command()
@submitted_job_argument
def pause(job: str, output: Path) -> None:
    """Stop a job for the time being.

    Frames that are being made are finished first, and a simulation writes a checkpoint. Other jobs of the queue go on.

    \b
    pipeline pause my-film
    """
    from pipeline.queue.changes import pause_job
    from pipeline.queue.turns import as_given

    queue, name = place(job, output)
    runs = pause_job(queue, name)
    click.echo(f"{name} {'pauses as soon as what runs is finished' if runs else 'pauses'}")
    click.echo(f"continue with: pipeline resume {as_given(queue.layout(name)).root}")


@click.command()
@submitted_job_argument
@queue_options
def resume(job: str, output: Path, options: QueueOptions) -> None:
    """Continue a job from its own folder.

    A job that pauses goes on, and ends after the stages that its submission named with --until. A folder that was moved
    to another disk continues there; the original job file is not needed.

    \b
    pipeline resume my-film
    pipeline resume /mnt/films/dam-break --detach
    """
    from pipeline.job.loading import job_of_text, load_job
    from pipeline.record.interrupted_recording import complete_interrupted_recording
    from pipeline.run.goal import read_goal

    queue, name = place(job, output)
    waiting = queue.find(name)
    if waiting is not None and waiting.text is not None:  # paused before its run took its job file over
        layout = queue.layout(name)
        submitted = job_of_text(waiting.text, layout.job_file)
    else:
        layout = find_job(job, output)
        if sentence := complete_interrupted_recording(layout):
            click.echo(sentence, err=True)
        submitted = load_job(layout.job_file)
    until = read_goal(layout) if waiting is None else waiting.until
    state = look_at(submitted, layout, until)
    if is_finished(state, layout, None, until):
        from pipeline.queue.endings import say_finished

        say_finished(layout)
        return
    sys.exit(run(submitted, layout, stages_to_run(state), options=options, paused=waiting, until=until))


@click.command()
@submitted_job_argument
def cancel(job: str, output: Path) -> None:
    """Stop a job at once and take it out of the queue.

    What it has finished stays.

    \b
    pipeline cancel my-film
    """
    from pipeline.queue.changes import cancel_job
    from pipeline.queue.turns import as_given

    queue, name = place(job, output)
    cancel_job(queue, name)
    click.echo(f"{name} is cancelled; what is finished stays in {as_given(queue.layout(name)).root}")


@click.command(context_settings={"ignore_unknown_options": True})  # -5 is a priority
@output_option
@click.argument("job", metavar="JOB", shell_complete=complete_jobs)
@click.argument("value", metavar="PRIORITY", type=PRIORITY)
def priority(job: str, output: Path, value: int) -> None:
    """Let a job of the queue go before or after others.

    Jobs of higher priority go first, and interrupt lower ones without loss.

    \b
    pipeline priority my-film 10
    pipeline priority my-film -5
    """
    from pipeline.queue.changes import set_priority

    queue, name = place(job, output)
    set_priority(queue, name, value)
    click.echo(f"{name} has priority {value}")


@click.command()
@output_option
@click.argument("job", metavar="[JOB]", required=False, shell_complete=complete_jobs)
@click.option(
    "--stage", help="Run this stage of JOB in this process, for a farm manager: no queue, no record, no retry."
)
@click.option("--frames", metavar="RANGES", help="With --stage: only these frames: 7 or 0-29 or 0-29,60-89.")
@click.option("--cores", type=click.IntRange(min=1), help="With --stage: processor cores to use at most.")
@click.option("--openjd", is_flag=True, help="With --stage: tell progress the way Open Job Description has it.")
def work(
    job: str | None, *, output: Path, stage: str | None, frames: str | None, cores: int | None, openjd: bool
) -> None:
    """Run the queue in this terminal until nothing waits in it.

    `submit --detach` does this in the background. Where somebody runs the queue already, this one waits, and takes
    over if that one ends or is killed. Ctrl-C, or a signal TERM, lets the running job finish what it is at
    and leaves the rest in the queue.

    With a job and --stage, run just that stage, or some frames of it, without the queue: for farm managers, see
    `pipeline export`. Any number of machines may work on different frames of a job at once. What is done is not done
    again; what the stage reads must be there. Exits with 0 when all is there, 5 after a failure, 7 when the disk is
    full, and 143 when it was stopped by SIGTERM, after which it continues.

    \b
    pipeline work
    pipeline work --farm /data/renders
    pipeline work my-film --stage render --frames 0-9
    """
    if job is not None:
        if stage is None:
            raise click.UsageError("name the stage of the job: --stage; or leave the job out to run the whole queue")
        _run_stage(find_job(job, output), stage, frames, cores=cores, openjd=openjd)
    elif stage or frames or cores or openjd:
        raise click.UsageError("--stage, --frames, --cores and --openjd are about one job: name it")
    else:
        _run_queue(output)


def _run_queue(output: Path) -> None:
    from pipeline.queue.farm import FarmRunner
    from pipeline.queue.job_queue import JobQueue
    from pipeline.queue.turns import Turns, say

    queue = JobQueue(output.absolute())
    if not queue.folder.exists():
        raise PipelineError(f"{output} has no queue: nothing was ever submitted there")
    turns = Turns(queue, None)
    while True:
        with _lease_of(queue) as lease:
            if lease is None:
                break
            if lease.takeover is not None:
                say(f"{lease.takeover}; its queue goes on")
            try:
                FarmRunner(queue, lease, turns.run, say, turns.ended).work()
            except KeyboardInterrupt:
                break
        if not queue.left():
            break
    left = len(queue.waiting())
    click.echo(f"{left} jobs are left in the queue" if left else "the queue is empty", err=True)


@contextmanager
def _lease_of(queue: JobQueue) -> Iterator[Lease | None]:
    """The lease of a queue, once nobody else runs it; None if nothing is left in it by then."""
    from pipeline.base.errors import JobBusyError
    from pipeline.base.lease import Lease
    from pipeline.queue.turns import say

    is_told = False
    while True:
        try:
            lease = Lease.acquire(queue.lease)
        except JobBusyError as busy:
            if not is_told:
                say(f"{busy}; this one takes over if that ends before the queue")
            is_told = True
            if not queue.waiting():
                yield None
                return
            time.sleep(LOOK_INTERVAL_S)
            continue
        with lease:
            yield lease
        return


def _run_stage(layout: JobLayout, stage: str, frames: str | None, *, cores: int | None, openjd: bool) -> None:
    from pipeline.base.lease import refuse_if_held
    from pipeline.base.task import FailureKind
    from pipeline.job.loading import load_job
    from pipeline.run.single_stage import run_stage

    layout = JobLayout(layout.root.absolute())
    refuse_if_held(layout.lease)
    capacity = claim_cores(cores)
    stopped: list[int] = []
    with signals_to(lambda number, _: stopped.append(number)):
        outcome = run_stage(
            load_job(layout.job_file),
            layout,
            stage,
            None if frames is None else parse_frames(frames),
            capacity=capacity,
            tell=_tell_openjd if openjd else _tell,
            stop_requested=lambda: bool(stopped),
        )
    for failed in outcome.failures:
        click.secho(f"{failed.task_id}: {failed.message}", err=True, fg="red")
    click.echo(
        f"{stage}: {outcome.ran} tasks ran, {outcome.up_to_date} were up to date, {len(outcome.failures)} failed"
    )
    if stopped:
        sys.exit(STOPPED_EXIT_CODE)
    if outcome.failures:
        full = any(failed.kind is FailureKind.DISK_FULL for failed in outcome.failures)
        sys.exit(DiskFullError.exit_code if full else FAILED_EXIT_CODE)


def _tell(share: float, sentence: str) -> None:
    click.echo(f"{100 * share:.0f} %  {sentence}", err=True)


def _tell_openjd(share: float, sentence: str) -> None:
    """Lines of the specification "How Jobs Are Run", on standard output."""
    print(f"openjd_progress: {100 * share:.1f}", flush=True)
    print(f"openjd_status: {sentence}", flush=True)
