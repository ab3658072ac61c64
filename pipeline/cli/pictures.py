"""Commands that make pictures and pages of a job: still, animatic, compare, loop, report."""

from __future__ import annotations

import os
import shlex
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base.errors import PipelineError, StageUnavailableError
from pipeline.base.layout import JobLayout
from pipeline.cli.arguments import (
    claim_cores,
    complete_jobs,
    cores_option,
    find_job,
    output_option,
    overrides_option,
    submitted_job_argument,
    target_option,
)
from pipeline.run.executors.choice import require_possible

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.model.job import Job
    from pipeline.show.picture_set import PictureSet
    from pipeline.show.stills import Survey

_QUALITIES = ("draft", "preview", "final")
_POSITION, _KEYFRAMES = "camera.position", "camera.keyframe"
_TOLD_FRAMES = 10  # frames of an animatic between two lines of progress


@click.command()
@submitted_job_argument
@click.option("--frame", type=click.IntRange(min=0), help="Which frame.")
@click.option("--quality", type=click.Choice(_QUALITIES), default="final", show_default=True, help="How well drawn.")
@click.option("--resolution", type=(int, int), metavar="WIDTH HEIGHT", help="Size [pixels]; the job's if omitted.")
@overrides_option("render.exposure=0.5, set.name=...")
@target_option("; in JOB/stills/ if omitted, a sheet in JOB/sheet.png")
@cores_option
@click.option("--sheet", is_flag=True, help="Put rendered frames side by side on one picture instead.")
@click.option("--pictures", type=click.IntRange(min=1), default=12, show_default=True, help="Most pictures on a sheet.")
@click.option(
    "--columns", type=click.IntRange(min=1), default=4, show_default=True, help="Pictures in a row of a sheet."
)
def still(
    job: str,
    *,
    output: Path,
    frame: int | None,
    quality: str,
    resolution: tuple[int, int] | None,
    overrides: tuple[str, ...],
    target: Path | None,
    cores: int | None,
    sheet: bool,
    pictures: int,
    columns: int,
) -> None:
    """Draw one frame anew in any quality, or put many on one sheet.

    In another quality, size or light, or from another place, of what is simulated already. The job's own frames and its
    record stay as they are. Works while it runs. A sheet shows frames that are rendered, spread evenly over them.

    \b
    pipeline still my-film --frame 90
    pipeline still my-film --frame 90 --resolution 3840 2160 -o poster.png
    pipeline still my-film --frame 90 --quality preview --set 'camera.position=[0, -3, 1]'
    pipeline still my-film --sheet
    pipeline still my-film --sheet --pictures 30 --columns 6 -o my-film.webp
    """
    if sheet == (frame is not None):
        raise click.UsageError("say what to draw: one frame with --frame, or many on one picture with --sheet")
    if frame is None:
        _write_sheet(find_job(job, output), target, pictures=pictures, columns=columns)
        return
    from pipeline.job.loading import read_job
    from pipeline.run.checked_job import require_own_programs
    from pipeline.show.stills import make_still, survey

    layout = JobLayout(find_job(job, output).root.absolute())
    changes = [f"render.quality={quality}"]
    changes += _other_ways_off([each.partition("=")[0].strip() for each in overrides])
    changes += [] if resolution is None else [f"render.resolution=[{resolution[0]}, {resolution[1]}]"]
    loaded = read_job(layout.job_file, [*changes, *overrides])
    require_own_programs(loaded, overrides)
    found = survey(loaded, layout, [frame])
    if found.lacking:
        raise PipelineError(_why_lacking(found.lacking[-1], layout, frame))
    path = layout.stills / f"{frame:06d}-{_words(loaded, overrides)}.png" if target is None else target
    _require_ending(path, ".png", "a still is a PNG")
    require_possible(loaded.job, {task.stage for task in found.todo})
    _make_folder(path)
    capacity = claim_cores(cores)
    width, height = loaded.job.render.resolution
    made = _made_first(found)
    click.echo(
        f"frame {frame} of {loaded.job.name}: {f'{made}, then ' if made else ''}"
        f"{width} x {height} pixels, {loaded.job.render.quality} quality",
        err=True,
    )
    with redirect_stdout(sys.stderr):  # what the stages print is no output of this command
        make_still(loaded, found, layout, path, capacity=capacity, say=lambda told: click.echo(f"  {told}", err=True))
    click.echo(path)


def _write_sheet(layout: JobLayout, target: Path | None, *, pictures: int, columns: int) -> None:
    from PIL import Image

    from pipeline.job.loading import load_job
    from pipeline.show.picture_set import evenly_spread, picture_set
    from render.sheet import contact_sheet

    submitted = load_job(layout.job_file)
    frames = picture_set(submitted, layout)
    if not frames.all:
        raise PipelineError(f"no frame of {layout.root} has been rendered yet")
    path = layout.root / "sheet.png" if target is None else target
    if path.suffix.lower() not in Image.registered_extensions():
        raise PipelineError(f'{path}: "{path.suffix}" is no kind of picture; use .png, .jpg or .webp')
    with _making(path):
        contact_sheet(evenly_spread(frames.all, pictures), path, columns=columns)
    _say_remark(submitted, frames)
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
    from pipeline.base.parameter_set import digest_of

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
    counts = Counter(task.stage for task in found.todo[:-1])
    return ", ".join(stage if count == 1 else f"{count} of {stage}" for stage, count in counts.items())


