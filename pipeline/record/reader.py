"""Reading the manifest: what `status`, `plan` and `explain` ask, beside a runner that writes it."""

from __future__ import annotations

import json
import os
import shlex
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

from pipeline.base.errors import DamagedManifestError, ManifestError, OutdatedManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.paused_gc import many_objects
from pipeline.base.places import is_inside
from pipeline.base.task import ArtifactPath, TaskId, TaskState
from pipeline.record.migrations import migrations, refuse_newer, schema_version

BUSY_TIMEOUT_S = 10.0
"""How long to wait for another process's lock; with a write-ahead log only a checkpoint ever makes one wait."""

SUCCEEDED = "succeeded"  # outcome of an attempt that ended well; any other is a FailureKind


class ArtifactRow(NamedTuple):
    """A committed artifact as the manifest knows it; the fields mean what those of `receipts.Receipt` do."""

    artifact: ArtifactPath
    task: TaskId
    attempt: int
    fingerprint: str
    parameters: str
    size: int
    mtime_ns: int
    hash: str
    inputs: str  # JSON object, path -> hash; parsed only where a change is to be named
    device: str = ""


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
    log: str  # path relative to the job's folder; empty if it is known from its receipt only


class EventRow(NamedTuple):
    """Something worth remembering: a takeover, an edited file, a pause. `time` is wall time [s since the epoch]."""

    time: float
    kind: str
    task: TaskId | None
    message: str


class StageSummary(NamedTuple):
    """Number of a stage's planned tasks in each state; states without tasks are left out."""

    stage: str
    counts: Mapping[TaskState, int]

    @property
    def total(self) -> int:
        """Number of planned tasks of the stage."""
        return sum(self.counts.values())

    @property
    def done(self) -> int:
        """Number of those that are done."""
        return sum(self.counts.get(state, 0) for state in (TaskState.SUCCEEDED, TaskState.UP_TO_DATE))


def done_and_total(summary: Iterable[StageSummary]) -> tuple[int, int]:
    """How many tasks of all stages are done, and how many there are."""
    return sum(stage.done for stage in summary), sum(stage.total for stage in summary)


class StageCost(NamedTuple):
    """Cost of a stage so far, for estimates."""

    stage: str
    seconds_per_artifact: float
    bytes_per_artifact: float


class StageTiming(NamedTuple):
    """Total of all attempts of a stage."""

    stage: str
    attempts: int
    failed: int
    seconds: float  # one after the other
    longest_s: float
    peak_memory_bytes: int | None  # of the largest
    artifacts: int
    bytes: int


class StoredFile(NamedTuple):
    """An artifact as it stands on disk."""

    path: ArtifactPath
    mtime_ns: int  # its modification time [ns since the epoch]
    is_old: bool  # whether an earlier run made it: the plan is to make it anew, or has its stage and it no more


class LastRun(NamedTuple):
    """The last run of the job: the token of its lease, and how it ended."""

    run: str | None
    outcome: str | None  # a JobOutcome's value; None while it goes on, and if it was killed


class StagePace(NamedTuple):
    """Pace of a stage's planned tasks."""

    stage: str
    mean_seconds: float | None  # of an attempt that ended well; None before there is one
    busy_s: float = 0.0  # how long attempts worked in a span of time [s]; one beside another counts twice
    busy_since: float | None = None  # when the first of these was at work in it [s since the epoch]


class TaskRow(NamedTuple):
    """A planned task with its last attempt, whose fields are None before there is one."""

    task: TaskId
    state: TaskState
    attempt: int | None
    finished: float | None
    message: str | None
    seconds: float | None


class TaskPage(NamedTuple):
    """Some of the planned tasks that were asked for, in the plan's order, and how many there are."""

    rows: list[TaskRow]
    total: int


