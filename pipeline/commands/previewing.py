"""Commands that draw a job's frames otherwise than its film has them: still."""

from __future__ import annotations

import os
import shlex
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.arguments import find_job, require_own_programs, submitted_job_argument
from pipeline.errors import PipelineError, StageUnavailableError
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.stills import StillPlan

_QUALITIES = ("draft", "preview", "final")


@click.command()
@submitted_job_argument
@click.option("--frame", type=click.IntRange(min=0), required=True, help="Which frame.")
@click.option("--quality", type=click.Choice(_QUALITIES), default="final", show_default=True, help="How well drawn.")
@click.option("--resolution", type=(int, int), metavar="WIDTH HEIGHT", help="Size [pixels]; the job's if omitted.")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Override a key: render.exposure=0.5, stage.name=..."
)
@click.option(
    "-o",
    "--to",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Where to write it; in JOB/stills/ if omitted.",
)
@click.option("--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all if omitted.")
def still(
    job: str,
    *,
    output: Path,
    frame: int,
    quality: str,
    resolution: tuple[int, int] | None,
    overrides: tuple[str, ...],
    target: Path | None,
    cores: int | None,
) -> None:
    """Draw one frame of a job in another quality, size, light or from elsewhere, of what is simulated already.

    The job's own frames and its record stay as they are. Works while it runs.

    \b
    pipeline still quickstart --frame 90
    pipeline still quickstart --frame 90 --resolution 3840 2160 -o poster.png
    pipeline still quickstart --frame 90 --quality preview --set 'camera.position=[0, -3, 1]'
    """
    from pipeline.executors.worker_process import THREAD_VARIABLES
    from pipeline.job.loading import read_job
    from pipeline.resources import machine_capacity
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stills import make_still, plan_still

    layout = JobLayout(find_job(job, output).root.absolute())
    changes = [f"render.quality={quality}"]
    changes += [] if resolution is None else [f"render.resolution=[{resolution[0]}, {resolution[1]}]"]
    loaded = read_job(layout.job_file, [*changes, *overrides])
    require_own_programs(loaded, overrides)
    plan = plan_still(loaded, layout, frame, stages=STAGES_REFERENCE)
    if plan.lacking is not None:
        raise PipelineError(_why_lacking(plan.lacking, layout, frame))
    path = layout.stills / f"{frame:06d}-{_words(loaded)}.png" if target is None else target
    if path.suffix.lower() != ".png":
        raise PipelineError(f'{path}: a still is a PNG, so its name must end in ".png"')
    _require_possible(loaded, plan)
    capacity = machine_capacity(gpus=1)
    capacity = replace(capacity, cores=min(cores or capacity.cores, capacity.cores))
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(capacity.cores)))  # before anything reads them
    width, height = loaded.job.render.resolution
    made = _made_first(plan)
    click.echo(
        f"frame {frame} of {loaded.job.name}: {f'{made}, then ' if made else ''}"
        f"{width} x {height} pixels, {loaded.job.render.quality} quality",
        err=True,
    )
    with redirect_stdout(sys.stderr):  # what the stages print is no output of this command
        make_still(
            loaded,
            plan,
            layout,
            path,
            capacity=capacity,
            stages=STAGES_REFERENCE,
            say=lambda sentence: click.echo(f"  {sentence}", err=True),
        )
    click.echo(path)


def _words(loaded: LoadedJob) -> str:
    width, height = loaded.job.render.resolution
    return f"{loaded.job.render.quality}-{width}x{height}"


def _made_first(plan: StillPlan) -> str:
    """What is made before the frame is drawn, as `surface, 3 of whitewater`; empty if all is there."""
    counts: dict[str, int] = {}
    for task in plan.todo[:-1]:
        counts[task.stage] = counts.get(task.stage, 0) + 1
    return ", ".join(stage if count == 1 else f"{count} of {stage}" for stage, count in counts.items())


def _why_lacking(artifact: str, layout: JobLayout, frame: int) -> str:
    """Whether the simulation has not come so far, or the options ask for another one."""
    from pipeline.job.loading import read_job
    from pipeline.lease import live_holder
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stills import plan_still

    if plan_still(read_job(layout.job_file), layout, frame, stages=STAGES_REFERENCE).lacking is None:
        return (
            "--set changes what is simulated, and a still shows what this job has simulated; "
            f"submit a job of its own: pipeline submit {shlex.quote(str(layout.job_file))} --set name=... --set ..."
        )
    if live_holder(layout.lease) is not None:
        return f"{artifact} is not simulated yet; the job is running: wait for it with pipeline watch"
    return f"{artifact} is not simulated yet; go on with: pipeline resume {shlex.quote(str(layout.root))}"


def _require_possible(loaded: LoadedJob, plan: StillPlan) -> None:
    """Refuse before any work what this machine cannot do."""
    from pipeline.stages import STAGES

    stages = {task.stage for task in plan.todo}
    obstacles = [
        f"{stage.name}: {obstacle}"
        for stage in STAGES
        if stage.name in stages
        for obstacle in stage.obstacles(loaded.job)
    ]
    if obstacles:
        raise StageUnavailableError("\n".join(obstacles))