def _why_lacking(artifact: str, layout: JobLayout, frame: int) -> str:
    """Whether the simulation has not come so far, or the options ask for another one."""
    from pipeline.base.lease import live_holder
    from pipeline.job.loading import read_job
    from pipeline.show.stills import survey

    if not survey(read_job(layout.job_file), layout, [frame]).lacking:
        return (
            "--set changes what is simulated, and a still shows what this job has simulated; "
            f"submit a job of its own: pipeline submit {shlex.quote(str(layout.job_file))} --set name=... --set ..."
        )
    if read_job(layout.job_file).job.camera.frames_action:
        artifact = f"{artifact}, which the camera's framing of the whole action needs,"
    if live_holder(layout.lease) is not None:
        return f"{artifact} is not simulated yet; the job is running: wait for it with: pipeline status --follow"
    return f"{artifact} is not simulated yet; go on with: pipeline resume {shlex.quote(str(layout.root))}"


@click.command()
@submitted_job_argument
@click.option("--width", type=click.IntRange(64, 3840), default=640, show_default=True, help="Of the film [pixels].")
@target_option("; JOB/NAME-animatic.mp4 if omitted")
@cores_option
def animatic(job: str, *, output: Path, width: int, target: Path | None, cores: int | None) -> None:
    """Show how a job moves, in plain pictures, before it is rendered.

    The whole film, a fraction of a second a frame, of what is simulated already; surfaces and volumes that are still
    missing are made, and the job keeps them. Drawn by Blender's Workbench, which needs EGL: on Debian the packages
    libegl1 and libgl1-mesa-dri.

    \b
    pipeline animatic my-film
    pipeline animatic my-film --width 1280 -o moves.mp4
    """
    from pipeline.base.lease import refuse_if_held
    from pipeline.job.loading import read_job
    from pipeline.run.checked_job import require_own_programs
    from pipeline.run.single_stage import run_tasks
    from pipeline.show.animatic import drawable_frames, made_before, make_animatic
    from pipeline.show.stills import survey
    from render.blender import BlenderUnavailableError
    from render.workbench import require_workbench

    layout = JobLayout(find_job(job, output).root.absolute())
    submitted = read_job(layout.job_file)
    require_own_programs(submitted, ())
    size = _fitted(submitted.job.render.resolution, width)
    loaded = read_job(layout.job_file, [f"render.resolution=[{size[0]}, {size[1]}]"])
    path = layout.root / f"{submitted.job.name}-animatic.mp4" if target is None else target
    _require_ending(path, ".mp4", "an animatic is an MP4")
    planned = submitted.job.frame_count
    found = survey(loaded, layout, range(planned))
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
    capacity = claim_cores(cores)
    shown = f"{frames} frames" if frames == planned else f"the {frames} of {planned} frames that are simulated"
    click.echo(f"{shown}, {size[0]} x {size[1]} pixels{f'; {len(todo)} files to make first' if todo else ''}", err=True)
    with redirect_stdout(sys.stderr):  # what the stages print is no output of this command
        outcome = run_tasks(
            todo,
            layout,
            capacity=capacity,
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
        drawn=lambda frame: click.echo(f"  frame {frame}", err=True) if frame % _TOLD_FRAMES == 0 else None,
    )
    click.echo(path)


def _fitted(resolution: tuple[int, int], width: int) -> tuple[int, int]:
    """A size of the same proportions, so wide; even, as video needs it."""
    height = width * resolution[1] / resolution[0]
    return max(16, 2 * round(width / 2)), max(16, 2 * round(height / 2))


@click.command()
@click.argument("jobs", metavar="JOB...", nargs=-1, required=True, shell_complete=complete_jobs)
@output_option
@target_option("; JOB/report.html if omitted, which several jobs cannot")
def report(jobs: tuple[str, ...], output: Path, target: Path | None) -> None:
    """Write one page about a job: timings, plots, pictures, warnings.

    One HTML file, with what the job took and what its solvers tell. Several jobs are compared in the same plots.
    Submitting a job writes its report at the end. Works while it runs.

    \b
    pipeline report my-film
    pipeline report bunny-wcsph bunny-dfsph -o energy.html
    """
    from pipeline.show.report.page import write_report

    layouts = [find_job(job, output) for job in jobs]
    if target is None and len(layouts) > 1:
        raise click.UsageError("say where to write the comparison: -o comparison.html")
    path = layouts[0].report if target is None else target
    try:
        write_report(layouts, path)
    except OSError as error:
        raise PipelineError(f"cannot write {path}: {error.strerror}") from error
    click.echo(path)


