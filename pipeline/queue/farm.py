"""Running a farm's queue: one job at a time, the most urgent first, and obeying what is wanted of it meanwhile.

Whoever holds the queue's lease is the runner. It lets a job go for a more urgent one (which loses nothing: a job that
stops continues later), settles the entry of a job that has ended, and takes the next. When it dies, its jobs are still
in the queue: the next runner takes the lease over and continues them.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import NamedTuple

from pipeline.base.errors import DiskFullError, JobBusyError, LeaseLostError, PipelineError
from pipeline.base.lease import Lease, live_holder
from pipeline.queue import disk
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob, QueueError
from pipeline.run.control import RunControl
from pipeline.run.events import JobOutcome, Notice, Outcome, RunEvent, RunStarted
from pipeline.run.executors.failures import is_disk_full

START_POLL_S = 0.05
"""How often a runner that starts in the background is looked for."""
LOOK_INTERVAL_S = 0.4
"""How often a running job's entry, the queue and the disk are looked at."""
BUSY_RETRY_S = 1.0
"""After this time a job is tried again whose folder somebody else works in, such as `clean`."""
MAX_LOG_BYTES = 4 * 2**20
"""A background runner's log starts anew when it is larger."""


COMMAND: tuple[str, ...] = (sys.executable, "-P", "-m", "pipeline")
"""This program's command line for a runner in the background; no module is taken from the working folder."""


class StopReason(StrEnum):
    """Why the farm stopped a job that runs."""

    PAUSED = "paused"
    CANCELLED = "cancelled"
    YIELDED = "yielded"
    DISK_SHORT = "disk short"


class FarmControl(RunControl):
    """Stops a run, for a `reason`, when its entry, a more urgent job or the disk says so; and on signals."""

    def __init__(self, queue: JobQueue, job: QueuedJob, lease: Lease, say: Callable[[str], None]) -> None:
        super().__init__()
        self._queue = queue
        self._job = job
        self._lease = lease
        self._say = say
        self._looked = time.monotonic()
        self._asked = 0
        self.reason: StopReason | None = None

    @property
    def interruptions(self) -> int:
        """How often the run was asked to stop. Raises LeaseLostError if another process runs the queue now."""
        self._lease.check()
        now = time.monotonic()
        if now - self._looked >= LOOK_INTERVAL_S and self.reason is not StopReason.CANCELLED:
            self._looked = now
            with suppress(OSError):  # a folder that does not answer asks for nothing; the next look may see more
                self._look()
        return self._asked + self.signals

    def _look(self) -> None:
        try:
            entry = self._queue.find(self._job.name)
        except QueueError:
            return  # an entry that cannot be read now asks for nothing; `pipeline status` reports it
        if entry is None and not self._queue.is_there():
            return  # the disk is gone, which nobody asked for; the run meets that by itself
        if entry is None:
            self._stop(StopReason.CANCELLED, "cancelled: stopping at once; what is finished stays", times=2)
        elif self.reason is not None:
            return
        elif entry.desired is Desired.PAUSE:
            self._stop(StopReason.PAUSED, "asked to pause")
        elif (other := self._more_urgent(entry)) is not None:
            self._stop(StopReason.YIELDED, f"{other.name} is more urgent; {entry.name} continues after it")
        elif (shortage := disk.shortage(_disk_of(self._queue, entry), entry.reserve_bytes)) is not None:
            with suppress(QueueError, OSError):  # its entry went in this moment, or there is no room for a note
                self._queue.change(entry.name, desired=Desired.PAUSE, note=shortage)
            self._stop(StopReason.DISK_SHORT, f"{shortage}: the job pauses before the disk is full")

    def _more_urgent(self, entry: QueuedJob) -> QueuedJob | None:
        """The first job that waits, if it is more urgent and nobody works in its folder, as `clean` does."""
        waiting = self._queue.waiting()
        first = next((job for job in waiting if job.name == entry.name or _is_free(self._queue, job)), entry)
        return first if first.priority > entry.priority else None

    def _stop(self, reason: StopReason, sentence: str, *, times: int = 1) -> None:
        self.reason = reason
        self._asked = times
        self._say(sentence)


