"""Changes that people ask for of jobs in a farm's queue: pause, resume, cancel, retry, another priority.

Commands and the dashboard call these. Each only changes the job's entry in the queue, which whoever runs it looks at.
"""

from pipeline.base.errors import JobBusyError, PipelineError
from pipeline.base.lease import live_holder
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob, new_entry
from pipeline.record.interrupted_recording import complete_interrupted_recording
from pipeline.run.goal import read_goal


def _runs(queue: JobQueue, name: str) -> bool:
    return live_holder(queue.layout(name).lease) is not None


def entry_of(queue: JobQueue, name: str) -> QueuedJob:
    """A job's entry. Raises PipelineError if it has none."""
    entry = queue.find(name)
    if entry is None:
        raise _not_queued(queue, name)
    return entry


def pause_job(queue: JobQueue, name: str) -> bool:
    """Stop a job for the time being; what runs is finished first.

    Returns:
        Whether it runs now.

    Raises PipelineError: it is not in the queue, or has failed.
    """
    entry_of(queue, name)  # before the lock, which would make a folder where there is none
    with queue.locked():
        entry = entry_of(queue, name)
        if entry.desired is Desired.NONE:
            raise PipelineError(f"{name} has failed, and does not run; see: pipeline status")
        queue.change(name, desired=Desired.PAUSE, note="asked to pause")
    return entry.desired is Desired.RUN and _runs(queue, name)


def cancel_job(queue: JobQueue, name: str) -> None:
    """Stop a job at once and take it out of the queue. Raises PipelineError if it is not in it."""
    if not queue.is_there() or not queue.drop(name):
        raise _not_queued(queue, name)


def set_priority(queue: JobQueue, name: str, priority: int) -> None:
    """Give a job another priority. Raises PipelineError if it is not in the queue."""
    entry_of(queue, name)
    queue.change(name, priority=priority)


def another_try(queue: JobQueue, name: str, *, background: bool) -> QueuedJob:
    """The entry by which the failed tasks of a job are tried again, to be queued.

    Raises PipelineError: the job is not in the queue, or waits for its turn already.
    """
    entry = entry_of(queue, name)
    if entry.desired is Desired.RUN and not _runs(queue, name):
        raise PipelineError(f"{name} waits for its turn already; see: pipeline status")
    return entry.again(background=background)


def continuation(queue: JobQueue, name: str) -> tuple[QueuedJob, str]:
    """The entry by which a job goes on in the background as it was meant, to be queued.

    Of a recording that was cut short, all frames that are there are taken over; a sentence tells so, else "".

    Raises:
        PipelineError: it was never submitted, or its job file is damaged.
        JobBusyError: it runs, and is not to pause.
    """
    paused = queue.find(name)
    if paused is None:
        layout = queue.layout(name)
        if not layout.job_file.exists():
            raise PipelineError(f"no submitted job in {layout.root}; submit one with: pipeline submit JOB.toml")
        if _runs(queue, name):
            raise JobBusyError(f"{name} runs already")
        note = complete_interrupted_recording(layout)
        return new_entry(name, until=read_goal(layout), background=True), note
    if paused.desired is Desired.RUN:
        raise JobBusyError(f"{name} {'runs' if _runs(queue, name) else 'waits for its turn'} already")
    return paused.again(background=True), ""


def _not_queued(queue: JobQueue, name: str) -> PipelineError:
    known = ", ".join(job.name for job in queue.listing().jobs)
    return PipelineError(
        f'"{name}" is not in the queue of {queue.farm}; {f"in it: {known}" if known else "it is empty"}'
    )