@click.command()
@click.argument("jobs", metavar="JOB JOB...", nargs=-1, required=True, shell_complete=complete_jobs)
@output_option
@click.option("--width", type=click.IntRange(128, 7680), default=1920, show_default=True, help="Most pixels across.")
@target_option(": an MP4", required=True)
def compare(jobs: tuple[str, ...], output: Path, width: int, target: Path) -> None:
    """Put the films of jobs side by side into one.

    Each with its name under it. Of the frames that were made alike, from the first one on; as long as the shortest.
    Frames of the same time stand beside each other.

    \b
    pipeline compare bunny-wcsph bunny-dfsph -o solvers.mp4
    """
    from pipeline.base.files import replacing
    from pipeline.base.resources import machine_capacity
    from pipeline.job.loading import load_job
    from pipeline.show.picture_set import picture_set
    from render.side_by_side import Film, compare_films

    if len(jobs) < 2:
        raise click.UsageError("name two jobs at least")
    _require_ending(target, ".mp4", "a comparison is an MP4")
    films = []
    for layout in (find_job(job, output) for job in jobs):
        submitted = load_job(layout.job_file)
        frames = picture_set(submitted, layout)
        pictures = frames.unbroken
        if not pictures:
            raise PipelineError(f"the first frame of {layout.root} has not been rendered yet{frames.others}")
        films.append(Film(submitted.name, pictures, submitted.movie.playback_fps or submitted.fps))
        if len(pictures) < submitted.frame_count:
            there = f"{len(pictures)} of {submitted.frame_count} frames are there"
            click.echo(f"{submitted.name}: {there}{frames.others}", err=True)
        _say_remark(submitted, frames)
    with _making(target), replacing(target) as part:
        count = compare_films(films, part, width=width, threads=machine_capacity().cores)
    click.echo(f"{target}: {count} frames")


@click.command()
@submitted_job_argument
@click.option("--width", type=click.IntRange(16, 3840), default=480, show_default=True, help="Most pixels across.")
@click.option("--fps", type=click.FloatRange(1.0, 120.0), default=15.0, show_default=True, help="Of the loop.")
@click.option("--from", "first", type=click.IntRange(min=0), default=0, show_default=True, help="Its first frame.")
@click.option("--until", "last", type=click.IntRange(min=0), help="Its last frame; the job's if omitted.")
@target_option(": .webp or .gif", required=True)
def loop(job: str, *, output: Path, width: int, fps: float, first: int, last: int | None, target: Path) -> None:
    """Make a small film that starts again: an animated WebP or GIF.

    \b
    pipeline loop my-film -o my-film.webp
    pipeline loop my-film --width 320 --fps 12 --from 20 --until 59 -o splash.gif
    """
    from pipeline.base.files import replacing
    from pipeline.job.loading import load_job
    from pipeline.show.picture_set import picture_set
    from render.loop import FORMATS, write_loop

    if target.suffix.lower() not in FORMATS:
        raise PipelineError(f'{target}: "{target.suffix}" is no loop; use {" or ".join(FORMATS)}')
    layout = find_job(job, output)
    submitted = load_job(layout.job_file)
    frames = picture_set(submitted, layout)
    pictures = frames.unbroken
    last = submitted.frame_count - 1 if last is None else last
    if not first <= last < submitted.frame_count:
        raise PipelineError(f"{submitted.name} has the frames 0-{submitted.frame_count - 1}, not {first}-{last}")
    if last >= len(pictures):
        there = f"only 0-{len(pictures) - 1}" if pictures else "none"
        raise PipelineError(
            f"of the frames {first}-{last} of {submitted.name} {there} are rendered{frames.others}; choose with --until"
        )
    _say_remark(submitted, frames)
    rate = submitted.movie.playback_fps or submitted.fps
    with _making(target), replacing(target) as part:
        count = write_loop(pictures[first : last + 1], part, fps=rate, width=width, loop_fps=fps)
    click.echo(f"{target}: {count} frames, {target.stat().st_size / 1e6:.2g} MB")


def _require_ending(path: Path, suffix: str, what: str) -> None:
    if path.suffix.lower() != suffix:
        raise PipelineError(f'{path}: {what}, so its name must end in "{suffix}"')


@contextmanager
def _making(target: Path) -> Iterator[None]:
    """What goes wrong with pictures and places in the block, as a line about the file that was to be made."""
    from render.errors import InvalidFileError

    try:
        yield
    except (InvalidFileError, ValueError, OSError) as error:
        raise PipelineError(f"cannot make {target}: {error}") from error


def _say_remark(job: Job, frames: PictureSet) -> None:
    """Say on standard error what is to be said of the frames that are shown."""
    if frames.remark:
        click.echo(f"{job.name}: {frames.remark}", err=True)
