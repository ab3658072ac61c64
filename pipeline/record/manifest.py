"""The manifest: the record of a job's tasks, attempts and artifacts, in one SQLite file.

One process writes, the holder of the job's lease, over one connection and from one thread; everybody else reads
(`Manifest.open_readonly`). Workers never open it: what they commit stands in receipts, and the runner records it.

What must outlive a power cut (attempts, artifacts, the plan) is synced at its commit. Task states and events are not:
the next run works states out again. Either way a killed process loses nothing that was written.
"""

import errno
import json
import os
import platform
import shutil
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Self
from uuid import uuid4

import psutil

from pipeline.base.errors import LeaseLostError, ManifestError
from pipeline.base.files import sync
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath, FailureKind, Task, TaskId, TaskState
from pipeline.record.migrations import migrate
from pipeline.record.reader import (
    BUSY_TIMEOUT_S,
    SUCCEEDED,
    ArtifactRow,
    ManifestReader,
    clear_errors,
    damaged,
    is_busy,
    is_damage,
    result_code,
)
from pipeline.store.receipts import Receipt

_NETWORK_FILE_SYSTEMS = {
    *("nfs", "nfs3", "nfs4", "cifs", "smb2", "smb3", "smbfs", "afs", "afpfs", "webdav"),
    *("ceph", "glusterfs", "lustre", "beegfs", "gpfs", "ocfs2", "gfs2"),
    *("9p", "virtiofs"),  # a host's folder in a virtual machine: the host may write it as well
}

NETWORK_TIMEOUT_S = 180.0
"""How long to wait for the lock of another process on a network file system: its server drops those of a machine that
died only after a while, which is 90 s for NFS."""


_MOVED = 1032  # SQLITE_READONLY_DBMOVED: another file has the name of the one that is open