class TakeOver:
    """Observer that drops a job's text from its entry once a run has taken it over into the folder.

    A folder that is moved away between two runs is then missed, instead of being filled anew.
    """

    def __init__(self, queue: JobQueue, job: QueuedJob) -> None:
        self._queue = queue
        self._job = job
        self._started = False
        self._done = job.text is None and job.rerun_stages is None and job.rerun_frames is None

    def notify(self, event: RunEvent) -> None:
        """Take note of an event."""
        if self._done or isinstance(event, Notice):
            return
        if not self._started:
            self._started = isinstance(event, RunStarted)
            return
        # Not before the first event after the start: until then what is to run again has not been marked as such.
        with suppress(QueueError, OSError), self._queue.locked():  # it stays in the entry until the next event then
            entry = self._queue.find(self._job.name)
            if entry is not None and entry.submission == self._job.submission:
                self._queue.change(entry.name, text=None, rerun_stages=None, rerun_frames=None)
            self._done = True


class Ended(NamedTuple):
    """End of a job's turn: the outcome of its run, if any, why the farm stopped it, and what kept it from running."""

    outcome: Outcome | None
    reason: StopReason | None = None
    error: PipelineError | None = None

    @property
    def is_put_off(self) -> bool:
        """Whether it only let a more urgent job go first."""
        done = self.outcome is not None and self.outcome.kind is JobOutcome.SUCCEEDED
        return self.reason is StopReason.YIELDED and not done


@dataclass
class FarmRunner:
    """Runs the queue; its lease is held by the caller."""

    queue: JobQueue
    lease: Lease
    # runs one job, under this control, with this further observer
    run_job: Callable[[QueuedJob, FarmControl, TakeOver], Outcome]
    say: Callable[[str], None]  # takes sentences for the user
    # called with the name and folder of a job whose turn ended, and how it ended
    after_turn: Callable[[str, Path, Ended], None]
    # the submission that it runs for; it stops once that is settled. None: it runs until nothing waits
    submission: str | None = None
    _busy: dict[str, float] = field(default_factory=dict)
    _told_busy: set[str] = field(default_factory=set)

    def work(self) -> Ended | None:
        """Run jobs; returns how the last turn of the own job ended, or None if it was settled without one.

        More may have been queued meanwhile: once the lease is given back, `JobQueue.left` tells.

        Raises:
            LeaseLostError: another process runs the queue now.
            KeyboardInterrupt: a signal stopped the job of somebody else, which stays in the queue.
            Exception: a fault of this program's; the job that it struck counts as failed.
        """
        self.queue.sweep()
        own: Ended | None = None
        while True:
            self.lease.check()
            waiting = self.queue.waiting()
            if all(self.submission not in (None, job.submission) for job in waiting):
                return own
            job = next((job for job in waiting if self._busy.get(job.name, 0.0) <= time.monotonic()), None)
            if job is None:
                time.sleep(LOOK_INTERVAL_S)
                continue
            ended, stopped = self._turn(job)
            if ended is not None:
                self._tell(job, ended)
            if job.submission == self.submission and ended is not None:
                # One that let another job go first has not ended: if it is settled meanwhile, that was somebody else.
                own = None if ended.is_put_off else ended
            if stopped:
                if job.submission != self.submission:
                    raise KeyboardInterrupt
                return own

    def _turn(self, job: QueuedJob) -> tuple[Ended | None, bool]:
        """One turn of a job: how it ended (None: not begun), and whether a signal asked us to stop."""
        shortage = disk.shortage(_disk_of(self.queue, job), job.reserve_bytes)
        if shortage is not None:
            self.say(f"{job.name}: {shortage}; free some space, then: pipeline resume {job.name}")
            self._settle(job, Desired.PAUSE, shortage)
            return Ended(None, StopReason.DISK_SHORT), False
        if job.text is None and not self.queue.layout(job.name).job_file.exists():
            error = PipelineError(f"{self.queue.layout(job.name).root} is gone; take the job out: pipeline cancel")
            self._settle(job, Desired.NONE, str(error))
            return Ended(None, error=error), False
        control = FarmControl(self.queue, job, self.lease, self.say)
        try:
            outcome = self.run_job(job, control, TakeOver(self.queue, job))
        except (JobBusyError, LeaseLostError) as busy:
            self.lease.check()  # the queue's own; the job's is somebody else's now
            self._busy[job.name] = time.monotonic() + BUSY_RETRY_S
            if job.name not in self._told_busy:
                self._told_busy.add(job.name)
                self.say(f"{busy}; waiting for it")
            return None, control.signals > 0
        except PipelineError as error:
            self._settle(job, Desired.NONE, str(error))
            return Ended(None, error=error), control.signals > 0
        except OSError as error:  # of this job's folder: it ends this turn, and the others go on
            told = (
                DiskFullError.of(self.queue.layout(job.name).root)
                if is_disk_full(error)
                else PipelineError(f"{job.name}: {error}")
            )
            self._settle(job, Desired.PAUSE if isinstance(told, DiskFullError) else Desired.NONE, str(told))
            return Ended(None, error=told), control.signals > 0
        except Exception as error:
            sentence = str(error) or type(error).__name__
            self._settle(job, Desired.NONE, sentence)
            self._tell(job, Ended(None, error=PipelineError(sentence)))
            raise
        if control.reason is StopReason.YIELDED:
            self._busy.clear()  # it yields to nobody whose folder is not free
        self._settle_ended(job, control, outcome)
        return Ended(outcome, control.reason), control.signals > 0

    def _tell(self, job: QueuedJob, ended: Ended) -> None:
        self.after_turn(job.name, self.queue.layout(job.name).root, ended)

    def _settle_ended(self, job: QueuedJob, control: FarmControl, outcome: Outcome) -> None:
        match outcome.kind:
            case JobOutcome.SUCCEEDED:
                self._settle(job, None)
            case JobOutcome.FAILED | JobOutcome.TOO_MANY_FAILURES:
                first = outcome.failures[0] if outcome.failures else None
                note = f"{first.task_id}: {first.message}" if first is not None else outcome.kind.value
                self._settle(job, Desired.NONE, note)
            case JobOutcome.DISK_FULL:
                place = f" ({outcome.full_place})" if outcome.full_place else ""
                self._settle(job, Desired.PAUSE, f"the disk is full{place}")
            case JobOutcome.NO_GPU:
                self._settle(job, Desired.PAUSE, "every GPU has failed")
            case JobOutcome.OUTGROWN:
                self._settle(job, Desired.PAUSE, next(failed.message for failed in outcome.failures))
            case _ if control.signals and job.submission == self.submission:
                self._settle(job, Desired.PAUSE, "stopped by hand")
            case _:  # its entry says what is wanted: it pauses, or waits for its next turn
                pass

    def _settle(self, job: QueuedJob, desired: Desired | None, note: str = "") -> None:
        """Write down how a turn ended, unless the job has been submitted anew or cancelled meanwhile.

        `desired` is what is wanted of it from now on; None: nothing more, the entry goes.
        """
        with self.queue.locked():
            try:
                entry = self.queue.find(job.name)
            except QueueError as error:
                self.say(str(error))
                return
            if entry is None or entry.submission != job.submission:
                return
            if desired is None:
                self.queue.drop(job.name)
            else:
                self.queue.change(job.name, desired=desired, note=note)


