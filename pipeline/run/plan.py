"""From a job to its tasks, and from tasks and the record to what would run, and why. Pure: no file is touched here."""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import chain
from pathlib import PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from pipeline.base.errors import PlanError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet, explain_difference
from pipeline.base.paused_gc import many_objects
from pipeline.base.task import ArtifactPath, Task, TaskId, task_fingerprint
from pipeline.record.reader import ArtifactRow
from pipeline.record.reconcile import FileCondition, FileProblem

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from pipeline.stages.base import Stage


NEVER_MADE = "never made"
"""The group of reasons of outputs that are not on record."""


_CONDITION_WORDING = {
    FileCondition.MISSING: "file is missing",
    FileCondition.EDITED: "file was edited by hand; the edited one will be kept aside",
    FileCondition.INTERRUPTED: "its commit was cut short",
}


class Verdict(StrEnum):
    """What would become of a task."""

    UP_TO_DATE = "up to date"
    STALE = "stale"
    """It will run."""
    DOWNSTREAM = "downstream"
    """Its inputs will be made anew; it runs if they turn out different."""


class Reason(NamedTuple):
    """Why a task is not up to date: a `text` about this one task, and a `group` that many tasks alike share."""

    text: str
    group: str


@dataclass(frozen=True, slots=True)
class Assessment:
    """One task's verdict."""

    task: Task
    verdict: Verdict  # what would become of it
    reasons: tuple[Reason, ...] = ()  # why; empty if it is up to date
    # the outputs that would be made, or made anew. Of a checkpointed task only those that need it
    rebuilds: tuple[ArtifactPath, ...] = ()


def plan_job(job: Job, layout: JobLayout, stages: Sequence[Stage], until: Sequence[str] = ()) -> list[Task]:
    """The tasks of a job, makers before users.

    With stages `until` after which the job ends, only their tasks and what these need. What comes after them is not
    even asked for a plan, as that may need a Blender. A stage may be named with frames, as `surface:10-19`. Stages on
    demand, as exports are, are planned only where they are named.

    Raises:
        PlanError: two tasks share a name or an output, an input has no maker, tasks wait for each other in a circle, or
            the job has no task of a stage that it is to end after.
    """
    with many_objects():
        if not until:
            return in_order([task for stage in stages if not stage.on_demand for task in stage.plan(job, layout)])
        ends = require_ends(until, stages)
        names = [stage.name for stage in stages]
        last = max(names.index(name) for name in ends)
        asked = [stage for stage in stages[: last + 1] if not stage.on_demand or stage.name in ends]
        tasks = in_order([t for stage in asked for t in stage.of_frames(ends.get(stage.name)).plan(job, layout)])
        wanted = {
            task.id
            for task in tasks
            if task.stage in ends and (task.frame is None or task.frame in (ends[task.stage] or {task.frame}))
        }
        for name in ends:
            if all(task.stage != name for task in tasks if task.id in wanted):
                theirs = ", ".join(dict.fromkeys(task.stage for task in tasks)) or "none before it"
                raise PlanError(f'this job has nothing for the stage "{name}"; it has {theirs}')
        return made_from(wanted, tasks)


def require_ends(until: Sequence[str], stages: Sequence[Stage]) -> dict[str, frozenset[int] | None]:
    """Stages after which a job ends, each with its frames that are wanted, None for all.

    Raises PlanError: there is no such stage, or frames are none.
    """
    ends: dict[str, frozenset[int] | None] = {}
    for name, frames in map(parse_end, until):
        others = ends.get(name, frozenset())
        ends[name] = None if frames is None or others is None else others | frames
    names = [stage.name for stage in stages]
    for name in ends:
        if name not in names:
            raise PlanError(f'no stage "{name}"; the stages are {", ".join(names)}')
    return ends


def parse_end(text: str) -> tuple[str, frozenset[int] | None]:
    """A stage after which a job ends, and its frames that are wanted: `surface` or `surface:0-9,20`.

    Raises PlanError: the frames are none.
    """
    name, colon, ranges = text.partition(":")
    return name, parse_frames(ranges) if colon else None