class Manifest(ManifestReader):
    """The record, open for writing."""

    def __init__(self, path: Path) -> None:
        """Open the manifest at `path`; makes a new one, or brings an older one to the present schema.

        Raises:
            ManifestError: it is damaged (the text names the remedy), of a newer program, or may not be written.
            OSError: ENOSPC, the disk is full.
        """
        on_network = is_on_network(path)
        timeout_s = NETWORK_TIMEOUT_S if on_network else BUSY_TIMEOUT_S
        try:
            connection = sqlite3.connect(path, isolation_level=None, timeout=timeout_s)
        except sqlite3.Error as error:
            raise _opening_error(path, error) from error
        super().__init__(connection, path)
        self._run = ""  # the run that writes, once it has begun
        try:
            # The write-ahead log lives in memory that processes share, which a network file system does not have.
            # What is left is a journal that is emptied, not removed: a process that was cut off and then goes on must
            # do nothing by name, see `move_out_of_reach`.
            self._journal_mode = "TRUNCATE" if on_network else "WAL"
            connection.execute(f"PRAGMA journal_mode = {self._journal_mode}")
            connection.execute("PRAGMA synchronous = FULL")
            connection.execute("PRAGMA foreign_keys = ON")
            finding = connection.execute("PRAGMA quick_check(1)").fetchone()[0]
            if finding != "ok":
                raise damaged(path, " ".join(finding.split()))
            migrate(connection)
        except sqlite3.Error as error:
            connection.close()
            raise _opening_error(path, error) from error
        except BaseException:
            connection.close()
            raise

    # --- a run's frame ---
    def begin_run(self, job_name: str, *, run: str = "") -> bool:
        """Mark the job as being run, by the token of the run's lease.

        Returns:
            Whether the last run had ended cleanly. False for a new manifest, too: there may be receipts that an older
            one has lost.
        """
        with self.transaction():
            row = self._connection.execute("SELECT clean_shutdown FROM job").fetchone()
            self._connection.execute(
                "INSERT INTO job (id, name, created, clean_shutdown, run) VALUES (1, ?, ?, 0, ?)"
                " ON CONFLICT (id) DO UPDATE SET"
                " name = excluded.name, clean_shutdown = 0, run = excluded.run, outcome = NULL",
                (job_name, time.time(), run),
            )
        self._run = run
        return row is not None and bool(row[0])

    def end_run(self, outcome: str = SUCCEEDED, *, clean: bool = True) -> None:
        """Mark the end of a run: a JobOutcome's value, and whether all that was committed is recorded for certain."""
        with self.transaction():
            self._connection.execute("UPDATE job SET clean_shutdown = ?, outcome = ?", (clean, outcome))

    @contextmanager
    def transaction(self, *, durable: bool = True) -> Iterator[None]:
        """Group calls into one commit; nested ones join the outermost.

        Unless it is `durable`, a power cut may take the last commits; a crash of the process not.

        Raises:
            OSError: ENOSPC, the disk is full.
            ManifestError: the file is damaged, or cannot be written any more.
            LeaseLostError: another run has begun meanwhile.
        """
        if self._connection.in_transaction:
            yield
            return
        # In rollback mode an unsynced commit could damage the file at a power cut, so there everything is synced.
        synchronous = "FULL" if durable or self._journal_mode != "WAL" else "NORMAL"
        with clear_errors(self._path, "written"):
            try:
                self._connection.execute(f"PRAGMA synchronous = {synchronous}")
                self._connection.execute("BEGIN IMMEDIATE")
                self._refuse_another_run()
                yield
                self._connection.execute("COMMIT")
            except sqlite3.OperationalError as error:
                if _is_full(error):
                    raise _disk_full(self._path) from error
                if result_code(error) == _MOVED:
                    raise self._taken_over() from error
                raise
            finally:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def _refuse_another_run(self) -> None:
        """Raise LeaseLostError if the record is another run's: this process slept, or its file system did."""
        if self._run and self._connection.execute("SELECT run FROM job").fetchone() != (self._run,):
            raise self._taken_over()

    def _taken_over(self) -> LeaseLostError:
        return LeaseLostError(f"{self._path.parent} was taken over by another run while this one did not answer")

    # --- the plan ---
    def record_plan(self, tasks: Sequence[Task], states: Mapping[TaskId, TaskState] | None = None) -> None:
        """Make these the job's tasks, in this order; those without a state are PENDING.

        A task that is no longer in the plan keeps its history, but counts no more.
        """
        states = states or {}
        known = {
            row[0]: row[1:]
            for row in self._rows("SELECT id, position, stage, subject, frame, parameters, state FROM task")
        }
        planned: set[str] = set()
        changed: list[tuple[object, ...]] = []
        for position, task in enumerate(tasks):
            planned.add(task.id)
            state = str(states.get(task.id, TaskState.PENDING))
            row = (position, task.stage, task.subject, task.frame, task.parameters.digest, state)
            if known.get(task.id) != row:
                changed.append((task.id, *row))
        dropped = [(task_id,) for task_id, row in known.items() if row[0] is not None and task_id not in planned]
        sets = {task.parameters.digest: (task.stage, task.parameters.canonical) for task in tasks}
        with self.transaction():
            self._connection.executemany(
                "INSERT OR IGNORE INTO parameters VALUES (?, ?, ?)",
                [(digest, *values) for digest, values in sets.items()],
            )
            self._connection.executemany("UPDATE task SET position = NULL WHERE id = ?", dropped)
            self._connection.executemany(
                "INSERT INTO task VALUES (?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET"
                " position = excluded.position, stage = excluded.stage, subject = excluded.subject,"
                " frame = excluded.frame, parameters = excluded.parameters, state = excluded.state",
                changed,
            )

    def set_states(self, states: Mapping[TaskId, TaskState]) -> None:
        """Set the state of planned tasks; not synced."""
        with self.transaction(durable=False):
            self._connection.executemany(
                "UPDATE task SET state = ? WHERE id = ?", [(str(state), task) for task, state in states.items()]
            )

    # --- attempts ---
    def start_attempt(self, task: TaskId) -> int:
        """Open an attempt of a planned task on this machine, and set the task RUNNING.

        Returns:
            The attempt's number, one higher than any of this task before it, for ever.
        """
        with self.transaction():
            (number,) = self._connection.execute(
                "INSERT INTO attempt (task, number, started, host)"
                " SELECT ?1, coalesce(max(number), 0) + 1, ?2, ?3 FROM attempt WHERE task = ?1 RETURNING number",
                (task, time.time(), platform.node()),
            ).fetchone()
            layout = JobLayout(self._path.parent)
            log = layout.log(task, number).relative_to(layout.root).as_posix()
            self._connection.execute("UPDATE attempt SET log = ? WHERE task = ? AND number = ?", (log, task, number))
            self.set_states({task: TaskState.RUNNING})
        return int(number)

    def finish_attempt(
        self,
        task: TaskId,
        attempt: int,
        *,
        failure: FailureKind | None = None,
        message: str = "",
        seconds: float | None = None,
        peak_memory_bytes: int | None = None,
        state: TaskState | None = None,
    ) -> None:
        """Close an attempt; what a closed one says stands.

        `failure` is why it ended, None if it succeeded; `state` is the task's from now on, set in the same commit.
        """
        outcome = SUCCEEDED if failure is None else str(failure)
        with self.transaction():
            self._connection.execute(
                "UPDATE attempt SET finished = ?, outcome = ?, message = ?, seconds = ?, peak_memory_bytes = ?"
                " WHERE task = ? AND number = ? AND finished IS NULL",
                (time.time(), outcome, message, seconds, peak_memory_bytes, task, attempt),
            )
            if state is not None:
                self.set_states({task: state})

    def remember_attempts(self, receipts: Iterable[Receipt]) -> None:
        """Make sure that the attempts which wrote these receipts are on record, so that their numbers stay used."""
        rows = [*receipts]
        with self.transaction():
            self._connection.executemany(
                "INSERT OR IGNORE INTO task VALUES (?, NULL, ?, '', NULL, NULL, ?)",
                [(receipt.task, receipt.stage, str(TaskState.PENDING)) for receipt in rows],
            )
            self._connection.executemany(
                "INSERT OR IGNORE INTO attempt (task, number, started, finished, outcome, message, host)"
                " VALUES (?, ?, ?, ?, ?, 'known from its receipt', ?)",
                [
                    (receipt.task, receipt.attempt, receipt.started, receipt.finished, SUCCEEDED, receipt.host)
                    for receipt in rows
                ],
            )

    # --- artifacts ---
    def record_artifact(self, receipt: Receipt) -> None:
        """Record a committed artifact; synced. Group many with `record_artifacts` or `transaction`."""
        self.record_artifacts([receipt])

    def record_artifacts(self, receipts: Iterable[Receipt]) -> None:
        """Record committed artifacts in one commit; synced."""
        rows = [*receipts]
        with self.transaction():
            self.remember_attempts(rows)
            self._connection.executemany(
                "INSERT OR REPLACE INTO artifact VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                [artifact_row(row) for row in rows],
            )

    def adopt_mtimes(self, mtimes_ns: Mapping[ArtifactPath, int]) -> None:
        """Take over the modification times [ns] of files that were touched or copied, but hold the same bytes."""
        with self.transaction():
            self._connection.executemany(
                "UPDATE artifact SET mtime_ns = ? WHERE path = ?",
                [(mtime_ns, path) for path, mtime_ns in mtimes_ns.items()],
            )

    def forget_artifacts(self, artifacts: Iterable[ArtifactPath]) -> None:
        """Drop artifacts from the record: their files are gone."""
        with self.transaction():
            self._connection.executemany("DELETE FROM artifact WHERE path = ?", [(path,) for path in artifacts])

    # --- events ---
    def log_event(self, kind: str, message: str, *, task: TaskId | None = None) -> None:
        """Remember something for `explain` and the report; not synced."""
        with self.transaction(durable=False):
            self._connection.execute(
                "INSERT INTO event (time, kind, task, message) VALUES (?, ?, ?, ?)", (time.time(), kind, task, message)
            )

    def __enter__(self) -> Self:
        return self


