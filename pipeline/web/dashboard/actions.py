"""Actions on jobs: the buttons of each state, their hints, and carrying them out."""

import threading
import time
from typing import NamedTuple

import psutil

from pipeline.base.errors import PipelineError
from pipeline.base.lease import live_holder
from pipeline.queue.changes import another_try, cancel_job, continuation, pause_job, set_priority
from pipeline.queue.farm import start_in_background
from pipeline.queue.job_queue import JobQueue
from pipeline.queue.states import JobState
from pipeline.web.dashboard.farm_view import JobCard

MOST_PRIORITY = 1000
"""As on the command line."""
START_S = 60.0
"""A runner that has not taken the queue after this time [s] does not start."""


class Action(NamedTuple):
    """A button."""

    key: str  # names it in addresses
    label: str  # what is on it
    hint: str  # its effect, in a sentence
    confirm: str = ""  # question that is asked before; empty: none


def actions_of(card: JobCard, *, has_runner: bool) -> tuple[Action, ...]:
    """The buttons of a job; `has_runner`: somebody runs the queue."""
    state, queued = card.state, card.entry is not None
    turn = "It goes on when its turn comes." if has_runner else "Nobody runs the queue: a runner starts for it."
    resume = Action("resume", "Resume", turn)
    if state in (JobState.RECORDED, JobState.NOT_STARTED):
        resume = Action("resume", "Start", turn.replace("goes on", "begins"))
    retry = Action("retry", "Retry", f"The failed tasks are tried again. {turn}")
    pause = Action(
        "pause",
        "Pause",
        "What runs is finished first, and a simulation writes a checkpoint."
        if state is JobState.RUNNING
        else "It waits until it is resumed; other jobs go on.",
    )
    what = "stops at once" if state in (JobState.RUNNING, JobState.PAUSING) else "leaves the queue"
    cancel = Action(
        "cancel",
        "Cancel",
        f"It {what}. What is finished stays.",
        f"{card.name} {what}. What is finished stays, and resuming continues from there.",
    )
    match state:
        case JobState.RUNNING if queued:
            again = Action("retry", "Retry", "Failed tasks are tried again as soon as the others have ended.")
            return (pause, *([again] if card.failed else []), cancel)
        case JobState.QUEUED:
            return (pause, cancel)
        case JobState.PAUSED | JobState.PAUSING:
            return (resume, cancel)
        case JobState.FAILED if queued:
            return (retry, cancel)
        case JobState.FAILED | JobState.INTERRUPTED | JobState.STOPPED | JobState.RECORDED | JobState.NOT_STARTED:
            return (resume,)
        case _:
            return (cancel,) if queued else ()


class Queue:
    """The queue behind the buttons, and its runners, known from their start on, before they hold the lease.

    Safe to share between threads.
    """

    def __init__(self, spool: JobQueue) -> None:
        self.spool = spool
        self._starting = threading.Lock()
        self._started: tuple[int, float] | None = None

    def act(self, name: str, action: str, value: str) -> str:
        """Carry out an action of a job, by its key, or set its priority; returns the outcome in a sentence.

        Raises:
            PipelineError: it cannot be done; says why.
            OSError: the farm cannot be written to.
        """
        match action:
            case "pause":
                return f"{name} pauses{' as soon as what runs is finished' if pause_job(self.spool, name) else ''}"
            case "cancel":
                cancel_job(self.spool, name)
                return f"{name} is cancelled; what is finished stays"
            case "resume":
                entry, note = continuation(self.spool, name)
                self.spool.enqueue(entry)
                return f"{f'{note}; ' if note else ''}{name} is queued{self.run()}"
            case "retry":
                self.spool.enqueue(another_try(self.spool, name, background=True))
                return f"{name} is queued to try again{self.run()}"
            case "priority":
                set_priority(self.spool, name, _priority(value))
                return f"{name} has priority {_priority(value)}"
            case _:
                raise PipelineError(f"a job cannot be asked to {action!a:.40}")

    def run(self) -> str:
        """Start a runner in the background if there is none; returns the end of a sentence about it."""
        with self._starting:
            if self.is_starting:
                return "; a runner is starting"
            pid = start_in_background(self.spool)
            if pid is None:
                return "; the runner takes it when its turn comes"
            self._started = pid, time.monotonic()
        return f"; a runner was started, process {pid}"

    @property
    def is_starting(self) -> bool:
        """Whether a runner that was started here lives, and may not hold the queue's lease yet."""
        started = self._started
        if started is None:
            return False
        pid, began = started
        try:
            lives = psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            lives = False
        return lives and time.monotonic() - began <= START_S and live_holder(self.spool.lease) is None


def _priority(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = MOST_PRIORITY + 1
    if abs(value) > MOST_PRIORITY:
        raise PipelineError(f"a priority is a whole number from -{MOST_PRIORITY} to {MOST_PRIORITY}")
    return value
