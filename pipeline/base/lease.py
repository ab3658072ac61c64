"""The lease: which process runs a job's folder right now.

The holder is named in a small file: machine, boot, process and the process's start time, so that a number that was
given to another process later is not mistaken for it. The file's modification time is the heartbeat. Whoever changes
the file holds a `flock` on a guard file beside it meanwhile, so of two that race one finds the other's name. Locks of
a network file system may end at the machine, so machines race for a name instead: a free lease is had by the first
hard link of that name, and a dead holder is succeeded by whoever first makes the name that only its successor may
have. Nothing here has to be deleted by a person: the kernel drops the guard with its process, and a dead holder is
taken over. A thread of the holder's keeps the heartbeat going, whatever the holder is busy with.

On the same machine the process itself is looked for, so a holder that is stopped or slow keeps its lease and a dead
one loses it at once. On another machine (or in another container) only the heartbeat can be seen. Its age is taken
between two times of the same file system, the heartbeat's and that of touching the guard, so clocks of machines that
do not agree do not matter.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import platform
import threading
import time
import uuid
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import psutil

from pipeline.base import wording
from pipeline.base.errors import NO_LOCKS, FolderGoneError, JobBusyError, LeaseLostError, PipelineError

HEARTBEAT_INTERVAL_S = 5.0  # how often a holder says that it is alive

EXPIRY_S = 60.0
"""Age of the heartbeat at which a holder on another machine counts as dead: a dozen heartbeats missed in a row."""

_RACE_RETRY_S = 0.05
"""How soon a lease is looked at again that another machine is about to change."""

_LEGIBLE_S = 1.0
"""How long a lease is read again whose holder is not legible: it may be changing just now."""

_NO_HARD_LINKS = NO_LOCKS | {errno.EPERM, errno.EMLINK}
"""Codes of an OSError of `link` where a file system has no hard links."""


@dataclass(frozen=True, slots=True)
class LeaseHolder:
    """The process that holds a lease."""

    host: str
    boot_id: str  # of the machine's last start
    pid_namespace: str  # the set of processes in which `pid` means something; containers have their own
    pid: int
    process_start: str  # as the kernel counts; with `pid` it identifies the process
    token: str  # unique to this lease
    acquired: float  # wall time [s since the epoch]

    @classmethod
    def this_process(cls) -> LeaseHolder:
        """A new lease of the calling process."""
        pid = os.getpid()
        process_start = _process_start(pid)
        assert process_start is not None
        return cls(
            host=platform.node(),
            boot_id=_boot_id(),
            pid_namespace=_pid_namespace(),
            pid=pid,
            process_start=process_start,
            token=uuid.uuid4().hex,
            acquired=time.time(),
        )


class Lease:
    """A lease that this process holds; a context manager that keeps its heartbeat going, and gives it back.

    `takeover` is a sentence, if the lease of a dead holder was taken over; else None.
    """

    def __init__(self, path: Path, holder: LeaseHolder, takeover: str | None) -> None:
        self._path = path
        self._folder = os.open(path.parent, os.O_RDONLY | os.O_CLOEXEC)  # the way to the file where it is renamed
        self._loss: FolderGoneError | LeaseLostError | None = None
        self._renewed = time.monotonic()  # when the heartbeat was last known to be written
        self._given_back = threading.Event()
        self._beating: threading.Thread | None = None
        self.holder = holder
        self.takeover = takeover

    @classmethod
    def acquire(cls, path: Path) -> Self:
        """Take the lease of this file, whose folder is there.

        Raises:
            JobBusyError: a live process holds it.
            PipelineError: the file system has no locks.
        """
        try:
            return cls(path, *_take(path))
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            raise PipelineError(f"{path.parent}: this file system has no locks (flock); use another folder") from error

    def heartbeat(self) -> None:
        """Say that the holder is alive; inside the context a thread does, every HEARTBEAT_INTERVAL_S.

        Raises:
            FolderGoneError: the folder is not there any more; see `look`.
            LeaseLostError: somebody has taken the job over. Stop at once, and write no record any more.
        """
        self.look()
        with _guard(self._path):
            if not self._is_mine():
                successor = read_holder(self._path)
                who = "another process, which has ended" if successor is None else _describe(successor)
                raise LeaseLostError(f"{self._path.parent} was taken over by {who} while this process did not answer")
            began = time.monotonic()
            os.utime(self._path)
        self._renewed = began

    def check(self) -> None:
        """Make sure that the lease was still ours at the last heartbeat; costs nothing while the heart beats.

        Raises FolderGoneError, LeaseLostError: see `heartbeat`.
        """
        if self._loss is None and self._is_overdue():  # this process was stopped, or its file system did not answer
            self._renew()
        if self._loss is not None:
            raise self._loss

    def look(self) -> None:
        """Make sure that the folder is still there. Raises FolderGoneError: stop, and make no new one."""
        if not self._path.parent.is_dir():
            raise FolderGoneError.of(self._path.parent)

    def _is_overdue(self) -> bool:
        return time.monotonic() - self._renewed > EXPIRY_S

    def _renew(self) -> None:
        try:
            self.heartbeat()
        except (FolderGoneError, LeaseLostError) as loss:
            self._loss = loss
        except OSError as error:
            # A file system that does not answer may do so the next time; until then others may count us alive.
            if self._is_overdue():
                self._loss = LeaseLostError(f"{self._path} could not be renewed for {EXPIRY_S:.0f} s: {error}")

    def _beat(self) -> None:
        """Keep the heartbeat going until the lease is given back or lost."""
        while self._loss is None and not self._given_back.wait(HEARTBEAT_INTERVAL_S):
            self._renew()

    def release(self) -> None:
        """Give the lease back; one that somebody else has taken over, or may be about to, is left alone."""
        try:
            self.look()
        except FolderGoneError:
            if not self._is_overdue():
                os.unlink(self._path.name, dir_fd=self._folder)
            return
        with _guard(self._path):
            if self._is_mine() and not self._is_overdue():
                self._path.unlink()

    def _is_mine(self) -> bool:
        holder = read_holder(self._path)
        return holder is not None and holder.token == self.holder.token

    def __enter__(self) -> Self:
        self._beating = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._beating.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._given_back.set()
        if self._beating is not None:
            self._beating.join()
        with suppress(OSError):  # a folder that refuses; once this process has ended, the lease counts for nothing
            self.release()
        os.close(self._folder)


def _take(path: Path) -> tuple[LeaseHolder, str | None]:
    """Write this process's name into a lease's file, unless a live one's is there; see `Lease.acquire`."""
    mine = LeaseHolder.this_process()
    part = path.with_name(f".{path.name}.part.{int(mine.token, 16)}")
    until = time.monotonic() + _LEGIBLE_S
    with _guard(path) as now_s:
        try:
            while True:
                # Written anew in each turn, as a run that begins elsewhere sweeps what others have begun to write.
                part.write_text(json.dumps(asdict(mine), indent=1) + "\n")
                try:
                    age_s = now_s - path.stat().st_mtime
                except FileNotFoundError:
                    if _gets_name(part, path):
                        return mine, None
                else:
                    holder = read_holder(path)
                    evidence = _evidence_of_death(holder, age_s=age_s)
                    if evidence is None and (holder is not None or time.monotonic() > until):
                        raise busy_error(path, holder)
                    if evidence is not None and _succeeds(part, path, holder, now_s=now_s):
                        return mine, f"taking over from {_describe(holder)}: {evidence}"
                time.sleep(_RACE_RETRY_S)  # another machine was quicker, or is about to be; the next look shows it
        finally:
            part.unlink(missing_ok=True)