_MOST_FRAMES = 1_000_000
_RANGE = re.compile(r"(\d+)(?:-(\d+)(?:x([1-9]\d*))?)?", re.ASCII)


def parse_frames(text: str) -> frozenset[int]:
    """Frame numbers from `3`, `0-9`, `0-9,20,30-39` or `0-99x10`, every tenth. Raises PlanError."""
    frames: set[int] = set()
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None:
            raise PlanError(f'"{part.strip()}" is not a frame or a range of frames, like 7 or 0-29 or 0-29x5')
        start, stop, step = int(match[1]), int(match[2] or match[1]), int(match[3] or 1)
        if stop < start:
            raise PlanError(f'"{part.strip()}" runs backwards')
        if stop - start > _MOST_FRAMES:
            raise PlanError(f'"{part.strip()}" is more than a million frames')
        frames.update(range(start, stop + 1, step))
    return frozenset(frames)


def made_from(targets: Collection[TaskId], tasks: Sequence[Task]) -> list[Task]:
    """These tasks and all that they are made from, in the order of the plan."""
    makers = {output: each for each in tasks for output in each.outputs}
    needed, waiting = set(targets), [each for each in tasks if each.id in targets]
    while waiting:
        for artifact in waiting.pop().inputs:
            maker = makers[artifact]
            if maker.id not in needed:
                needed.add(maker.id)
                waiting.append(maker)
    return [each for each in tasks if each.id in needed]


def in_order(tasks: Sequence[Task]) -> list[Task]:
    """The tasks with makers before users. Raises PlanError, see `plan_job`."""
    makers: dict[ArtifactPath, TaskId] = {}
    names: set[TaskId] = set()
    for task in tasks:
        if task.id in names:
            raise PlanError(f"two tasks are called {task.id}")
        names.add(task.id)
        for output in task.outputs:
            if output in makers:
                raise PlanError(f"{output} is made by two tasks, {makers[output]} and {task.id}")
            makers[output] = task.id
    if _makers_first(tasks, makers):
        return [*tasks]
    by_id = {task.id: task for task in tasks}
    sorter = TopologicalSorter({task.id: {makers[path]: None for path in task.inputs} for task in tasks})
    try:
        return [by_id[task_id] for task_id in sorter.static_order()]
    except CycleError as error:
        raise PlanError(f"tasks wait for each other in a circle: {', '.join(error.args[1])}") from None


def _makers_first(tasks: Sequence[Task], makers: Mapping[ArtifactPath, TaskId]) -> bool:
    """Whether the tasks stand in order already, as those of stages in order do; checks that every input is made."""
    seen: set[TaskId] = set()
    in_order = True
    for task in tasks:
        for path in task.inputs:
            maker = makers.get(path)
            if maker is None:
                raise PlanError(f"{task.id} reads {path}, which no task makes")
            in_order = in_order and maker in seen
        seen.add(task.id)
    return in_order


def frame_turns(job: Job) -> list[int] | None:
    """The turn of each frame, 0 for the first; None: as in the film."""
    return spread_turns(job.frame_count) if job.render.order == "spread" else None


def spread_turns(frames: int) -> list[int]:
    """Turns of frames that are taken from all over the film: the first, the last, the middle, then between these.

    After any number of turns no gap is more than twice as long as another, give or take a frame.
    """
    turns = [0] * frames
    taken = 0
    for frame in dict.fromkeys((0, frames - 1)):
        turns[frame] = taken
        taken += 1
    gaps = deque([(0, frames - 1)])
    while gaps:
        before, after = gaps.popleft()
        if after - before < 2:
            continue
        middle = (before + after) // 2
        turns[middle] = taken
        taken += 1
        gaps += [(before, middle), (middle, after)]
    return turns


def up_to_date(task: Task, rows: Mapping[ArtifactPath, ArtifactRow]) -> bool:
    """Whether every output is there with the fingerprint that the task has now; all its inputs are in `rows`.

    This is the early cutoff at dispatch: asked once a task's inputs are committed, it saves the run if what was made
    anew upstream turned out the same.
    """
    fingerprint = task_fingerprint(task, input_hashes(task, rows))
    return all(output in rows and rows[output].fingerprint == fingerprint for output in task.outputs)


