"""Tasks for the scheduler, and what its tests tell and ask it."""

from __future__ import annotations

from pipeline.parameter_set import ParameterSet
from pipeline.scheduler import Scheduler
from pipeline.scheduler_events import (
    ArtifactCommitted,
    Finish,
    Instruction,
    JobOutcome,
    Start,
    TaskFailed,
    TaskSucceeded,
)
from pipeline.task import ArtifactPath, FailureKind, Resources, Task, TaskId

PARAMETERS = ParameterSet.of(stage="any", version=1, tools={})
TWO_CORES = Resources(cores=2)


def task(
    name: str,
    inputs: tuple[str, ...] = (),
    outputs: tuple[str, ...] | None = None,
    *,
    frame: int | None = None,
    resources: Resources | None = None,
    checkpointed: bool = False,
) -> Task:
    return Task(
        id=TaskId(name),
        stage=name.partition("/")[0],
        inputs=tuple(map(ArtifactPath, inputs)),
        outputs=tuple(map(ArtifactPath, (f"{name}.out",) if outputs is None else outputs)),
        parameters=PARAMETERS,
        frame=frame,
        resources=resources or Resources(),
        checkpointed=checkpointed,
    )


def film(frames: int, *, simulation: Resources | None = None) -> list[Task]:
    """simulate -> surface -> render, by frame, then a movie of all."""
    caches = tuple(f"cache/{k}" for k in range(frames))
    return [
        task("simulate", (), caches, checkpointed=True, resources=simulation),
        *(task(f"surface/{k}", (caches[k],), frame=k) for k in range(frames)),
        *(task(f"render/{k}", (f"surface/{k}.out",), frame=k) for k in range(frames)),
        task("movie", tuple(f"render/{k}.out" for k in range(frames))),
    ]


def started(instructions: list[Instruction]) -> list[str]:
    return [instruction.task.id for instruction in instructions if isinstance(instruction, Start)]


def outcome(instructions: list[Instruction]) -> JobOutcome | None:
    return next((each.outcome for each in instructions if isinstance(each, Finish)), None)


def commit(scheduler: Scheduler, name: str, artifact: str) -> list[Instruction]:
    return scheduler.handle(ArtifactCommitted(TaskId(name), ArtifactPath(artifact)))


def succeed(scheduler: Scheduler, one: Task) -> list[Instruction]:
    instructions = []
    for artifact in one.outputs:
        instructions += commit(scheduler, one.id, artifact)
    return instructions + scheduler.handle(TaskSucceeded(one.id))


def fail(scheduler: Scheduler, name: str, kind: FailureKind, now: float = 0.0) -> list[Instruction]:
    return scheduler.handle(TaskFailed(TaskId(name), kind, now))