def _succeeds(part: Path, path: Path, dead: LeaseHolder | None, *, now_s: float) -> bool:
    """Put `part` in the place of a dead holder's lease, unless another machine does so, or has done it."""
    claim = path.with_name(f".{path.name}.successor.part.{zlib.crc32(repr(dead).encode())}")
    if not _gets_name(part, claim):
        with suppress(FileNotFoundError):
            if _evidence_of_death(read_holder(claim), age_s=now_s - claim.stat().st_mtime) is not None:
                claim.unlink()
        return False
    if read_holder(path) != dead:  # it was succeeded just before
        claim.unlink()
        return False
    claim.replace(path)
    return True


def _gets_name(part: Path, name: Path) -> bool:
    """Give a file a further name; False if that is in use, by the file system itself and not by what is cached."""
    try:
        os.link(part, name)
    except (FileExistsError, FileNotFoundError):
        return False
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        try:
            with name.open("x") as file:
                file.write(part.read_text())
        except FileExistsError:
            return False
    return True


def read_holder(path: Path) -> LeaseHolder | None:
    """Holder named in a lease's file, dead or alive; None if there is none, or none that can be read."""
    try:
        return LeaseHolder(**json.loads(path.read_text()))
    except (FileNotFoundError, ValueError, TypeError):
        return None