def input_hashes(task: Task, rows: Mapping[ArtifactPath, ArtifactRow]) -> dict[ArtifactPath, str]:
    """Content hash of each of a task's inputs."""
    return {path: rows[path].hash for path in task.inputs}


def assess(
    tasks: Sequence[Task],
    rows: Mapping[ArtifactPath, ArtifactRow],
    problems: Mapping[ArtifactPath, FileProblem],
    *,
    parameters: Callable[[str], ParameterSet | None],
    forced: frozenset[TaskId] = frozenset(),
) -> list[Assessment]:
    """What would run, and why, of a plan with makers before users, held against the artifacts on record.

    `problems` are of recorded artifacts whose file does not count; see `reconcile.inspect_files`. `parameters` finds an
    old parameter set by its digest, to name what changed. Tasks that are `forced` run whatever the record says.
    """
    with many_objects():
        assessor = _Assessor(rows, problems, parameters, forced)
        return [assessor.assess(task) for task in tasks]


@dataclass
class _Assessor:
    """Walks the plan from makers to users, and remembers which artifacts will be made anew."""

    rows: Mapping[ArtifactPath, ArtifactRow]
    problems: Mapping[ArtifactPath, FileProblem]
    parameters: Callable[[str], ParameterSet | None]
    forced: frozenset[TaskId]

    def __post_init__(self) -> None:
        self._rebuilt: set[ArtifactPath] = set()
        self._parameter_reasons = cache(self._compare_parameters)

    def assess(self, task: Task) -> Assessment:
        assessment = self._assess(task)
        self._rebuilt.update(assessment.rebuilds)
        return assessment

    def _assess(self, task: Task) -> Assessment:
        if task.id in self.forced:
            return Assessment(task, Verdict.STALE, (_same("to be run again, as asked"),), task.outputs)
        rebuilt = [path for path in task.inputs if path in self._rebuilt]
        fingerprint = None if rebuilt else task_fingerprint(task, input_hashes(task, self.rows))
        if len(task.outputs) == 1:  # as for nearly every task of a large job
            reasons = self._reasons(task, task.outputs[0], fingerprint)
            if reasons:
                return Assessment(task, Verdict.STALE, reasons, task.outputs)
            if not rebuilt:
                return Assessment(task, Verdict.UP_TO_DATE)
        found = {output: self._reasons(task, output, fingerprint) for output in task.outputs}
        bad = {output: reasons for output, reasons in found.items() if reasons}
        if bad:
            reasons = _collect(chain.from_iterable(bad.values()), len(found))
            return Assessment(task, Verdict.STALE, reasons, tuple(bad) if task.checkpointed else task.outputs)
        if rebuilt:
            reasons = _abridge(
                Reason(f"{path} will be made anew", f"{_kind(path)} will be made anew") for path in rebuilt
            )
            return Assessment(task, Verdict.DOWNSTREAM, reasons, task.outputs)
        return Assessment(task, Verdict.UP_TO_DATE)

    def _reasons(self, task: Task, output: ArtifactPath, fingerprint: str | None) -> tuple[Reason, ...]:
        """Why one output does not count; `fingerprint` is None if an input will be made anew."""
        row = self.rows.get(output)
        if row is None:
            return (Reason(f"{output} was never made", NEVER_MADE),)
        if output in self.problems:
            problem = self.problems[output]
            return (Reason(f"{output}: {problem.reason}", _CONDITION_WORDING[problem.condition]),)
        if row.parameters != task.parameters.digest:
            return self._parameter_reasons(row.parameters, task.parameters)
        if row.fingerprint == fingerprint:
            return ()
        return _abridge(self._compare_inputs(task, row, certain=fingerprint is not None))

    def _compare_parameters(self, old_digest: str, new: ParameterSet) -> tuple[Reason, ...]:
        old = self.parameters(old_digest)
        if old is None:
            return (_same("its parameters changed; what they were is not on record"),)
        return tuple(_same(clause) for clause in explain_difference(old, new))

    def _compare_inputs(self, task: Task, row: ArtifactRow, *, certain: bool) -> Iterator[Reason]:
        """What differs from the inputs of last time. Those that will be made anew cannot be compared yet."""
        used: dict[str, str] = json.loads(row.inputs)
        if not used:
            if certain:
                yield _same("its inputs changed")
            return
        for path in task.inputs:
            if path not in used:
                yield Reason(f"{path} is a new input", f"inputs from {_kind(path)} were added")
            elif path not in self._rebuilt and used[path] != self.rows[path].hash:
                yield Reason(f"{path} changed", f"{_kind(path)} changed")
        for gone in sorted(used.keys() - set(task.inputs)):
            yield Reason(f"{gone} is no input any more", f"inputs from {_kind(gone)} were dropped")


