"""On which machines a job runs: the options, and the executor that they name."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base.errors import PipelineError, StageUnavailableError

if TYPE_CHECKING:
    from pipeline.base.layout import JobLayout
    from pipeline.base.task import Resources
    from pipeline.model.job import Job
    from pipeline.run.executors.base import Executor

KINDS = ("processes", "dask", "inline")

executor_options = (
    click.option(
        "--executor",
        type=click.Choice(KINDS),
        help="processes: on this machine, the default. dask: on a Dask cluster, or one of this machine. "
        "inline: in this process, for debugging.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="The Dask scheduler: its address, such as tcp://farm:8786, or its scheduler file.",
    ),
    click.option(
        "--workers", type=click.IntRange(min=1), help="Dask workers on this machine, where there is no scheduler."
    ),
)


@dataclass(frozen=True, slots=True)
class ExecutorChoice:
    """Which executor, and where."""

    executor: str = "processes"  # one of KINDS
    # address of a Dask scheduler, or absolute path of its file; None: a cluster of this machine alone
    scheduler: str | None = None
    workers: int | None = None  # how many workers that one has

    @classmethod
    def of(cls, executor: str | None, scheduler: str | None, workers: int | None) -> ExecutorChoice:
        """What the options mean. Raises UsageError if they do not go together."""
        if scheduler is not None and workers is not None:
            raise click.UsageError("--workers is for a cluster of this machine; with --scheduler, start workers there")
        if executor not in {None, "dask"} and (scheduler or workers):
            raise click.UsageError("--scheduler and --workers are for --executor dask")
        if scheduler is not None and "://" not in scheduler:  # whoever runs the queue may be elsewhere
            scheduler = str(Path(scheduler).absolute())
        kind = executor or ("dask" if scheduler or workers else "processes")
        return cls(kind, scheduler, workers)

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """For the queue."""
        values = {**asdict(self), "executor": None if self.executor == "processes" else self.executor}
        return tuple((name, str(value)) for name, value in values.items() if value is not None)

    @classmethod
    def from_settings(cls, settings: tuple[tuple[str, str], ...]) -> ExecutorChoice:
        """From the queue. Raises PipelineError if an entry says what this program does not know."""
        values = dict(settings)
        kind, workers = values.get("executor", "processes"), values.get("workers")
        if kind not in KINDS or (workers is not None and not workers.isdecimal()):
            raise PipelineError(f"the queue asks for an executor that there is none of: {values}")
        return cls(kind, values.get("scheduler"), None if workers is None else int(workers))


@dataclass(frozen=True, slots=True)
class Machines:
    """An executor, what tasks may use at a time, and the most that one of them can be given, where that is less."""

    executor: Executor
    capacity: Resources
    machine: Resources | None = None


@contextmanager
def open_machines(
    choice: ExecutorChoice, layout: JobLayout, here: Resources, say: Callable[[str], None]
) -> Iterator[Machines]:
    """Make an executor ready with what may be used of this machine, `here`; it is shut down at the end of the block.

    Raises PipelineError: Dask is not installed, or there is no cluster.
    """
    from pipeline.run.executors.inline import InlineExecutor
    from pipeline.run.executors.processes import ProcessExecutor

    match choice.executor:
        case "processes":
            with ProcessExecutor(gpus=here.gpus) as processes:
                yield Machines(processes, here)
        case "inline":
            with InlineExecutor() as inline:
                yield Machines(inline, replace(here, cores=1))
        case _:
            with _open_dask(choice, layout, here, say) as machines:
                yield machines


def require_named_devices(job: Job, stages: Collection[str]) -> None:
    """Refuse a device that each of several machines would choose for itself: CPU and GPU round differently.

    Raises PipelineError: one of the stages that are to run leaves its device open.
    """
    devices = (("device", "simulate", job.chosen_device), ("render.device", "render", job.render.device))
    names = [name for name, stage, device in devices if stage in stages and device == "auto"]
    if names:
        raise PipelineError(
            f"{' and '.join(names)} = auto, but machines may differ: choose for all of them, as with "
            f"{' '.join(f'--set {name}=cpu' for name in names)} (on GPUs: device=cuda, render.device=gpu)"
        )


def require_possible(job: Job, stages: Collection[str]) -> None:
    """Refuse before any work what has to be done and cannot be done here.

    Raises StageUnavailableError: one of the stages that are to run cannot run on this machine.
    """
    from pipeline.stages import STAGES

    obstacles = [
        f"{stage.name}: {obstacle}" for stage in STAGES if stage.name in stages for obstacle in stage.preflight(job)
    ]
    if obstacles:
        raise StageUnavailableError("\n".join(obstacles))


def scheduler_address(named: str) -> str:
    """An address as it is, or that in the file that `dask scheduler --scheduler-file` wrote. Raises PipelineError."""
    if "://" in named:
        return named
    try:
        address = json.loads(Path(named).read_text(encoding="utf-8"))["address"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise PipelineError(
            f"--scheduler {named}: not an address like tcp://farm:8786, and no scheduler file: {error}"
        ) from error
    return str(address)


@contextmanager
def _open_dask(
    choice: ExecutorChoice, layout: JobLayout, here: Resources, say: Callable[[str], None]
) -> Iterator[Machines]:
    if find_spec("distributed") is None:
        raise PipelineError("--executor dask needs the package distributed: pip install distributed")
    from pipeline.run.executors.dask import DaskExecutor
    from pipeline.run.executors.dask_local import local_cluster, split

    layout.root.mkdir(parents=True, exist_ok=True)  # the workers are asked whether they see it
    with ExitStack() as stack:
        address = None if choice.scheduler is None else scheduler_address(choice.scheduler)
        if address is None:
            try:
                shares = split(here, choice.workers or 1)
            except ValueError as error:
                raise PipelineError(f"{error}; use fewer --workers") from error
            address = stack.enter_context(local_cluster(shares))
        executor = stack.enter_context(
            DaskExecutor(address, layout.root.absolute(), of_runner=choice.scheduler is None, say=say)
        )
        # A worker with a GPU may come later; the executor waits for it, and says so.
        yield Machines(executor, executor.capacity, replace(executor.machine, gpus=max(1, executor.machine.gpus)))
