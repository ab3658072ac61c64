"""Queries on the manifest for a page of a job that runs: how fast it is, what is new, tasks by the page."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

from pipeline.task import ArtifactPath, TaskId, TaskState


class StagePace(NamedTuple):
    """How fast a stage's planned tasks are."""

    stage: str
    ended_well: int
    mean_seconds: float | None  # of an attempt that ended well; None before there is one


class Busy(NamedTuple):
    """How long attempts worked in a span of time."""

    seconds: dict[str, float]  # by stage; one beside another counts twice
    since: float  # when the first of them was at work [s since the epoch]


class TaskRow(NamedTuple):
    """A planned task with its last attempt, whose fields are None before there is one."""

    task: TaskId
    stage: str
    subject: str
    frame: int | None
    state: TaskState
    attempt: int | None
    started: float | None
    finished: float | None
    outcome: str | None
    message: str | None
    seconds: float | None
    host: str | None


class TaskPage(NamedTuple):
    """Some of the planned tasks that were asked for, in the plan's order, and how many there are."""

    rows: list[TaskRow]
    total: int


class PageQueries(ABC):
    """The queries; `pipeline.manifest_reader.ManifestReader` has them, and says what they raise."""

    def stage_paces(self) -> dict[str, StagePace]:
        """How fast each stage's planned tasks are, stages without an attempt that ended well left out."""
        rows = self._rows(
            "SELECT stage, count(*), avg(seconds) FROM attempt JOIN task ON task.id = attempt.task"
            " WHERE outcome = ? AND position IS NOT NULL GROUP BY stage",
            ("succeeded",),
        )
        return {row.stage: row for row in map(StagePace._make, rows)}

    def busy_seconds(self, since: float, until: float) -> Busy:
        """How long attempts worked between two wall times."""
        rows = self._rows(
            "SELECT stage, sum(min(coalesce(finished, ?2), ?2) - max(started, ?1)), min(max(started, ?1)) FROM attempt"
            " JOIN task ON task.id = attempt.task WHERE coalesce(finished, ?2) > ?1 AND started < ?2 GROUP BY stage",
            (since, until),
        )
        return Busy({row[0]: float(row[1]) for row in rows}, min((float(row[2]) for row in rows), default=until))

    def artifacts_of(self, task: TaskId, *, since: float = 0.0) -> tuple[int, int]:
        """How many artifacts of a task there are, and how many of them were written after a wall time."""
        rows = self._rows(
            "SELECT count(*), coalesce(sum(mtime_ns >= ?2), 0) FROM artifact WHERE task = ?1", (task, int(since * 1e9))
        )
        return int(rows[0][0]), int(rows[0][1])

    def frame_count(self) -> int:
        """How many frames the planned tasks are about."""
        return int(self._rows("SELECT coalesce(max(frame) + 1, 0) FROM task WHERE position IS NOT NULL")[0][0])

    def newest_in(self, folder: str, suffix: str, *, limit: int, offset: int = 0) -> list[tuple[ArtifactPath, int]]:
        """Artifacts right in a folder of the job, the newest first, each with its modification time [ns]."""
        rows = self._rows(
            "SELECT path, mtime_ns FROM artifact WHERE path > ?1 || '/' AND path < ?1 || '0'"  # 0 follows / in ASCII
            " AND substr(path, -length(?2)) = ?2 ORDER BY mtime_ns DESC, path DESC LIMIT ?3 OFFSET ?4",
            (folder, suffix, limit, offset),
        )
        return [(ArtifactPath(path), int(mtime_ns)) for path, mtime_ns in rows]

    def count_in(self, folder: str, suffix: str) -> int:
        """How many artifacts `newest_in` chooses from."""
        rows = self._rows(
            "SELECT count(*) FROM artifact WHERE path > ?1 || '/' AND path < ?1 || '0'"
            " AND substr(path, -length(?2)) = ?2",
            (folder, suffix),
        )
        return int(rows[0][0])

    def task_page(
        self,
        *,
        stage: str | None = None,
        states: Sequence[TaskState] = (),
        text: str = "",
        limit: int = 50,
        offset: int = 0,
    ) -> TaskPage:
        """Planned tasks with their last attempts, in the plan's order.

        Args:
            stage: of this stage; None: of all.
            states: in one of these; empty: in any.
            text: whose id contains this.
            limit: at most so many.
            offset: after so many.
        """
        values = (stage, text, json.dumps([str(state) for state in states]))
        rows = self._rows(
            "WITH chosen AS MATERIALIZED ("
            "   SELECT id, position, stage, subject, frame, state FROM task"
            "   WHERE position IS NOT NULL AND (?1 IS NULL OR stage = ?1) AND instr(id, ?2)"
            "     AND (?3 = '[]' OR state IN (SELECT value FROM json_each(?3)))"
            "   ORDER BY position LIMIT ?4 OFFSET ?5)"
            " SELECT id, stage, subject, frame, state, number, started, finished, outcome, message, seconds, host"
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
        return TaskPage([TaskRow._make(row)._replace(state=TaskState(row[4])) for row in rows], int(counted[0][0]))

    @abstractmethod
    def _rows(self, query: str, parameters: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query."""
