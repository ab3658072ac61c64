"""What a person asks of a run: which tasks to run again, and to stop."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from pipeline.errors import PlanError
from pipeline.task import Task, TaskId


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
            PlanError: there are none.
        """
        chosen = frozenset(
            task.id
            for task in tasks
            if (not self.stages or task.stage in self.stages) and (self.frames is None or task.frame in self.frames)
        )
        if not chosen:
            known = ", ".join(dict.fromkeys(task.stage for task in tasks))
            raise PlanError(f"nothing to run again: no task has such a stage and frame; the stages are {known}")
        return chosen


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
