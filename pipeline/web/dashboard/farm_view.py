"""View of a farm: its jobs, the state of each, and the runner of the queue. Reads only."""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

from pipeline.base.errors import ManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import LeaseHolder, live_holder
from pipeline.queue.job_queue import JobQueue, QueuedJob
from pipeline.queue.listing import state_by_record
from pipeline.queue.states import JobState, state_of
from pipeline.record.glance import Version, glance, version_of
from pipeline.record.reader import AttemptRow, LastRun, ManifestReader, StageSummary, StoredFile
from pipeline.web.dashboard.estimates import LongTask, Remaining, StageRow, remaining, stage_rows
from pipeline.web.dashboard.places import NotThereError, Places, printable

LOOK_INTERVAL_S = 0.5
"""The farm is looked at this often at most, however many pages ask."""
SETTLED_S = 2.0
"""A record that was changed longer ago than this would show another change by its times."""
WINDOW_S = 120.0
"""The pace of a job is taken from this time before now [s]."""

T = TypeVar("T")
_NO_RUN = LastRun(None, None)


class Picture(NamedTuple):
    """A committed frame, and what changes when it is drawn anew."""

    frame: int
    version: int
    is_old: bool  # whether an earlier run drew it, and it is to be drawn anew or is none of the job's any more


@dataclass(frozen=True)
class Record:
    """Contents of a job's manifest."""

    stages: tuple[StageRow, ...] = ()
    last_run: LastRun = _NO_RUN
    is_empty: bool = True  # whether nothing has been made
    running: tuple[AttemptRow, ...] = ()  # attempts that are not closed
    picture: Picture | None = None  # the newest frame; None before there is one
    pictures: int = 0
    left: Remaining | None = None  # time left; None if that is not known


@dataclass(frozen=True)
class JobCard:
    """A job as the list shows it."""

    name: str  # of its folder
    state: JobState
    entry: QueuedJob | None  # its entry in the queue, if any
    holder: LeaseHolder | None  # process that works in its folder now
    record: Record  # its manifest; an empty one if it has none
    flaw: str  # reason why its record cannot be shown; empty if it can
    changed: float  # time of its last change [s since the epoch]

    @property
    def done(self) -> int:
        """Tasks that are done."""
        return sum(stage.done for stage in self.record.stages)

    @property
    def total(self) -> int:
        """Tasks that are planned."""
        return sum(stage.total for stage in self.record.stages)

    @property
    def failed(self) -> int:
        """Tasks that failed."""
        return sum(stage.failed for stage in self.record.stages)

    @property
    def running(self) -> int:
        """Tasks that run."""
        return sum(stage.running for stage in self.record.stages)

    @property
    def share(self) -> float:
        """Progress by its tasks [-]."""
        return sum(stage.share * stage.total for stage in self.record.stages) / self.total if self.total else 0.0


@dataclass(frozen=True)
class FarmGlance:
    """The farm at a moment."""

    # in the order in which they run, those that are not in the queue after them, newest first
    jobs: tuple[JobCard, ...]
    runner: LeaseHolder | None  # process that runs the queue; None if nobody does
    flaws: tuple[str, ...]  # sentences about entries of the queue that cannot be read

    @property
    def stranded(self) -> int:
        """Number of jobs that wait although nobody runs the queue."""
        waiting = sum(job.state is JobState.QUEUED for job in self.jobs)
        return waiting if self.runner is None else 0


class Kept(Generic[T]):
    """A value that is found once for all who ask within a while. Safe to share between threads."""

    def __init__(self, find_out: Callable[[], T], interval_s: float = LOOK_INTERVAL_S) -> None:
        self._find_out = find_out
        self._interval_s = interval_s
        self._lock = threading.Lock()
        self._found: tuple[float, T] | None = None

    def get(self) -> T:
        """The last value, if it is not too old, else a new one; others wait for it meanwhile."""
        with self._lock:
            if self._found is None or time.monotonic() - self._found[0] >= self._interval_s:
                found = self._find_out()
                self._found = time.monotonic(), found
            return self._found[1]

    def forget(self) -> None:
        """Forget the value, as we have changed it."""
        with self._lock:
            self._found = None


@dataclass
class _Remembered:
    version: Version
    runs: bool
    looked: float
    record: Record
    flaw: str


