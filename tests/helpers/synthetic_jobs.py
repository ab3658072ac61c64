"""Jobs over the synthetic stages, and running them."""

from pathlib import Path
from typing import Any

import synthetic_stages

from pipeline.base.layout import JobLayout
from pipeline.base.task import Policy, Resources, TaskId, TaskState
from pipeline.job.loading import load_job
from pipeline.run.events import Outcome, RunEvent, StateChanged
from pipeline.run.executors.base import Executor
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.runner import run_job


def job_text(*, frames: int = 6, gravity: float = -9.81, focal_length_mm: float = 50.0) -> str:
    return f"""
name = "synthetic"
frames = {frames}
gravity = [0.0, 0.0, {gravity}]
camera.focal_length_mm = {focal_length_mm}

[[smoke]]
name = "plume"
source = [{{ shape = {{ type = "sphere", radius = 0.1 }}, position = [0.0, 0.0, 0.2] }}]
"""


def run_synthetic(root: Path, executor: Executor, text: str | None = None, **options: Any) -> Outcome:
    """Run the synthetic job in `root`; retries come at once."""
    layout = JobLayout(root)
    root.mkdir(parents=True, exist_ok=True)
    text = job_text() if text is None else text
    source = root.parent / f"{root.name}.toml"
    source.write_text(text)
    options = {"policy": Policy(backoff_s=0.01), "capacity": Resources(cores=2), **options}
    return run_job(
        load_job(source), layout, executor=executor, job_text=text, stages=synthetic_stages.REFERENCE, **options
    )


class Recorder:
    """An observer that keeps all events."""

    def __init__(self) -> None:
        self.events: list[RunEvent] = []

    def notify(self, event: RunEvent) -> None:
        self.events.append(event)

    def of(self, kind: type[RunEvent]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    def ran(self) -> list[TaskId]:
        """Tasks that were started, in order."""
        return [e.task_id for e in self.of(StateChanged) if e.state is TaskState.SUCCEEDED]


def run_recorded(root: Path, text: str | None = None, **options: Any) -> tuple[Outcome, Recorder]:
    """Run the synthetic job in this process; returns how it ended, and all that it told."""
    recorder = Recorder()
    with InlineExecutor() as executor:
        return run_synthetic(root, executor, text, observers=[recorder.notify], **options), recorder


def contents(root: Path) -> dict[str, bytes]:
    """Bytes of every artifact of the synthetic stages."""
    paths = [*root.glob("steps/*.bin"), *root.glob("double/*.bin"), root / "film.bin"]
    return {str(path.relative_to(root)): path.read_bytes() for path in paths}
