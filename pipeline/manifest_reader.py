"""Reading the manifest: what `status`, `plan` and `explain` ask, beside a runner that writes it."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, Self

from pipeline.errors import ManifestError, OutdatedManifestError
from pipeline.migrations import migrations, refuse_newer, schema_version
from pipeline.parameter_set import ParameterSet
from pipeline.task import ArtifactPath, FailureKind, TaskId, TaskState

BUSY_TIMEOUT_S = 10.0
"""How long to wait for another process's lock; with a write-ahead log only a checkpoint ever makes one wait."""

SUCCEEDED = "succeeded"
"""Outcome of an attempt that ended well; any other is a FailureKind."""


class ArtifactRow(NamedTuple):
    """A committed artifact as the manifest knows it; the fields mean what those of `artifacts.Receipt` do."""

    artifact: ArtifactPath
    task: TaskId
    attempt: int
    fingerprint: str
    parameters: str
    size: int
    mtime_ns: int
    hash: str
    inputs: str  # JSON object, path -> hash; parsed only where a change is to be named


class AttemptRow(NamedTuple):
    """One try of a task. Times are wall times [s since the epoch]."""

    task: TaskId
    number: int
    started: float
    finished: float | None
    outcome: str | None  # SUCCEEDED or a FailureKind's value; None while it runs
    message: str
    seconds: float | None
    peak_memory_bytes: int | None
    host: str
    log: str

    @property
    def failure(self) -> FailureKind | None:
        """Why it ended without success; None if it runs or succeeded."""
        return None if self.outcome in (None, SUCCEEDED) else FailureKind(self.outcome)


class EventRow(NamedTuple):
    """Something worth remembering: a takeover, an edited file, a pause. `time` is wall time [s since the epoch]."""

    time: float
    kind: str
    task: TaskId | None
    message: str


class StageSummary(NamedTuple):
    """How many of a stage's planned tasks are in each state; states without tasks are left out."""

    stage: str
    counts: Mapping[TaskState, int]

    @property
    def total(self) -> int:
        """Number of planned tasks of the stage."""
        return sum(self.counts.values())


class StageCost(NamedTuple):
    """What a stage has taken so far, for estimates."""

    stage: str
    seconds_per_artifact: float
    bytes_per_artifact: float