@dataclass
class FarmView:
    """A view of a farm, which is `kept` for a while; records that have not changed are not read again."""

    places: Places
    spool: JobQueue
    _records: dict[str, _Remembered] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.kept = Kept(self._look)

    def glance(self) -> FarmGlance:
        """The farm as it was half a second ago, or later."""
        return self.kept.get()

    def job(self, name: str) -> JobCard:
        """One job of it. Raises NotThereError if there is none of this name."""
        card = next((job for job in self.glance().jobs if job.name == name), None)
        if card is None:
            raise NotThereError(f'there is no job "{name}" in this farm')
        return card

    def _look(self) -> FarmGlance:
        listing = self.spool.listing()
        entries = {job.name: job for job in listing.jobs}
        folders = [name for name in self._folders() if name not in entries]
        cards = [self._card(name, entries.get(name)) for name in (*entries, *folders)]
        for name in set(self._records) - {card.name for card in cards}:
            del self._records[name]
        queued = sum(card.entry is not None for card in cards)
        cards[queued:] = sorted(cards[queued:], key=lambda card: -card.changed)
        cards.sort(key=lambda card: card.state not in (JobState.RUNNING, JobState.PAUSING))
        return FarmGlance(tuple(cards), live_holder(self.spool.lease), listing.flaws)

    def _folders(self) -> list[str]:
        """Names of the folders that hold a job."""
        names = []
        with os.scandir(self.places.farm) as entries:
            for entry in entries:
                if not entry.name.startswith(".") and _holds_job(JobLayout(Path(entry.path))):
                    names.append(entry.name)
        return sorted(names)

    def _card(self, name: str, entry: QueuedJob | None) -> JobCard:
        submitted = 0.0 if entry is None else entry.submitted
        try:
            return self._card_of(name, entry, JobLayout(self.places.job(name)), submitted)
        except (NotThereError, OSError) as error:
            # Before its first run a queued job has no folder yet.
            waits = entry is not None and entry.text is not None and not os.path.lexists(self.places.farm / name)
            state = JobState.UNKNOWN if entry is None else state_of(entry, runs=False)
            shown, flaw = printable(name), "" if waits else printable(str(error))
            if shown != name:
                flaw = "the name of its folder is not UTF-8, so it can be no job's; rename it"
            return JobCard(shown, state, entry, None, Record(), flaw, submitted)

    def _card_of(self, name: str, entry: QueuedJob | None, layout: JobLayout, submitted: float) -> JobCard:
        """Raises OSError if its folder cannot be read."""
        holder = live_holder(layout.lease) if self.places.has(name, layout.lease.name) else None
        remembered = self._record(name, layout, runs=holder is not None)
        record, flaw = remembered.record, remembered.flaw
        if entry is not None:
            state = state_of(entry, runs=holder is not None)
        elif holder is None and flaw:
            state = JobState.UNKNOWN
        else:
            recording, runs = self.places.has(name, layout.recording_story.name), holder is not None
            state = state_by_record(
                layout, record.last_run, runs=runs, is_empty=record.is_empty, is_recording=recording
            )
        changed = max(submitted, remembered.version.changed_ns / 1e9)
        return JobCard(name, state, entry, holder, record, flaw, changed)

    def _record(self, name: str, layout: JobLayout, *, runs: bool) -> _Remembered:
        now = time.time()
        try:
            self.places.file(name, layout.manifest.name)
            version = version_of(layout.manifest)
        except NotThereError as error:
            flaw = str(error) if layout.manifest.is_symlink() else ""
            return _Remembered(Version(None, None), runs, now, Record(), flaw)
        known = self._records.get(name)
        if known is not None and (known.version, known.runs) == (version, runs):
            # Of a job that runs what is left grows shorter though nothing is recorded.
            is_recent = not runs or now - known.looked < 5 * SETTLED_S
            if is_recent and known.looked - version.changed_ns / 1e9 > SETTLED_S:
                return known
        try:
            record, flaw = glance(layout.manifest, lambda manifest: read_record(manifest, runs=runs)), ""
        except (ManifestError, OSError) as error:
            record, flaw = Record(), str(error)
        except ValueError as error:  # a state that a newer program has
            record, flaw = Record(), f"its record holds what this program does not know: {error}"
        self._records[name] = _Remembered(version, runs, now, record, flaw)
        return self._records[name]


def read_record(manifest: ManifestReader, *, runs: bool) -> Record:
    """Read what the list shows of a job's manifest; unless the job `runs`, open attempts are those of a killed run."""
    now = time.time()
    summaries, running = manifest.summary(), tuple(manifest.running_attempts()) if runs else ()
    picture, pictures = manifest.newest_and_count_in("frames", ".png")
    paces = manifest.stage_paces(now - WINDOW_S, now) if runs else {}
    busy_s = {pace.stage: pace.busy_s for pace in paces.values()}
    since = min((pace.busy_since for pace in paces.values() if pace.busy_since is not None), default=now)
    window_s = max(1.0, now - since) if running else 0.0
    rows = stage_rows(summaries, paces, _long_tasks(manifest, summaries, running, now), busy_s, window_s)
    if not runs:  # what a killed run left as running waits
        rows = tuple(row._replace(running=0) for row in rows)
    return Record(
        stages=rows,
        last_run=manifest.last_run(),
        is_empty=manifest.is_empty(),
        running=running,
        picture=None if picture is None else picture_of(picture),
        pictures=pictures,
        left=remaining(rows, busy_s, window_s) if runs else None,
    )


def picture_of(file: StoredFile) -> Picture | None:
    """A frame by its artifact; None if its name is no number."""
    stem = Path(file.path).stem
    return Picture(int(stem), file.mtime_ns, file.is_old) if stem.isdecimal() else None


def _long_tasks(
    manifest: ManifestReader, summaries: list[StageSummary], running: tuple[AttemptRow, ...], now: float
) -> dict[str, LongTask]:
    """Running tasks that are the only one of their stage, while others are about frames."""
    single = {summary.stage for summary in summaries if summary.total == 1}
    found = {}
    for attempt in running:
        if attempt.task in single:  # such a task is named as its stage is
            made, made_now = manifest.artifacts_of(attempt.task, since=attempt.started)
            if made:
                frames = max(manifest.frame_count(), made)
                found[str(attempt.task)] = LongTask(made, made_now, frames, now - attempt.started)
    return found


def _holds_job(layout: JobLayout) -> bool:
    """Whether a folder is that of a job; one that may not be looked into counts as one."""
    try:
        return layout.job_file.is_file() or layout.manifest.is_file()
    except PermissionError:
        return True
