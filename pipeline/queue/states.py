"""The words for where a job, or one of its tasks, stands: the same in `pipeline status`, its JSON and the dashboard."""

from collections.abc import Mapping
from enum import StrEnum

from pipeline.base.task import TaskState
from pipeline.queue.job_queue import Desired, QueuedJob
from pipeline.run.events import JobOutcome


class JobState(StrEnum):
    """Where a job stands."""

    RUNNING = "running"
    PAUSING = "pausing"
    QUEUED = "queued"
    PAUSED = "paused"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    """Its last run neither ended nor goes on: it was killed."""
    STOPPED = "stopped"
    """It was cancelled, or stopped by hand, and is not in the queue."""
    RECORDED = "recorded"
    """A recording: its frames are there, and nothing has been asked to make a film of them."""
    NOT_STARTED = "not started"
    """It has never run, and nothing is there of it."""
    DONE = "done"
    UNKNOWN = "unknown"
    """Its record cannot be read."""


TASK_WORDS: Mapping[TaskState, str] = {
    TaskState.PENDING: "waiting",
    TaskState.READY: "waiting",
    TaskState.CANCELLED: "waiting",
    TaskState.RUNNING: "running",
    TaskState.SUCCEEDED: "done",
    TaskState.UP_TO_DATE: "done",
    TaskState.FAILED: "failed",
    TaskState.UPSTREAM_FAILED: "failed upstream",
}
"""A stopped task waits for the next run."""


def state_of(job: QueuedJob, *, runs: bool) -> JobState:
    """Where a job of the queue stands; it `runs` while somebody works in its folder."""
    if job.desired is Desired.RUN:
        return JobState.RUNNING if runs else JobState.QUEUED
    if job.desired is Desired.PAUSE:
        return JobState.PAUSING if runs else JobState.PAUSED
    return JobState.FAILED


def state_after(outcome: str | None) -> JobState:
    """Where a job stands after a run that ended so; None: the run was killed."""
    if outcome == JobOutcome.SUCCEEDED:
        return JobState.DONE
    if outcome in (JobOutcome.FAILED, JobOutcome.TOO_MANY_FAILURES):
        return JobState.FAILED
    return JobState.INTERRUPTED if outcome is None else JobState.STOPPED


def ending_of(outcome: str | None) -> str:
    """How a run ended: the state after it, and the particular reason where there is one."""
    state = state_after(outcome)
    reasons = (JobOutcome.TOO_MANY_FAILURES, JobOutcome.DISK_FULL, JobOutcome.NO_GPU, JobOutcome.OUTGROWN)
    return f"{state} ({outcome})" if outcome in reasons else state


def task_word(state: TaskState, *, runs: bool) -> str:
    """Where a task stands; what a killed runner left as running is interrupted."""
    return JobState.INTERRUPTED if state is TaskState.RUNNING and not runs else TASK_WORDS[state]
