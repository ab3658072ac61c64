"""The farm's queue: which jobs wait in a folder of jobs, in which order, and what is wanted of each.

The folder that holds jobs' folders is a *farm*. Its queue is `.farm/` in it: one small file for each job that waits,
runs, pauses or has failed, and the lease of the process that runs the queue. A finished job leaves no file.

An entry says what is *wanted*, not what is done. A command changes the entry, and whoever runs the job looks at it a
few times a second: a job that is to pause pauses, one whose entry is gone is cancelled. Every change is one atomic
rename under a lock that the kernel drops with its holder: a crash in the middle of one leaves the old entry or the new
one.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import threading
import time
import unicodedata
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, Field, TypeAdapter

from pipeline.base.errors import NO_LOCKS, PipelineError
from pipeline.base.files import holds, open_regular, replace_durably, sync
from pipeline.base.layout import JobLayout

MAX_ENTRY_BYTES = 40 * 2**20
"""Over twice the largest job file, as JSON may write it."""
MAX_NAME_BYTES = 200
"""A folder's name becomes a file's, with an ending."""
LATEST_S = 1e11
"""No wall time of a submission is later [s since the epoch]."""
ABANDONED_S = 60.0
"""A file that is being written and older than this is nobody's any more."""
UNSEEN_RETRY_S = 0.1
"""How soon a file is looked for again that another host has made and this one cannot see yet."""
SETTLED_S = 2.0
"""A file that was changed longer ago than this would show another change by its time of modification."""


class Desired(StrEnum):
    """What is wanted of a job in the queue."""

    RUN = "run"
    PAUSE = "pause"
    NONE = "none"
    """It failed; nobody has asked for another try."""


class QueueError(PipelineError):
    """The queue cannot be used as asked: no such entry, or one that cannot be read."""


@dataclass(frozen=True, slots=True)
class QueuedJob:
    """One job in the queue."""

    name: str  # name of its folder in the farm
    submission: str  # names this submission; a new one is drawn when the job is to run (again)
    desired: Desired = Desired.RUN
    priority: int = 0  # higher ones go first, and interrupt lower ones
    # when it was submitted, by the clock of the queue's file system [s since the epoch]; the older of equals goes first
    submitted: Annotated[float, Field(ge=0.0, lt=LATEST_S, allow_inf_nan=False)] = 0.0
    note: str = ""  # why it pauses or failed, or empty
    text: str | None = None  # its job file, until a run has taken it over into the folder; None: what is in the folder
    # with `rerun_frames`, tasks to run again although they are up to date; None: none
    rerun_stages: tuple[str, ...] | None = None
    rerun_frames: tuple[int, ...] | None = None  # see `rerun_stages`
    until: tuple[str, ...] = ()  # the stages after which it ends; empty: the film
    cores: int | None = None  # processor cores to use at most; None: all
    # free disk space at which it pauses [bytes]; None: the usual, see `pipeline.queue.disk`
    reserve_bytes: int | None = None
    background: bool = False  # whether it needs a process of its own in the background, as no terminal waits for it
    # further options of the command that submitted it, by name; those who run the job know them
    settings: tuple[tuple[str, str], ...] = ()

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(strict=True, extra="forbid")

    def again(self, **changes: Any) -> QueuedJob:
        """A new submission of it, to run, with these fields changed."""
        now = time.time()
        return replace(self, submission=new_submission(), desired=Desired.RUN, note="", submitted=now, **changes)

    def to_json(self) -> str:
        """The entry file's text."""
        return json.dumps(asdict(self), indent=1, sort_keys=True) + "\n"

    @staticmethod
    def from_json(text: str) -> QueuedJob:
        """Read an entry file's text. Raises QueueError with the reason if it is none."""
        try:
            return _reader().validate_json(text)
        except ValueError as error:
            raise QueueError(f"not an entry: {str(error).replace(chr(10), ' '):.300}") from None


@cache
def _reader() -> TypeAdapter[QueuedJob]:
    """Reads entries: every field of its type and in its bounds, and no other."""
    return TypeAdapter(QueuedJob)


@dataclass(frozen=True, slots=True)
class Listing:
    """The entries of a queue, in the order in which they run, and a sentence about each file that is no entry."""

    jobs: tuple[QueuedJob, ...]
    flaws: tuple[str, ...]


