"""Commands that draw a job's frames otherwise than its film has them: still, animatic."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.arguments import find_job, require_own_programs, submitted_job_argument, target_option
from pipeline.commands.executing import require_possible
from pipeline.errors import PipelineError, StageUnavailableError
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.stills import Survey
    from pipeline.task import Resources

_QUALITIES = ("draft", "preview", "final")
_POSITION, _KEYFRAMES = "camera.position", "camera.keyframe"
_TOLD_FRAMES = 10
"""One of so many frames of an animatic is told."""


@click.command()
@submitted_job_argument
@click.option("--frame", type=click.IntRange(min=0), required=True, help="Which frame.")
@click.option("--quality", type=click.Choice(_QUALITIES), default="final", show_default=True, help="How well drawn.")
@click.option("--resolution", type=(int, int), metavar="WIDTH HEIGHT", help="Size [pixels]; the job's if omitted.")
@click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Override a key: render.exposure=0.5, stage.name=..."
)
@target_option("; in JOB/stills/ if omitted")
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
    from pipeline.job.loading import read_job
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stills import make_still, survey

    layout = JobLayout(find_job(job, output).root.absolute())
    changes = [f"render.quality={quality}"]
    changes += _other_ways_off([each.partition("=")[0].strip() for each in overrides])
    changes += [] if resolution is None else [f"render.resolution=[{resolution[0]}, {resolution[1]}]"]
    loaded = read_job(layout.job_file, [*changes, *overrides])
    require_own_programs(loaded, overrides)
    found = survey(loaded, layout, [frame], stages=STAGES_REFERENCE)
    if found.lacking:
        raise PipelineError(_why_lacking(found.lacking[-1], layout, frame))
    path = layout.stills / f"{frame:06d}-{_words(loaded, overrides)}.png" if target is None else target
    if path.suffix.lower() != ".png":
        raise PipelineError(f'{path}: a still is a PNG, so its name must end in ".png"')
    require_possible(loaded.job, {task.stage for task in found.todo})
    _make_folder(path)
    capacity = _capacity(cores)
    width, height = loaded.job.render.resolution
    made = _made_first(found)
    click.echo(
        f"frame {frame} of {loaded.job.name}: {f'{made}, then ' if made else ''}"
        f"{width} x {height} pixels, {loaded.job.render.quality} quality",
        err=True,
    )
    with redirect_stdout(sys.stderr):  # what the stages print is no output of this command
        make_still(
            loaded,
            found,
            layout,
            path,
            capacity=capacity,
            stages=STAGES_REFERENCE,
            say=lambda sentence: click.echo(f"  {sentence}", err=True),
        )
    click.echo(path)


def _other_ways_off(keys: Sequence[str]) -> list[str]:
    """Overrides that keep the job from leading the camera elsewhere: who says where it stands means it."""
    if _KEYFRAMES in keys:
        return ["camera.framing=domain"]
    if _POSITION in keys:
        return ["camera.framing=domain", f"{_KEYFRAMES}=[]", "camera.easing=smooth"]
    return []


def _words(loaded: LoadedJob, overrides: tuple[str, ...]) -> str:
    """What tells stills of a frame apart; those with other keys by a digest of them."""
    from pipeline.parameter_set import digest_of

    width, height = loaded.job.render.resolution
    other = f"-{digest_of(' '.join(overrides))[:6]}" if overrides else ""
    return f"{loaded.job.render.quality}-{width}x{height}{other}"


def _make_folder(target: Path) -> None:
    """Before minutes of drawing, see that there is a place for what is drawn."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise PipelineError(f"cannot write {target}: {error.strerror}") from error
    if not os.access(target.parent, os.W_OK):
        raise PipelineError(f"cannot write {target}: its folder is not writable")


def _made_first(found: Survey) -> str:
    """What is made before the frame is drawn, as `surface, 3 of whitewater`; empty if all is there."""
    counts: dict[str, int] = {}
    for task in found.todo[:-1]:
        counts[task.stage] = counts.get(task.stage, 0) + 1
    return ", ".join(stage if count == 1 else f"{count} of {stage}" for stage, count in counts.items())


