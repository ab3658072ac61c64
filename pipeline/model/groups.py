"""Groups of rigid bodies in a job: where their tables stand, and what is said of many of them."""

from __future__ import annotations

from collections.abc import Iterable

from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Problem

MOST_SAID = 3
"""Bodies of a group of which the same is told one by one."""


def written_place(job: Job, path: KeyPath) -> KeyPath:
    """The place in the file of a place in the job: of all bodies of a group, and pieces, that of their table."""
    if len(path) < 2 or path[0] != "rigid":
        return path
    body, rest = job.rigid[int(path[1])], path[2:]
    if body.whole is not None and rest[:1] == ("shape",):
        rest = ("shape", *(rest[2:] if rest[1:2] == ("of",) else ()))
    return ("rigid", body.table, *rest)


def of_tables(job: Job, problems: Iterable[Problem]) -> list[Problem]:
    """Problems of a job's bodies at the places of the file, a group's with the name of the body, and few of a kind."""
    told: list[Problem] = []
    left_out: dict[KeyPath, int] = {}
    count: dict[KeyPath, int] = {}
    for problem in problems:
        place = written_place(job, problem.path)
        if place == problem.path and problem.path[:1] != ("rigid",):
            told.append(problem)
            continue
        name, group = job.rigid[int(problem.path[1])].name, job.rigid[int(problem.path[1])].group
        count[place] = count.get(place, 0) + 1
        if name == group:
            told.append(Problem(place, problem.message))
        elif count[place] <= MOST_SAID:
            is_named = f'"{name}"' in problem.message
            told.append(Problem(place, problem.message if is_named else f'"{name}" {problem.message}'))
        else:
            left_out[place] = left_out.get(place, 0) + 1
    told += [Problem(place, f"and {number:,} more like these in the group") for place, number in left_out.items()]
    return told