def summarize(assessments: Iterable[Assessment]) -> list[str]:
    """Human lines, many tasks in one: `render 0-119: stale, camera.position changed from [0, -5, 2] to [0, -4, 2]`."""
    frames: dict[str, list[int]] = {}
    groups: dict[tuple[str, Verdict, tuple[str, ...]], list[Task]] = {}
    for assessment in assessments:
        task = assessment.task
        if task.frame is not None:
            frames.setdefault(_label(task), []).append(task.frame)
        reasons = tuple(dict.fromkeys(reason.group for reason in assessment.reasons))
        groups.setdefault((_label(task), assessment.verdict, reasons), []).append(task)
    lines = []
    for (label, verdict, reasons), tasks in groups.items():
        wanted = {task.frame for task in tasks if task.frame is not None}
        name = f"{label} {frame_ranges(wanted, frames[label])}" if wanted else label
        lines.append(": ".join([name, ", ".join([_WORDING[verdict], *reasons])]))
    return lines


_WORDING = {
    Verdict.UP_TO_DATE: "up to date",
    Verdict.STALE: "stale",
    Verdict.DOWNSTREAM: "runs if its inputs turn out different",
}


def frame_ranges(frames: Iterable[int], planned: Iterable[int]) -> str:
    """Frames in short, as `0-11, 13`; a range runs over frames that follow each other in the plan."""
    rank = {frame: index for index, frame in enumerate(sorted(set(planned)))}
    runs: list[list[int]] = []
    for frame in sorted(set(frames)):
        if runs and rank[frame] == rank[runs[-1][-1]] + 1:
            runs[-1].append(frame)
        else:
            runs.append([frame])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _abridge(reasons: Iterable[Reason]) -> tuple[Reason, ...]:
    """One reason for each kind; where there are several, the first and how many more."""
    return tuple(
        Reason(texts[0] if len(texts) == 1 else f"{texts[0]}, and {len(texts) - 1} more like it", group)
        for group, texts in _by_group(reasons).items()
    )


def _collect(reasons: Iterable[Reason], outputs: int) -> tuple[Reason, ...]:
    """The reasons of a task's outputs as the task's; where several outputs share a kind, how many of them do."""
    return tuple(
        Reason(texts[0], group)
        if len(texts) == 1
        else _same(group if len(texts) == outputs else f"{len(texts)} of {outputs} files: {group}")
        for group, texts in _by_group(reasons).items()
    )


def _by_group(reasons: Iterable[Reason]) -> dict[str, list[str]]:
    texts: dict[str, list[str]] = {}
    for reason in reasons:
        texts.setdefault(reason.group, []).append(reason.text)
    return texts


def _label(task: Task) -> str:
    if task.frame is None:
        return task.id
    return f"{task.stage} {task.subject}" if task.subject else task.stage


def _kind(path: str) -> str:
    """What a frame's artifact is one of: its folder. One outside any folder is one of its own."""
    parent = PurePosixPath(path).parent
    return path if parent == PurePosixPath() else f"{parent}/"


def _same(sentence: str) -> Reason:
    return Reason(sentence, sentence)
