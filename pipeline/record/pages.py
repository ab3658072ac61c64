"""Queries on the manifest for a page of a job that runs: how fast it is, what is new, tasks by the page."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

from pipeline.base.task import ArtifactPath, TaskId, TaskState


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


class PageQueries(ABC):
    """The queries; `pipeline.record.reader.ManifestReader` has them, and says what they raise."""

    def stage_paces(self, since: float, until: float) -> dict[str, StagePace]:
        """Pace of each stage's planned tasks; stages without an attempt left out.

        Args:
            since: wall time from which on it is told how busy the stage was [s since the epoch].
            until: wall time up to which.
        """
        rows = self._rows(
            "WITH tried AS (SELECT stage, outcome = ?3 AS well, seconds,"
            "   max(started, ?1) AS began, min(coalesce(finished, ?2), ?2) AS ended"
            "   FROM attempt JOIN task ON task.id = attempt.task WHERE position IS NOT NULL)"
            " SELECT stage, avg(seconds) FILTER (WHERE well),"
            "   coalesce(sum(ended - began) FILTER (WHERE ended > began), 0.0), min(began) FILTER (WHERE ended > began)"
            " FROM tried GROUP BY stage",
            (since, until, "succeeded"),
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

    def newest_in(self, folder: str, suffix: str, *, limit: int, offset: int = 0) -> list[tuple[ArtifactPath, int]]:
        """Artifacts right in a folder of the job, the newest first, each with its modification time [ns]."""
        rows = self._rows(
            "SELECT path, mtime_ns FROM artifact WHERE path > ?1 || '/' AND path < ?1 || '0'"  # 0 follows / in ASCII
            " AND substr(path, -length(?2)) = ?2 ORDER BY mtime_ns DESC, path DESC LIMIT ?3 OFFSET ?4",
            (folder, suffix, limit, offset),
        )
        return [(ArtifactPath(path), int(mtime_ns)) for path, mtime_ns in rows]

    def newest_and_count_in(self, folder: str, suffix: str) -> tuple[tuple[ArtifactPath, int] | None, int]:
        """The first one that `newest_in` tells, or None, and of how many."""
        rows = self._rows(
            "SELECT path, max(mtime_ns), count(*) FROM artifact WHERE path > ?1 || '/' AND path < ?1 || '0'"
            " AND substr(path, -length(?2)) = ?2",  # beside max() SQLite takes the path from its row
            (folder, suffix),
        )
        path, mtime_ns, count = rows[0]
        return None if path is None else (ArtifactPath(path), int(mtime_ns)), int(count)

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

    @abstractmethod
    def _rows(self, query: str, parameters: Sequence[object] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query."""