class ManifestReader:
    """Queries on the record. The connection belongs to the thread that opened it."""

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection = connection
        self._path = path

    @classmethod
    def open_readonly(cls, path: Path) -> ManifestReader:
        """Open beside a working runner, or where the folder itself may only be read.

        Raises:
            ManifestError: there is none, it is damaged, or a newer program's.
            OutdatedManifestError: it is an older program's, or was never finished.
        """
        if not path.exists():
            raise ManifestError(f"{path}: no manifest; this job has not been submitted yet")
        log_exists = path.with_name(f"{path.name}-wal").exists()
        # A write-ahead log needs a place for its index; without a log there is nothing that could change beneath us.
        immutable = not log_exists and not os.access(path.parent, os.W_OK)
        uri = f"{path.absolute().as_uri()}?mode=ro{'&immutable=1' if immutable else ''}"
        try:
            connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=BUSY_TIMEOUT_S)
            version = schema_version(connection)
        except sqlite3.DatabaseError as error:
            raise damaged(path, str(error)) from error
        refuse_newer(version)
        if version < len(migrations()):
            connection.close()
            why = "written by an older program" if version else "not finished when it was made"
            raise OutdatedManifestError(f"{path}: {why}; submit the job once to bring it up to date")
        return ManifestReader(connection, path)

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def artifacts(self) -> dict[ArtifactPath, ArtifactRow]:
        """Every artifact on record."""
        return {row.artifact: row for row in map(ArtifactRow._make, self._connection.execute("SELECT * FROM artifact"))}

    def artifact_hashes(self) -> dict[ArtifactPath, str]:
        """Content hash of every artifact on record."""
        return dict(self._connection.execute("SELECT path, hash FROM artifact"))

    def states(self) -> dict[TaskId, TaskState]:
        """State of every planned task, in the plan's order."""
        rows = self._connection.execute("SELECT id, state FROM task WHERE position IS NOT NULL ORDER BY position")
        return {TaskId(task): TaskState(state) for task, state in rows}

    def summary(self) -> list[StageSummary]:
        """Counts per stage, stages in the plan's order."""
        rows = self._connection.execute(
            "SELECT stage, state, count(*), min(position) FROM task WHERE position IS NOT NULL GROUP BY stage, state"
        ).fetchall()
        counts: dict[str, dict[TaskState, int]] = {}
        for stage, state, count, _ in sorted(rows, key=lambda row: int(row[3])):
            counts.setdefault(stage, {})[TaskState(state)] = count
        return [StageSummary(stage, states) for stage, states in counts.items()]

    def history(self, task: TaskId) -> list[AttemptRow]:
        """Every attempt of a task, first to last."""
        rows = self._connection.execute("SELECT * FROM attempt WHERE task = ? ORDER BY number", (task,))
        return [AttemptRow._make(row) for row in rows]

    def running_attempts(self) -> list[AttemptRow]:
        """Attempts that have not been closed; at the start of a run, those whose worker died with its runner."""
        rows = self._connection.execute("SELECT * FROM attempt WHERE finished IS NULL ORDER BY task, number")
        return [AttemptRow._make(row) for row in rows]

    def failures(self) -> list[AttemptRow]:
        """The last attempt of each planned task that has failed, in the plan's order."""
        rows = self._connection.execute(
            "SELECT attempt.* FROM task JOIN attempt ON attempt.task = task.id"
            " WHERE task.position IS NOT NULL AND task.state = ?"
            " AND attempt.number = (SELECT max(number) FROM attempt AS later WHERE later.task = task.id)"
            " ORDER BY task.position",
            (TaskState.FAILED,),
        )
        return [AttemptRow._make(row) for row in rows]

    def events(self, *, task: TaskId | None = None, limit: int = 100) -> list[EventRow]:
        """The last `limit` events, oldest first; of one task, or of all."""
        rows = self._connection.execute(
            "SELECT time, kind, task, message FROM event WHERE ?1 IS NULL OR task = ?1 ORDER BY id DESC LIMIT ?2",
            (task, limit),
        ).fetchall()
        return [EventRow._make(row) for row in reversed(rows)]

    def parameters(self, digest: str) -> ParameterSet | None:
        """The parameter set of this digest; None if it is unknown, as after a rebuild."""
        row = self._connection.execute("SELECT canonical FROM parameters WHERE digest = ?", (digest,)).fetchone()
        return None if row is None else ParameterSet(row[0])

    def stage_costs(self) -> dict[str, StageCost]:
        """Mean time and disk space that an artifact of each stage has taken; stages without any are left out."""
        rows = self._connection.execute(
            "WITH made AS (SELECT stage, count(*) AS artifacts, sum(size) AS bytes FROM artifact"
            "   JOIN task ON task.id = artifact.task GROUP BY stage),"
            " spent AS (SELECT stage, sum(seconds) AS seconds FROM attempt"
            "   JOIN task ON task.id = attempt.task WHERE outcome = ? GROUP BY stage)"
            " SELECT stage, coalesce(seconds, 0.0) / artifacts, CAST(bytes AS REAL) / artifacts"
            " FROM made LEFT JOIN spent USING (stage)",
            (SUCCEEDED,),
        )
        return {row.stage: row for row in map(StageCost._make, rows)}


def damaged(path: Path, finding: str) -> ManifestError:
    """The error for a manifest that SQLite cannot trust."""
    return ManifestError(
        f"{path} is damaged ({finding}). No finished work is lost: every artifact has its receipt. "
        "Make a new manifest of the receipts with: pipeline verify --rebuild"
    )
