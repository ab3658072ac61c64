"""Estimates of progress and of the time left: pure functions of a job's record."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pipeline.base.task import TaskState
from pipeline.record.reader import StagePace, StageSummary

DONE = (TaskState.SUCCEEDED, TaskState.UP_TO_DATE)
LOST = (TaskState.FAILED, TaskState.UPSTREAM_FAILED)


class LongTask(NamedTuple):
    """A running task about the whole job that commits a file a frame, such as a simulation."""

    made: int  # number of its files
    made_now: int  # number of these that the running attempt has made
    of: int  # number that there will be
    elapsed_s: float  # run time of the attempt [s]

    @property
    def share(self) -> float:
        """Its progress [-]."""
        return min(1.0, self.made / self.of) if self.of else 0.0

    @property
    def remaining_s(self) -> float | None:
        """Time left [s]; None before the attempt has made two files."""
        left = max(0, self.of - self.made)
        return left * self.elapsed_s / self.made_now if self.made_now >= 2 else None


class StageRow(NamedTuple):
    """A stage as the page shows it. Numbers of tasks, unless said otherwise."""

    name: str
    total: int
    done: int
    running: int
    failed: int
    blocked: int  # an input of theirs failed
    share: float  # of all that is done, what is begun of a long task included [-]
    frames: tuple[int, int] | None  # of a long task: files made, and of how many
    mean_s: float | None  # of an attempt [s]
    work_s: float | None  # one after the other, what is left [s]; None: not known yet
    remaining_s: float | None  # the same beside each other as they are now [s]; None: it does not run, or not known


class Remaining(NamedTuple):
    """Time left of a job [s]; at least so long where a stage has not shown how fast it is."""

    seconds: float
    at_least: bool


def stage_rows(
    summaries: Iterable[StageSummary],
    paces: Mapping[str, StagePace],
    long_tasks: Mapping[str, LongTask],
    busy_s: Mapping[str, float],
    window_s: float,
) -> tuple[StageRow, ...]:
    """The stages of a job, by their numbers of tasks, their speed, and their long tasks.

    `busy_s` is how long attempts of a stage took in the last `window_s`, those beside each other added up [s]; that is
    0 if nothing runs.
    """
    rows = []
    for summary in summaries:
        count = summary.counts.get
        done, lost = sum(count(state, 0) for state in DONE), [count(state, 0) for state in LOST]
        running = count(TaskState.RUNNING, 0)
        pace, long = paces.get(summary.stage), long_tasks.get(summary.stage)
        mean_s = None if pace is None else pace.mean_seconds
        left = summary.total - done - sum(lost)
        at_once = max(1.0, busy_s.get(summary.stage, 0.0) / window_s) if window_s else 1.0
        if left == 0:
            work_s: float | None = 0.0
        elif long is not None:
            work_s = long.remaining_s
        else:
            work_s = None if mean_s is None else mean_s * left
        rows.append(
            StageRow(
                name=summary.stage,
                total=summary.total,
                done=done,
                running=running,
                failed=lost[0],
                blocked=lost[1],
                share=min(1.0, (done + (long.share if long is not None else 0.0)) / summary.total),
                frames=None if long is None else (long.made, long.of),
                mean_s=mean_s,
                work_s=work_s,
                remaining_s=None if work_s is None or not running else work_s / at_once,
            )
        )
    return tuple(rows)


def remaining(rows: Iterable[StageRow], busy_s: Mapping[str, float], window_s: float) -> Remaining | None:
    """Time left of a running job; None if nothing is known of any stage that has work left.

    Work is divided by how many attempts ran beside each other lately; it is never shorter than its longest stage now.
    """
    unfinished = [row for row in rows if row.work_s is None or row.work_s > 0]
    known = [row for row in unfinished if row.work_s is not None]
    if not known:
        return None
    at_once = max(1.0, sum(busy_s.values()) / window_s) if window_s else 1.0
    seconds = sum(row.work_s or 0.0 for row in known) / at_once
    longest = max((row.remaining_s or 0.0 for row in known), default=0.0)
    return Remaining(max(seconds, longest), at_least=len(known) < len(unfinished))
