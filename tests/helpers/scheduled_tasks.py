"""Tasks for the scheduler, and what its tests tell and ask it."""

from typing import Any

from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, FailureKind, Resources, Task, TaskId
from pipeline.run.events import Committed, Failed, Finish, Finished, Instruction, JobOutcome, Start, Tick
from pipeline.run.scheduler import Scheduler
from pipeline.store.receipts import Receipt

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


def begun(tasks: list[Task], **options: Any) -> Scheduler:
    """A scheduler of two cores, which has given its first instructions."""
    scheduler = Scheduler(tasks, capacity=TWO_CORES, **options)
    scheduler.start()
    return scheduler


def started(instructions: list[Instruction]) -> list[str]:
    return [instruction.task.id for instruction in instructions if isinstance(instruction, Start)]


def outcome(instructions: list[Instruction]) -> JobOutcome | None:
    return next((each.outcome for each in instructions if isinstance(each, Finish)), None)


def committed(name: str, artifact: str) -> Committed:
    path, task_id = ArtifactPath(artifact), TaskId(name)
    return Committed(task_id, 1, Receipt(path, task_id, "any", 1, "f", "p", 0, 0, "h"))


def finished(name: str) -> Finished:
    return Finished(TaskId(name), 1, seconds=0.0, peak_memory_bytes=0)


def commit(scheduler: Scheduler, name: str, artifact: str) -> list[Instruction]:
    return scheduler.handle(committed(name, artifact))


def succeed(scheduler: Scheduler, one: Task) -> list[Instruction]:
    instructions = []
    for artifact in one.outputs:
        instructions += commit(scheduler, one.id, artifact)
    return instructions + scheduler.handle(finished(one.id))


def fail(scheduler: Scheduler, name: str, kind: FailureKind, now: float = 0.0) -> list[Instruction]:
    return [*scheduler.handle(Tick(now)), *scheduler.handle(Failed(TaskId(name), 1, kind, "by chance"))]