class JobQueue:
    """The queue of one farm, for any threads. Reading needs no lock; changes take it themselves, or join `locked`."""

    def __init__(self, farm: Path) -> None:
        self.farm = farm
        self.folder = farm / ".farm"
        self._mutex = threading.RLock()
        self._is_locked = False
        self._now_s = 0.0  # when the lock was taken, by the file system's clock: machines' clocks need not agree
        self._read: dict[str, tuple[tuple[int, int, int], QueuedJob]] = {}

    @property
    def lease(self) -> Path:
        """Who runs the queue right now."""
        return self.folder / "runner.lease"

    @property
    def log(self) -> Path:
        """What a runner in the background prints."""
        return self.folder / "runner.log"

    @classmethod
    def of(cls, layout: JobLayout) -> JobQueue:
        """The queue of the farm that a job's folder lies in."""
        return cls(layout.root.absolute().parent)

    def layout(self, name: str) -> JobLayout:
        """The folder of a job in this farm."""
        return JobLayout(self.farm / checked_name(name))

    def make(self) -> None:
        """Make the queue's folders, if they are not there. Raises OSError."""
        if not self._entries.is_dir():
            self._entries.mkdir(parents=True, exist_ok=True)
            sync(self.farm)
            sync(self.folder)

    def is_there(self) -> bool:
        """Whether there is a queue; it may be empty."""
        return self._entries.is_dir()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Exclude every other change of the queue, in all processes and threads, for the block; a thread may nest it.

        Raises QueueError: the farm cannot be written to, or its file system has no locks.
        """
        with self._mutex:  # the kernel's lock keeps processes out, not the threads of this one
            if self._is_locked:
                yield
                return
            descriptor = self._lock()
            self._is_locked = True
            try:
                yield
            finally:
                self._is_locked = False
                os.close(descriptor)

    def _lock(self) -> int:
        """A descriptor whose closing drops the lock that keeps other processes out."""
        try:
            self.make()
            descriptor = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            if error.errno not in {errno.EACCES, errno.EPERM, errno.EROFS}:
                raise
            raise QueueError(
                f"cannot write to {self.folder}: {error.strerror}; the queue lies there, so the folder that holds the "
                "jobs' folders must be writable"
            ) from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            os.utime(descriptor)
            self._now_s = os.fstat(descriptor).st_mtime
        except BaseException as error:
            os.close(descriptor)
            if isinstance(error, OSError) and error.errno in NO_LOCKS:
                raise QueueError(f"{self.farm}: this file system has no locks (flock); use another folder") from error
            raise
        return descriptor

    # --- looking ---
    def listing(self) -> Listing:
        """Every entry, first to run first; what cannot be read as one is reported, and left alone."""
        jobs, flaws = [], []
        for path in self._paths():
            try:
                jobs.append(self.find(path.name.removesuffix(".json")))
            except QueueError as error:
                flaws.append(str(error))
        in_turn = sorted(filter(None, jobs), key=lambda job: (-job.priority, job.submitted, job.name))
        return Listing(tuple(in_turn), tuple(flaws))

    def find(self, name: str) -> QueuedJob | None:
        """The entry of a job, or None if it has none. Raises QueueError for a file in its place that is no entry."""
        path = self._path(name)
        try:
            known = self._read.get(name)
            # Under the lock what is read counts: hosts that share the folder remember attributes for seconds.
            if known is not None and not self._is_locked and known[0] == _version(path.stat()):
                return known[1]
            with open_regular(path) as file:
                status = os.fstat(file.fileno())
                content = file.read(MAX_ENTRY_BYTES + 1)
            if len(content) > MAX_ENTRY_BYTES:
                raise QueueError(f"not an entry: more than {MAX_ENTRY_BYTES >> 20} MiB")
            job = QueuedJob.from_json(content.decode())
            if job.name != name:
                raise QueueError(f'not an entry: of a job "{job.name}"')
        except FileNotFoundError:
            return None
        except (QueueError, UnicodeDecodeError) as error:
            flaw = error if isinstance(error, QueueError) else "not an entry: not UTF-8"
            raise QueueError(f"{path}: {flaw}; remove it, and submit the job again") from None
        if time.time() - status.st_mtime > SETTLED_S:  # entries are looked at often, and seldom change
            self._read[name] = (_version(status), job)
        return job

    def priority_of(self, name: str) -> int:
        """The priority that a job has in the queue; 0 if it is not in it."""
        with suppress(QueueError):
            job = self.find(name)
            return 0 if job is None else job.priority
        return 0

    def waiting(self) -> tuple[QueuedJob, ...]:
        """The jobs that are to run, first to run first; a running one is among them."""
        return tuple(job for job in self.listing().jobs if job.desired is Desired.RUN)

    def left(self) -> tuple[QueuedJob, ...]:
        """The jobs that wait, whatever this host remembers of the folder.

        Whoever stops running the queue looks here once the lease is given back, and whoever queues a job looks at the
        lease after that: one of the two sees the other, on whatever hosts they are.
        """
        if not self.is_there():
            return ()
        with self.locked():
            while True:
                os.utime(self._entries)  # a client reads the names in a folder anew that it has changed
                with suppress(FileNotFoundError):
                    for path in self._paths():
                        path.lstat()
                    return self.waiting()
                time.sleep(UNSEEN_RETRY_S)  # this host still remembers that there was no such file

    # --- changing ---
    def put(self, job: QueuedJob) -> None:
        """Write a job's entry, durably; an older one is replaced. Raises OSError."""
        with self.locked():
            replace_durably(self._path(job.name), job.to_json())

    def drop(self, name: str) -> bool:
        """Remove a job's entry; returns whether there was one."""
        with self.locked():
            try:
                self._path(name).unlink()
            except FileNotFoundError:
                return False
            sync(self._entries)
            return True

    def enqueue(self, new: QueuedJob) -> QueuedJob:
        """Queue a job to run: what an older entry of it says is replaced, but for its place among equals.

        Returns the entry as it is now; with the older one's submission if that asks for the very same run already.
        """
        with self.locked():
            new = replace(new, submitted=self._now_s)
            try:
                old = self.find(new.name)
            except QueueError:
                old = None  # it is replaced by a good one
            if old is not None and new.text is None:
                new = replace(new, text=old.text)  # a version that waits to be taken over stays the newest
            is_known = new.text is not None and holds(self.layout(new.name).job_file, new.text)
            if old is not None and old.text is None and is_known:
                new = replace(new, text=None)
            if old is not None and old.desired is Desired.RUN:
                new = replace(new, submitted=old.submitted, background=new.background or old.background)
                if replace(new, submission=old.submission, priority=old.priority, background=old.background) == old:
                    new = replace(new, submission=old.submission)
            if new != old:
                self.put(new)
        return new

    def change(self, name: str, **changes: Any) -> QueuedJob:
        """Change fields of a job's entry. Raises QueueError if the job has none."""
        with self.locked():
            job = self.find(name)
            if job is None:
                raise QueueError(f'"{name}" is not in the queue of {self.farm}')
            changed = replace(job, **changes)
            if changed != job:
                self.put(changed)
        return changed

    def sweep(self) -> None:
        """Remove what killed writers left beside the entries."""
        with self.locked():  # so nobody on this machine is writing
            for path in self._entries.glob(".*.part.*"):
                with suppress(FileNotFoundError):
                    if self._now_s - path.stat().st_mtime > ABANDONED_S:
                        path.unlink()

    @property
    def _entries(self) -> Path:
        return self.folder / "queue"

    def _paths(self) -> list[Path]:
        return sorted(self._entries.glob("[!.]*.json")) if self._entries.is_dir() else []

    def _path(self, name: str) -> Path:
        return self._entries / f"{checked_name(name)}.json"


def _version(status: os.stat_result) -> tuple[int, int, int]:
    """What changes with a file's content, as files are replaced here."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def checked_name(name: str) -> str:
    """The name, if it can be that of a job's folder, right in the farm and visible; else raises QueueError."""
    # Control characters, and surrogates: bytes of a file's name that are no UTF-8.
    unfit = any(unicodedata.category(character) in {"Cc", "Cs"} for character in name)
    if unfit or not name or name.startswith(".") or "/" in name or len(name.encode()) > MAX_NAME_BYTES:
        raise QueueError(f"{name!a:.80} cannot be the name of a job's folder")
    return name


def new_submission() -> str:
    """A name that no other submission has."""
    return uuid.uuid4().hex


def new_entry(name: str, **fields: Any) -> QueuedJob:
    """A new entry, submitted now."""
    return QueuedJob(name=checked_name(name), submission=new_submission(), submitted=time.time(), **fields)