def _why_lacking(artifact: str, layout: JobLayout, frame: int) -> str:
    """Whether the simulation has not come so far, or the options ask for another one."""
    from pipeline.job.loading import read_job
    from pipeline.lease import live_holder
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stills import survey

    if not survey(read_job(layout.job_file), layout, [frame], stages=STAGES_REFERENCE).lacking:
        return (
            "--set changes what is simulated, and a still shows what this job has simulated; "
            f"submit a job of its own: pipeline submit {shlex.quote(str(layout.job_file))} --set name=... --set ..."
        )
    if read_job(layout.job_file).job.camera.frames_action:
        artifact = f"{artifact}, which the camera's framing of the whole action needs,"
    if live_holder(layout.lease) is not None:
        return f"{artifact} is not simulated yet; the job is running: wait for it with pipeline watch"
    return f"{artifact} is not simulated yet; go on with: pipeline resume {shlex.quote(str(layout.root))}"


@click.command()
@submitted_job_argument
@click.option("--width", type=click.IntRange(64, 3840), default=640, show_default=True, help="Of the film [pixels].")
@target_option("; JOB/NAME-animatic.mp4 if omitted")
@click.option("--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all if omitted.")
def animatic(job: str, *, output: Path, width: int, target: Path | None, cores: int | None) -> None:
    """Show how a job moves before it is rendered: its whole film in plain pictures, a fraction of a second each.

    Of what is simulated already; surfaces and volumes that are still missing are made, and the job keeps them. Drawn by
    Blender's Workbench, which needs EGL: on Debian the packages libegl1 and libgl1-mesa-dri.

    \b
    pipeline animatic quickstart
    pipeline animatic quickstart --width 1280 -o moves.mp4
    """
    from pipeline.animatics import drawable_frames, made_before, make_animatic
    from pipeline.job.loading import read_job
    from pipeline.lease import refuse_if_held
    from pipeline.runner import STAGES_REFERENCE
    from pipeline.stage_run import run_tasks
    from pipeline.stills import survey
    from render.blender import BlenderUnavailableError
    from render.workbench import require_workbench

    layout = JobLayout(find_job(job, output).root.absolute())
    submitted = read_job(layout.job_file)
    require_own_programs(submitted, ())
    size = _fitted(submitted.job.render.resolution, width)
    loaded = read_job(layout.job_file, [f"render.resolution=[{size[0]}, {size[1]}]"])
    path = layout.root / f"{submitted.job.name}-animatic.mp4" if target is None else target
    if path.suffix.lower() != ".mp4":
        raise PipelineError(f'{path}: an animatic is an MP4, so its name must end in ".mp4"')
    planned = submitted.job.frame_count
    found = survey(loaded, layout, range(planned), stages=STAGES_REFERENCE)
    frames = drawable_frames(found)
    if frames == 0:
        raise PipelineError(_why_lacking(found.lacking[0], layout, 0))
    _make_folder(path)
    try:
        require_workbench(loaded.job.render.blender)
    except BlenderUnavailableError as error:
        raise StageUnavailableError(str(error)) from error
    todo = made_before(found, frames)
    if todo:
        refuse_if_held(layout.lease)  # whoever runs the job makes them
        require_possible(loaded.job, {task.stage for task in todo})
    capacity = _capacity(cores)
    shown = f"{frames} frames" if frames == planned else f"the {frames} of {planned} frames that are simulated"
    click.echo(f"{shown}, {size[0]} x {size[1]} pixels{f'; {len(todo)} files to make first' if todo else ''}", err=True)
    with redirect_stdout(sys.stderr):  # what the stages print is no output of this command
        outcome = run_tasks(
            todo,
            layout,
            capacity=capacity,
            stages=STAGES_REFERENCE,
            stop_requested=lambda: False,
            tell=lambda share, sentence: click.echo(f"{100 * share:.0f} %  {sentence}", err=True),
        )
    if outcome.failures:
        failed = outcome.failures[0]
        raise PipelineError(f"{failed.task_id}: {failed.message}")
    make_animatic(
        loaded,
        layout,
        frames,
        path,
        threads=capacity.cores,
        stages=STAGES_REFERENCE,
        drawn=lambda frame: click.echo(f"  frame {frame}", err=True) if frame % _TOLD_FRAMES == 0 else None,
    )
    click.echo(path)


def _fitted(resolution: tuple[int, int], width: int) -> tuple[int, int]:
    """A size of the same proportions, so wide; even, as video needs it."""
    height = width * resolution[1] / resolution[0]
    return max(16, 2 * round(width / 2)), max(16, 2 * round(height / 2))


def _capacity(cores: int | None) -> Resources:
    """What one task in this process may use; tells the libraries that count cores for themselves."""
    from pipeline.executors.worker_process import THREAD_VARIABLES
    from pipeline.resources import machine_capacity

    capacity = machine_capacity(gpus=1)
    capacity = replace(capacity, cores=min(cores or capacity.cores, capacity.cores))
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(capacity.cores)))  # before anything reads them
    return capacity
