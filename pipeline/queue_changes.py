"""What people ask of jobs in a farm's queue: pause, resume, cancel, retry, another priority.

Commands and the dashboard call these. Each only changes the job's entry in the spool, which whoever runs it looks at.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

from pipeline.crashed_take import complete_crashed_take
from pipeline.errors import JobBusyError, PipelineError
from pipeline.lease import live_holder
from pipeline.spool import QueuedJob, Spool, Wish, new_ticket, submission


class Continuation(NamedTuple):
    """How a job goes on.

    Attributes:
        entry: to be queued.
        note: what was done to its folder for that, a sentence; "" for nothing.
    """

    entry: QueuedJob
    note: str = ""


def queue_state(spool: Spool, job: QueuedJob) -> str:
    """One word for where a job of the queue stands; see `state_of`."""
    return state_of(job, runs=live_holder(spool.layout(job.name).lease) is not None)


def state_of(job: QueuedJob, *, runs: bool) -> str:
    """One word for where a job of the queue stands: running, queued, pausing, paused or failed.

    Args:
        job: its entry.
        runs: whether somebody works in its folder.
    """
    if job.wish is Wish.RUN:
        return "running" if runs else "queued"
    if job.wish is Wish.PAUSE:
        return "pausing" if runs else "paused"
    return "failed"


def entry_of(spool: Spool, name: str) -> QueuedJob:
    """A job's entry. Raises PipelineError if it has none."""
    entry = spool.find(name)
    if entry is None:
        raise _not_queued(spool, name)
    return entry


def pause_job(spool: Spool, name: str) -> bool:
    """Stop a job for the time being; what runs is finished first.

    Returns:
        Whether it runs now.

    Raises:
        PipelineError: it is not in the queue, or has failed.
    """
    entry_of(spool, name)  # before the lock, which would make a folder where there is none
    with spool.locked():
        entry = entry_of(spool, name)
        if entry.wish is Wish.NONE:
            raise PipelineError(f"{name} has failed, and does not run; see: pipeline queue")
        spool.change(name, wish=Wish.PAUSE, note="asked to pause")
    return queue_state(spool, entry) == "running"


def cancel_job(spool: Spool, name: str) -> None:
    """Stop a job at once and take it out of the queue. Raises PipelineError if it is not in it."""
    if not spool.is_there() or not spool.drop(name):
        raise _not_queued(spool, name)


def set_priority(spool: Spool, name: str, priority: int) -> None:
    """Give a job another priority. Raises PipelineError if it is not in the queue."""
    entry_of(spool, name)
    spool.change(name, priority=priority)


def another_try(spool: Spool, name: str, *, background: bool) -> QueuedJob:
    """The entry by which the failed tasks of a job are tried again, to be queued.

    Raises:
        PipelineError: the job is not in the queue, or waits for its turn already.
    """
    entry = entry_of(spool, name)
    if entry.wish is Wish.RUN and queue_state(spool, entry) != "running":
        raise PipelineError(f"{name} waits for its turn already; see: pipeline queue")
    return replace(entry, ticket=new_ticket(), wish=Wish.RUN, note="", submitted=time.time(), background=background)


def continuation(spool: Spool, name: str) -> Continuation:
    """The entry by which a job goes on in the background as it was meant, to be queued.

    Of a take whose recorder crashed, all frames that are there are taken over.

    Raises:
        PipelineError: it was never submitted, or its job file is damaged.
        JobBusyError: it runs, and is not to pause.
    """
    paused = spool.find(name)
    if paused is None:
        layout = spool.layout(name)
        if not layout.job_file.exists():
            raise PipelineError(f"no submitted job in {layout.root}; submit one with: pipeline submit JOB.toml")
        if live_holder(layout.lease) is not None:
            raise JobBusyError(f"{name} runs already")
        note = complete_crashed_take(layout)
        return Continuation(submission(name, background=True), note)
    if paused.wish is Wish.RUN:
        state = queue_state(spool, paused)
        raise JobBusyError(f"{name} runs already" if state == "running" else f"{name} waits for its turn already")
    entry = replace(paused, ticket=new_ticket(), wish=Wish.RUN, note="", submitted=time.time(), background=True)
    return Continuation(entry)


def _not_queued(spool: Spool, name: str) -> PipelineError:
    known = ", ".join(job.name for job in spool.listing().jobs)
    return PipelineError(
        f'"{name}" is not in the queue of {spool.farm}; {f"in it: {known}" if known else "it is empty"}'
    )
