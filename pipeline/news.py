"""What is worth telling of the end of a job's turn."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import DiskFullError
from pipeline.farm import Ended, StopReason
from pipeline.layout import JobLayout
from pipeline.notifications import Event, Notification
from pipeline.run_events import Outcome
from pipeline.scheduler_events import JobOutcome

_PAUSES = {StopReason.PAUSED, StopReason.DISK_SHORT}
_FAILURES = {JobOutcome.FAILED, JobOutcome.TOO_MANY_FAILURES}


def notification_of(name: str, folder: Path, ended: Ended) -> Notification | None:
    """What is to be told.

    Returns:
        None for a job that only lets a more urgent one go first, and for one that was cancelled on purpose.
    """
    outcome = ended.outcome
    if ended.error is not None:
        kind: Event = "paused" if isinstance(ended.error, DiskFullError) else "failed"
        return Notification(kind, name, str(folder), str(ended.error))
    if outcome is not None and outcome.kind is JobOutcome.SUCCEEDED:
        film = JobLayout(folder).path(JobLayout.movie())
        return Notification("done", name, str(folder), f"{film} is done", seconds=outcome.seconds)
    if outcome is not None and outcome.kind in _FAILURES:
        return _failure(name, folder, outcome)
    if ended.reason is None or ended.reason in _PAUSES:
        why = (
            ended.reason.value if ended.reason is not None else outcome.kind.value if outcome is not None else "paused"
        )
        seconds = 0.0 if outcome is None else outcome.seconds
        sentence = f"{why}; continue with: pipeline resume {folder}"
        return Notification("paused", name, str(folder), sentence, seconds=seconds)
    return None


def _failure(name: str, folder: Path, outcome: Outcome) -> Notification:
    failures = tuple(f"{failed.task_id}: {failed.message}" for failed in outcome.failures)
    first = failures[0] if failures else outcome.kind.value
    return Notification("failed", name, str(folder), first, seconds=outcome.seconds, failures=failures)
