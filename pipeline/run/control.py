"""What a person asks of a run: which tasks to run again, and to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from types import FrameType

from pipeline.base.errors import PlanError
from pipeline.base.task import Task, TaskId
from pipeline.run.plan import frame_ranges


@dataclass(frozen=True, slots=True)
class Selection:
    """Tasks to run again although they are up to date.

    Attributes:
        stages: names of the stages; empty: of all.
        frames: their frames; None: all. Tasks about the whole job have no frame, and are not selected by one.
    """

    stages: frozenset[str] = frozenset()
    frames: frozenset[int] | None = None

    def of(self, tasks: Sequence[Task]) -> frozenset[TaskId]:
        """The selected ones of these tasks.

        Raises:
            PlanError: a stage or a frame is not in the plan, or a stage has no frames; says so of each.
        """
        known = [*dict.fromkeys(task.stage for task in tasks)]
        unknown = sorted(self.stages - set(known))
        if unknown:
            names = "; ".join(f'no stage "{name}" in this job{_nearest(name, known)}' for name in unknown)
            raise PlanError(f"{names}; the stages are {', '.join(known)}")
        chosen = [task for task in tasks if not self.stages or task.stage in self.stages]
        if self.frames is not None:
            self._check_frames(chosen, self.frames)
            chosen = [task for task in chosen if task.frame in self.frames]
        return frozenset(task.id for task in chosen)

    def _check_frames(self, tasks: Sequence[Task], frames: frozenset[int]) -> None:
        planned = {task.frame for task in tasks if task.frame is not None}
        whole = sorted(self.stages - {task.stage for task in tasks if task.frame is not None})
        if whole:
            raise PlanError(f"{', '.join(whole)}: about the whole job, has no frames to choose from; leave them out")
        outside = frames - planned
        if outside:
            told = frame_ranges(outside, range(max(outside) + 1))
            theirs = frame_ranges(planned, planned)
            raise PlanError(
                f"no frame {told} in this job; the frames are {theirs}" if theirs else "there are no frames"
            )


def _nearest(name: str, names: Sequence[str]) -> str:
    close = get_close_matches(name, names, n=1)
    return f'; did you mean "{close[0]}"?' if close else ""


class RunControl:
    """How a person stops a run; safe to call from signal handlers and other threads."""

    def __init__(self) -> None:
        self._interruptions = 0

    def interrupt(self) -> None:
        """Once: finish what runs, and stop. Twice: stop at once. Either way the next run continues."""
        self._interruptions += 1

    @property
    def interruptions(self) -> int:
        """How often it was interrupted."""
        return self._interruptions

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Take SIGINT and SIGTERM for interruptions, inside the block; only the main thread can."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def interrupt(_number: int, _frame: FrameType | None) -> None:
            self.interrupt()

        before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
