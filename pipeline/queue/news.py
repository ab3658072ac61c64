"""The notification that the end of a job's turn is worth."""

from __future__ import annotations

from pathlib import Path

from pipeline.base.errors import DiskFullError
from pipeline.base.layout import JobLayout
from pipeline.queue.farm import Ended, StopReason
from pipeline.queue.notifications import Event, Notification
from pipeline.queue.states import ending_of
from pipeline.run.events import JobOutcome, Outcome
from pipeline.run.goal import what_is_made

_PAUSES = {StopReason.PAUSED, StopReason.DISK_SHORT}
_FAILURES = {JobOutcome.FAILED, JobOutcome.TOO_MANY_FAILURES}


def notification_of(name: str, folder: Path, ended: Ended) -> Notification | None:
    """The notification of how a turn ended.

    Returns:
        None for a job that only lets a more urgent one go first, and for one that was cancelled on purpose.
    """
    outcome = ended.outcome
    if ended.error is not None:
        kind: Event = "paused" if isinstance(ended.error, DiskFullError) else "failed"
        return Notification(kind, name, str(folder), str(ended.error))
    if outcome is not None and outcome.kind is JobOutcome.SUCCEEDED:
        made = what_is_made(JobLayout(folder))
        return Notification("done", name, str(folder), f"{made} is done", seconds=outcome.seconds)
    if outcome is not None and outcome.kind in _FAILURES:
        return _failure(name, folder, outcome)
    if ended.reason is None or ended.reason in _PAUSES:
        why = (
            ended.reason.value
            if ended.reason is not None
            else ending_of(outcome.kind)
            if outcome is not None
            else "paused"
        )
        seconds = 0.0 if outcome is None else outcome.seconds
        sentence = f"{why}; continue with: pipeline resume {folder}"
        return Notification("paused", name, str(folder), sentence, seconds=seconds)
    return None


def _failure(name: str, folder: Path, outcome: Outcome) -> Notification:
    failures = tuple(f"{failed.task_id}: {failed.message}" for failed in outcome.failures)
    first = failures[0] if failures else outcome.kind.value
    return Notification("failed", name, str(folder), first, seconds=outcome.seconds, failures=failures)