class ManifestReader:
    """Queries on the record. The connection belongs to the thread that opened it.

    Every query raises ManifestError when the file is damaged, its text naming the remedy, or cannot be read.
    """

    def __init__(self, connection: sqlite3.Connection, path: Path) -> None:
        self._connection = connection
        self._path = path

    @classmethod
    def open_readonly(
        cls, path: Path, *, leave_no_trace: bool = False, timeout_s: float = BUSY_TIMEOUT_S
    ) -> ManifestReader:
        """Open beside a working runner, or where the folder itself may only be read; wait so long for a lock.

        To `leave_no_trace` no file is made beside a manifest that nobody has open, as SQLite else does for its index. A
        runner that starts meanwhile is not noticed then: see `pipeline.record.glance`.

        Raises:
            ManifestError: there is none, it is damaged, or a newer program's.
            OutdatedManifestError: it is an older program's, or was never finished.
        """
        if not path.exists():
            raise ManifestError(f"{path}: no manifest; this job has not been submitted yet")
        log_exists = path.with_name(f"{path.name}-wal").exists()
        # A write-ahead log needs a place for its index; without a log there is nothing that could change beneath us.
        may_make_files = os.access(path.parent, os.W_OK) and not (leave_no_trace and _has_log_format(path))
        immutable = not log_exists and not may_make_files
        uri = f"{path.absolute().as_uri()}?mode=ro{'&immutable=1' if immutable else ''}"
        with clear_errors(path, "read"):
            connection = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=timeout_s)
        try:
            with clear_errors(path, "read"):
                version = schema_version(connection)
            refuse_newer(version)
        except ManifestError:
            connection.close()
            raise
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
        with many_objects():
            rows = {row.artifact: row for row in map(ArtifactRow._make, self._rows("SELECT * FROM artifact"))}
        for artifact in rows:
            if not is_inside(artifact):
                raise damaged(self._path, f"it speaks of a file outside the folder: {artifact!a:.200}")
        return rows

    def is_at_rest(self, tasks: int) -> bool:
        """Whether the last run ended well and cleanly, with this number of tasks, and nothing was started since."""
        return bool(
            self._rows(
                "SELECT 1 FROM job WHERE clean_shutdown AND outcome = ?"
                " AND (SELECT count(*) FROM task WHERE position IS NOT NULL) = ?"
                " AND NOT EXISTS (SELECT 1 FROM attempt WHERE finished IS NULL)",
                (SUCCEEDED, tasks),
            )
        )

    def states(self) -> dict[TaskId, TaskState]:
        """State of every planned task, in the plan's order."""
        rows = self._rows("SELECT id, state FROM task WHERE position IS NOT NULL ORDER BY position")
        return {TaskId(task): TaskState(state) for task, state in rows}

    def summary(self) -> list[StageSummary]:
        """Counts per stage, stages in the plan's order."""
        rows = self._rows(
            "SELECT stage, state, count(*), min(position) FROM task WHERE position IS NOT NULL GROUP BY stage, state"
        )
        counts: dict[str, dict[TaskState, int]] = {}
        for stage, state, count, _ in sorted(rows, key=lambda row: int(row[3])):
            counts.setdefault(stage, {})[TaskState(state)] = count
        return [StageSummary(stage, states) for stage, states in counts.items()]

    def subjects(self, stage: str) -> frozenset[str]:
        """Subjects of a stage's planned tasks, such as the fluids that have whitewater."""
        rows = self._rows(
            "SELECT DISTINCT subject FROM task WHERE position IS NOT NULL AND stage = ? AND subject IS NOT NULL",
            (stage,),
        )
        return frozenset(subject for (subject,) in rows)

    def history(self, task: TaskId) -> list[AttemptRow]:
        """Every attempt of a task, first to last."""
        rows = self._rows("SELECT * FROM attempt WHERE task = ? ORDER BY number", (task,))
        return [AttemptRow._make(row) for row in rows]

    def running_attempts(self) -> list[AttemptRow]:
        """Attempts that have not been closed; at the start of a run, those whose worker died with its runner."""
        rows = self._rows("SELECT * FROM attempt WHERE finished IS NULL ORDER BY task, number")
        return [AttemptRow._make(row) for row in rows]

    def failures(self) -> list[AttemptRow]:
        """The last attempt of each planned task that has failed, in the plan's order."""
        rows = self._rows(
            "SELECT attempt.* FROM task JOIN attempt ON attempt.task = task.id"
            " WHERE task.position IS NOT NULL AND task.state = ?"
            " AND attempt.number = (SELECT max(number) FROM attempt AS later WHERE later.task = task.id)"
            " ORDER BY task.position",
            (TaskState.FAILED,),
        )
        return [AttemptRow._make(row) for row in rows]

    def events(self, *, task: TaskId | None = None, limit: int = 100) -> list[EventRow]:
        """The last `limit` events, oldest first; of one task, or of all."""
        rows = self._rows(
            "SELECT time, kind, task, message FROM event WHERE ?1 IS NULL OR task = ?1 ORDER BY id DESC LIMIT ?2",
            (task, limit),
        )
        return [EventRow._make(row) for row in reversed(rows)]

    def devices(self, stage: str) -> dict[str, int]:
        """Devices that computed the artifacts of a stage, with the number of tasks; those to be made anew left out."""
        rows = self._rows(
            "SELECT device, count(DISTINCT artifact.task) FROM artifact JOIN task ON task.id = artifact.task"
            " WHERE device != '' AND position IS NOT NULL AND stage = ? AND state IN (?, ?)"
            " GROUP BY device ORDER BY device",
            (stage, TaskState.SUCCEEDED, TaskState.UP_TO_DATE),
        )
        return {str(device): int(tasks) for device, tasks in rows}

    def parameters(self, digest: str) -> ParameterSet | None:
        """The parameter set of this digest; None if it is unknown, as after a rebuild."""
        rows = self._rows("SELECT canonical FROM parameters WHERE digest = ?", (digest,))
        return ParameterSet(rows[0][0]) if rows else None

    def last_run(self) -> LastRun:
        """The last run of the job."""
        rows = self._rows("SELECT run, outcome FROM job")
        return LastRun._make(rows[0]) if rows else LastRun(None, None)

    def stage_costs(self) -> dict[str, StageCost]:
        """Mean time and disk space that an artifact of each stage has taken; stages without any are left out."""
        rows = self._rows(
            "WITH made AS (SELECT stage, count(*) AS artifacts, sum(size) AS bytes FROM artifact"
            "   JOIN task ON task.id = artifact.task GROUP BY stage),"
            " spent AS (SELECT stage, sum(seconds) AS seconds FROM attempt"
            "   JOIN task ON task.id = attempt.task WHERE outcome = ? GROUP BY stage)"
            " SELECT stage, coalesce(seconds, 0.0) / artifacts, CAST(bytes AS REAL) / artifacts"
            " FROM made LEFT JOIN spent USING (stage)",
            (SUCCEEDED,),
        )
        return {row.stage: row for row in map(StageCost._make, rows)}

    def stage_timings(self) -> list[StageTiming]:
        """Totals of the attempts of each stage, in the plan's order; stages without an attempt are left out."""
        rows = self._rows(
            "WITH made AS (SELECT stage, count(*) AS artifacts, sum(size) AS bytes FROM artifact"
            "   JOIN task ON task.id = artifact.task GROUP BY stage),"
            " tried AS (SELECT stage, count(*) AS attempts, sum(coalesce(outcome, ?1) != ?1) AS failed,"
            "   coalesce(sum(seconds), 0.0) AS seconds, coalesce(max(seconds), 0.0) AS longest,"
            "   max(peak_memory_bytes) AS peak, min(position) AS place"
            "   FROM attempt JOIN task ON task.id = attempt.task WHERE position IS NOT NULL GROUP BY stage)"
            " SELECT stage, attempts, failed, seconds, longest, peak, coalesce(artifacts, 0), coalesce(bytes, 0)"
            " FROM tried LEFT JOIN made USING (stage) ORDER BY place",
            (SUCCEEDED,),
        )
        return [StageTiming._make(row) for row in rows]

    # --- for a page of a job that runs ---
    def stage_paces(self, since: float, until: float) -> dict[str, StagePace]:
        """Pace of each stage's planned tasks, busy between two wall times; stages without an attempt left out."""
        rows = self._rows(
            "WITH tried AS (SELECT stage, outcome = ?3 AS well, seconds,"
            "   max(started, ?1) AS began, min(coalesce(finished, ?2), ?2) AS ended"
            "   FROM attempt JOIN task ON task.id = attempt.task WHERE position IS NOT NULL)"
            " SELECT stage, avg(seconds) FILTER (WHERE well),"
            "   coalesce(sum(ended - began) FILTER (WHERE ended > began), 0.0), min(began) FILTER (WHERE ended > began)"
            " FROM tried GROUP BY stage",
            (since, until, SUCCEEDED),
        )
        return {row.stage: row for row in map(StagePace._make, rows)}

    def artifacts_of(self, task: TaskId, *, since: float = 0.0) -> tuple[int, int]:
        """Number of artifacts of a task, and of those written after a wall time."""
        rows = self._rows(
            "SELECT count(*), coalesce(sum(mtime_ns >= ?2), 0) FROM artifact WHERE task = ?1", (task, int(since * 1e9))
        )
        return int(rows[0][0]), int(rows[0][1])

    def is_empty(self) -> bool:
        """Whether there is no artifact on record."""
        return not self._rows("SELECT 1 FROM artifact LIMIT 1")

    def frame_count(self) -> int:
        """Number of frames of the planned tasks."""
        return int(self._rows("SELECT coalesce(max(frame) + 1, 0) FROM task WHERE position IS NOT NULL")[0][0])

    def newest_in(self, folder: str, suffix: str, *, limit: int, offset: int = 0) -> list[StoredFile]:
        """Artifacts right in a folder of the job, the newest first."""
        return self._newest_in(folder, suffix, limit, offset)[0]

    def newest_and_count_in(self, folder: str, suffix: str) -> tuple[StoredFile | None, int]:
        """The first one that `newest_in` tells, or None, and of how many."""
        files, count = self._newest_in(folder, suffix, 1, 0)
        return next(iter(files), None), count

    def is_old(self, artifact: ArtifactPath) -> bool:
        """Whether an artifact is there that an earlier run made; see `StoredFile`."""
        return any(file.is_old for file in self._newest_in(artifact, "", 1, 0)[0])

    def _newest_in(self, place: str, suffix: str, limit: int, offset: int) -> tuple[list[StoredFile], int]:
        """Artifacts that are a place or right in it, the newest first, and how many there are in all."""
        rows = self._rows(
            "SELECT path, mtime_ns, CASE WHEN task.position IS NOT NULL THEN task.state NOT IN (?5, ?6)"
            "   ELSE EXISTS (SELECT 1 FROM task AS other WHERE other.stage = task.stage AND other.position IS NOT NULL)"
            "   END, count(*) OVER ()"
            " FROM artifact JOIN task ON task.id = artifact.task"
            " WHERE path = ?1 OR (path > ?1 || '/' AND path < ?1 || '0'"  # 0 follows / in ASCII
            "   AND substr(path, -length(?2)) = ?2)"
            " ORDER BY mtime_ns DESC, path DESC LIMIT ?3 OFFSET ?4",
            (place, suffix, limit, offset, TaskState.SUCCEEDED, TaskState.UP_TO_DATE),
        )
        files = [StoredFile(ArtifactPath(path), int(mtime_ns), bool(is_old)) for path, mtime_ns, is_old, _ in rows]
        return files, int(rows[0][3]) if rows else 0

    def task_page(
        self,
        *,
        stage: str | None = None,
        states: Sequence[TaskState] = (),
        text: str = "",
        limit: int = 50,
        offset: int = 0,
    ) -> TaskPage:
        """Planned tasks with their last attempts, in the plan's order: those whose id contains a text."""
        values = (stage, text, json.dumps([str(state) for state in states]))
        rows = self._rows(
            "WITH chosen AS MATERIALIZED ("
            "   SELECT id, position, state FROM task"
            "   WHERE position IS NOT NULL AND (?1 IS NULL OR stage = ?1) AND instr(id, ?2)"
            "     AND (?3 = '[]' OR state IN (SELECT value FROM json_each(?3)))"
            "   ORDER BY position LIMIT ?4 OFFSET ?5)"
            " SELECT id, state, number, finished, message, seconds"
            " FROM chosen LEFT JOIN attempt ON attempt.task = id"
            "   AND number = (SELECT max(number) FROM attempt AS later WHERE later.task = id)"
            " ORDER BY position",
            (*values, limit, offset),
        )
        counted = self._rows(
            "SELECT count(*) FROM task WHERE position IS NOT NULL AND (?1 IS NULL OR stage = ?1) AND instr(id, ?2)"
            " AND (?3 = '[]' OR state IN (SELECT value FROM json_each(?3)))",
            values,
        )
        return TaskPage([TaskRow._make(row)._replace(state=TaskState(row[1])) for row in rows], int(counted[0][0]))

    def _rows(self, query: str, parameters: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query. Damage shows only at the page that it hit, so they are fetched here, under one roof."""
        with clear_errors(self._path, "read"):
            return self._connection.execute(query, parameters).fetchall()


def record_of(layout: JobLayout) -> tuple[list[StageSummary], LastRun]:
    """Counts by stage and the last run; nothing while the runner is still making its manifest, or renewing it."""
    if not layout.manifest.exists():
        return [], LastRun(None, None)
    try:
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            return manifest.summary(), manifest.last_run()
    except OutdatedManifestError:
        return [], LastRun(None, None)


def _has_log_format(path: Path) -> bool:
    """Whether a manifest is read through a write-ahead log: byte 18 of SQLite's header is 2 then."""
    with path.open("rb") as file:
        return file.read(19)[18:] == b"\2"


def damaged(path: Path, finding: str) -> DamagedManifestError:
    """The error for a manifest that SQLite cannot trust."""
    return DamagedManifestError(
        f"{path} is damaged ({finding}). No finished work is lost: every artifact has its receipt, and the next run of "
        f"the job makes the manifest anew of these, as does: pipeline verify {shlex.quote(str(path.parent))} --rebuild"
    )


@contextmanager
def clear_errors(path: Path, what: str) -> Iterator[None]:
    """Turn SQLite's errors in the block into ManifestErrors; a mistake in a statement itself stays what it is.

    `what` is what the block does to the manifest: "read" or "written".
    """
    try:
        yield
    except sqlite3.Error as error:
        if is_damage(error):
            raise damaged(path, str(error)) from error
        if isinstance(error, sqlite3.OperationalError):
            if what == "read" and result_code(error) & 0xFF == sqlite3.SQLITE_READONLY:  # what began has to be undone
                why = "its writer is in the middle of a change, or was cut off there"
                raise OutdatedManifestError(f"{path}: {why}; look again, or submit the job once") from error
            why = "another process, perhaps on another machine, has locked it" if is_busy(error) else str(error)
            raise ManifestError(f"{path} cannot be {what} ({why})") from error
        raise


def is_damage(error: sqlite3.Error) -> bool:
    """Whether SQLite found the file damaged, rather than busy, locked or out of reach."""
    if result_code(error) & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
        return True
    # Flipped bits in a text; an error of the Python module, which has no result code.
    return isinstance(error, sqlite3.OperationalError) and str(error).startswith("Could not decode to UTF-8")


def is_busy(error: sqlite3.Error) -> bool:
    """Whether another process held a lock for longer than we waited."""
    return result_code(error) & 0xFF == sqlite3.SQLITE_BUSY


def result_code(error: sqlite3.Error) -> int:
    """SQLite's extended result code, whose low byte is the kind of error; 0 for errors of the module itself."""
    return int(getattr(error, "sqlite_errorcode", 0))