def live_holder(path: Path) -> LeaseHolder | None:
    """The live process that holds a lease, or None: for `status`, which changes nothing but the guard's times.

    Where it may not even do that, the heartbeat's age is taken by this machine's clock.
    """
    holder = read_holder(path)
    if holder is None:
        return None
    guard, now_s = _guard_file(path), time.time()
    with suppress(OSError):
        os.utime(guard, follow_symlinks=False)
        now_s = guard.lstat().st_mtime
    try:
        age_s = now_s - path.stat().st_mtime
    except FileNotFoundError:
        return None
    return holder if _evidence_of_death(holder, age_s=age_s) is None else None


def refuse_if_held(path: Path) -> None:
    """Raise JobBusyError if a live process holds a lease."""
    holder = live_holder(path)
    if holder is not None:
        raise busy_error(path, holder)


def busy_error(path: Path, holder: LeaseHolder | None) -> JobBusyError:
    """The error that says who runs what this lease is about."""
    since = "" if holder is None else f" since {wording.moment(holder.acquired)}"
    return JobBusyError(f"{path.parent} is being run already, by {_describe(holder)}{since}")


def remove_guard(path: Path) -> None:
    """Remove the guard file of a lease, unless somebody holds the lease: the last step before its folder goes."""
    with _guard(path):
        if not path.exists():
            _guard_file(path).unlink()


def _evidence_of_death(holder: LeaseHolder | None, *, age_s: float) -> str | None:
    """Why the holder counts as dead, or None if it may be alive."""
    if holder is None:  # a machine of another kind wrote it, or the power was cut
        return f"its name is not legible, and is {age_s:.0f} s old" if age_s > EXPIRY_S else None
    uptime_s = time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))
    if holder.host == platform.node() and holder.boot_id != _boot_id() and age_s > uptime_s:
        # Its last heartbeat is older than this boot. (A live one of another machine that has the same name is not.)
        return "the machine was restarted since"
    if (holder.boot_id, holder.pid_namespace) == (_boot_id(), _pid_namespace()):
        process_start = _process_start(holder.pid)
        if process_start is None:
            return "the process is gone"
        return None if process_start == holder.process_start else "its number belongs to another process now"
    return f"it has not been heard of for {age_s:.0f} s" if age_s > EXPIRY_S else None


@contextmanager
def _guard(path: Path) -> Iterator[float]:
    """Exclude all others that read and change this lease; yields the file system's present time [s]."""
    while True:
        descriptor = os.open(_guard_file(path), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            if not _is_at(descriptor, _guard_file(path)):
                continue  # removed while we waited for it, by `remove_guard`: it guards nothing any more
            os.utime(descriptor)
            yield os.fstat(descriptor).st_mtime
            return
        finally:
            os.close(descriptor)


def _guard_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.guard")


def _is_at(descriptor: int, path: Path) -> bool:
    """Whether an open file is still the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False


def _process_start(pid: int) -> str | None:
    """When a process started, in a form that stays the same for its life; None if there is no such process any more.

    Linux counts ticks since boot. Elsewhere it is wall time, rounded, as it is derived again each time.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except (FileNotFoundError, ProcessLookupError):
        if Path("/proc/self/stat").exists():
            return None
    else:
        state, start_ticks = fields[0], fields[19]  # man proc_pid_stat: fields 3 and 22
        return None if state in "ZX" else start_ticks
    try:
        return str(round(psutil.Process(pid).create_time()))
    except psutil.NoSuchProcess:
        return None


def _boot_id() -> str:
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text().strip() if path.exists() else str(round(psutil.boot_time()))


def _pid_namespace() -> str:
    path = Path("/proc/self/ns/pid")
    return str(path.readlink()) if path.is_symlink() else platform.node()


def _describe(holder: LeaseHolder | None) -> str:
    return "an unknown process" if holder is None else f"process {holder.pid} on {holder.host}"
