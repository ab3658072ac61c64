"""Tasks and artifacts for the tests of the record: a small film of text files."""

from collections.abc import Mapping
from pathlib import Path

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId, task_fingerprint
from pipeline.store.artifacts import committing
from pipeline.store.receipts import Receipt


def parameter_set(stage: str, **values: object) -> ParameterSet:
    return ParameterSet.of(stage=stage, version=1, tools={"tool": "1.0"}, **values)


def film(frames: int, *, viscosity: float = 1.0, camera: tuple[int, ...] = (0, -5, 2)) -> list[Task]:
    """simulate (checkpointed) -> one render a frame -> film."""
    simulate = parameter_set("simulate", fluid=[{"name": "water", "viscosity": viscosity}])
    render = parameter_set("render", camera={"position": camera})
    cache = [ArtifactPath(f"cache/{k:06d}.h5") for k in range(frames)]
    pictures = [ArtifactPath(f"frames/{k:06d}.png") for k in range(frames)]
    return [
        Task(TaskId("simulate"), "simulate", (), tuple(cache), simulate, checkpointed=True),
        *(
            Task(TaskId(f"render/{k:06d}"), "render", (cache[k],), (pictures[k],), render, frame=k)
            for k in range(frames)
        ),
        Task(TaskId("film"), "movie", tuple(pictures), (ArtifactPath("movie.mp4"),), parameter_set("movie")),
    ]


def validate_text(path: Path) -> None:
    """The sample's decoder: a whole file ends with END."""
    if not path.read_bytes().endswith(b"END"):
        raise InvalidArtifactError(f"{path.name}: truncated")


def commit(
    layout: JobLayout,
    task: Task,
    artifact: ArtifactPath,
    content: str,
    *,
    attempt: int = 1,
    hashes: Mapping[ArtifactPath, str] | None = None,
) -> Receipt:
    inputs = {path: (hashes or {})[path] for path in task.inputs}
    layout.root.mkdir(parents=True, exist_ok=True)
    with committing(
        layout,
        artifact,
        task=task,
        attempt=attempt,
        fingerprint=task_fingerprint(task, inputs),
        validate=validate_text,
        inputs=inputs,
    ) as handle:
        handle.path.write_text(f"{content} END")
    return handle.receipt


def make_film(layout: JobLayout, tasks: list[Task], *, attempt: int = 1) -> list[Receipt]:
    """Commit every output of every task."""
    hashes: dict[ArtifactPath, str] = {}
    receipts = []
    for task in tasks:
        for output in task.outputs:
            receipt = commit(layout, task, output, f"{output} by {task.id}", attempt=attempt, hashes=hashes)
            hashes[output] = receipt.hash
            receipts.append(receipt)
    return receipts