def artifact_row(receipt: Receipt) -> ArtifactRow:
    """Row of an artifact, from its receipt."""
    inputs = json.dumps(receipt.inputs, sort_keys=True, separators=(",", ":"))
    same = {name: getattr(receipt, name) for name in ArtifactRow._fields if name != "inputs"}
    return ArtifactRow(**same, inputs=inputs)


def move_out_of_reach(path: Path) -> None:
    """Put a copy in the place of a manifest on a network file system, whose last writer did not answer.

    If that was cut off in the middle of a commit and goes on, it writes to a file that has no name any more. Locks
    cannot see to that, as they may end at the machine, or be dropped by the server.
    """
    if not is_on_network(path) or not path.exists():
        return
    copy, journal = path.with_name(f".{path.name}.part.{uuid4().int}"), _journal(path)
    try:
        if journal.exists():
            shutil.copyfile(journal, _journal(copy))
        shutil.copyfile(path, copy)
        with clear_errors(path, "read"), closing(sqlite3.connect(copy)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")  # rolls back what was not committed
            connection.execute("SELECT * FROM sqlite_master").fetchall()
        sync(copy)
        copy.replace(path)
        journal.unlink(missing_ok=True)  # a journal that is left behind here would change nothing
        sync(path.parent)
    finally:
        copy.unlink(missing_ok=True)
        _journal(copy).unlink(missing_ok=True)


def _journal(path: Path) -> Path:
    return path.with_name(f"{path.name}-journal")


def is_on_network(path: Path, mounts: Iterable[tuple[str, str]] | None = None) -> bool:
    """Whether a path, which need not exist, lies on a file system that several machines may write.

    `mounts` are (mount point, file system type) of all mounts, the machine's by default.
    """
    if mounts is None:
        mounts = [(partition.mountpoint, partition.fstype) for partition in psutil.disk_partitions(all=True)]
    resolved = path.resolve()
    around = [
        (len(Path(point).parts), i, kind) for i, (point, kind) in enumerate(mounts) if resolved.is_relative_to(point)
    ]
    kind = max(around, default=(0, 0, ""))[2]  # the deepest mount point, and the latest mount on it
    return kind in _NETWORK_FILE_SYSTEMS or kind.startswith("fuse.")


def _opening_error(path: Path, error: sqlite3.Error) -> Exception:
    if _is_full(error):
        return _disk_full(path)
    if is_damage(error):
        return damaged(path, str(error))
    if is_busy(error):
        return ManifestError(f"{path} cannot be opened: another process, perhaps on another machine, has locked it")
    return ManifestError(f"{path} cannot be opened ({error}); the job's folder must exist and be writable")


def _is_full(error: sqlite3.Error) -> bool:
    """Whether SQLite ran out of disk space; growing the log's index it calls that an I/O error."""
    return result_code(error) in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE)


def _disk_full(path: Path) -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
