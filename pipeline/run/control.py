"""What a person asks of a run: which tasks to run again, and to stop."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from pipeline.base.errors import PlanError
from pipeline.base.signals import signals_to
from pipeline.base.task import Task, TaskId
from pipeline.model.problems import suggestion
from pipeline.run.plan import frame_ranges


@dataclass(frozen=True, slots=True)
class Selection:
    """Tasks to run again although they are up to date."""

    stages: frozenset[str] = frozenset()  # names of the stages; empty: of all
    # their frames; None: all. Tasks about the whole job have no frame, and are not selected by one
    frames: frozenset[int] | None = None

    def of(self, tasks: Sequence[Task]) -> frozenset[TaskId]:
        """The selected ones of these tasks. Raises PlanError for each stage or frame that the plan lacks."""
        known = [*dict.fromkeys(task.stage for task in tasks)]
        unknown = sorted(self.stages - set(known))
        if unknown:
            names = "; ".join(f'no stage "{name}" in this job{suggestion(name, known)}' for name in unknown)
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


class RunControl:
    """How a person stops a run; safe to call from signal handlers and other threads."""

    def __init__(self) -> None:
        self.signals = 0

    def interrupt(self) -> None:
        """Once: finish what runs, and stop. Twice: stop at once. Either way the next run continues."""
        self.signals += 1

    @property
    def interruptions(self) -> int:
        """How often the run was asked to stop, by whomever."""
        return self.signals

    @contextmanager
    def on_signals(self) -> Iterator[None]:
        """Take SIGINT and SIGTERM for interruptions, inside the block; only the main thread can."""
        is_main = threading.current_thread() is threading.main_thread()
        with signals_to(lambda *_: self.interrupt()) if is_main else nullcontext():
            yield
