"""Groups in a job, of rigid bodies and of blocks: where their tables stand, and what is said of many of them."""

from __future__ import annotations

from collections.abc import Iterable

from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Problem

MOST_SAID = 3
"""Members of a group of which the same is told one by one."""


def _table_of(job: Job, path: KeyPath) -> tuple[KeyPath, str | None]:
    """Where the table of what is at a path stands in the file, and what one of a group, or a piece, is called."""
    if len(path) >= 2 and path[0] == "rigid":
        body = job.rigid[int(path[1])]
        return ("rigid", body.table), None if body.name == body.group else f'"{body.name}"'
    if len(path) >= 4 and path[0] in ("fluid", "soft") and path[2] == "block":
        block = getattr(job, str(path[0]))[int(path[1])].block[int(path[3])]
        return (*path[:3], block.table), None if block.member is None else f"block {block.member} of the group"
    return path, None


def written_place(job: Job, path: KeyPath) -> KeyPath:
    """The place in the file of a place in the job: of all members of a group, and pieces, that of their table."""
    table, _ = _table_of(job, path)
    rest = path[len(table) :]
    if path[:1] == ("rigid",) and rest[:1] == ("shape",) and job.rigid[int(path[1])].whole is not None:
        rest = ("shape", *(rest[2:] if rest[1:2] == ("of",) else ()))
    return (*table, *rest)


def of_tables(job: Job, problems: Iterable[Problem]) -> list[Problem]:
    """Problems of a job at the places of the file, a group's with the one that has it, and few of a kind."""
    told: list[Problem] = []
    left_out: dict[KeyPath, int] = {}
    count: dict[KeyPath, int] = {}
    for problem in problems:
        place, (_, label) = written_place(job, problem.path), _table_of(job, problem.path)
        if label is None:
            told.append(Problem(place, problem.message))
            continue
        count[place] = count.get(place, 0) + 1
        if count[place] <= MOST_SAID:
            is_named = label in problem.message
            told.append(Problem(place, problem.message if is_named else f"{label} {problem.message}"))
        else:
            left_out[place] = left_out.get(place, 0) + 1
    told += [Problem(place, f"and {number:,} more like these in the group") for place, number in left_out.items()]
    return told