def _is_free(queue: JobQueue, job: QueuedJob) -> bool:
    """Whether nobody works in a job's folder; of one that does not answer it counts as if somebody did."""
    try:
        return live_holder(queue.layout(job.name).lease) is None
    except OSError:
        return False


def _disk_of(queue: JobQueue, job: QueuedJob) -> Path:
    """A folder on the disk that a job is written to: its own may be a link to another disk."""
    root = queue.layout(job.name).root
    return root if root.is_dir() else queue.farm


def start_in_background(queue: JobQueue) -> int | None:
    """Start a runner that no terminal holds, unless the queue has one; returns its process id once it runs, or None.

    One that is just ending sees what was queued before this call; see `JobQueue.left`.
    """
    with queue.locked():
        if live_holder(queue.lease) is not None:
            return None
        fresh = not queue.log.exists() or queue.log.stat().st_size > MAX_LOG_BYTES
        here = Path(__file__).resolve().parents[2]  # for a program that runs from its source folder
        search_path = os.pathsep.join([os.fspath(here), *filter(None, [os.environ.get("PYTHONPATH")])])
        with queue.log.open("wb" if fresh else "ab") as log:
            child = subprocess.Popen(
                [*COMMAND, "work", "--farm", os.fspath(queue.farm.resolve())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={**os.environ, "PYTHONPATH": search_path},
            )
    while child.poll() is None and live_holder(queue.lease) is None:
        time.sleep(START_POLL_S)
    return child.pid
