"""Commands that show what a job has made: sheet, report, compare, loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.arguments import find_job, output_option, submitted_job_argument, target_option
from pipeline.errors import PipelineError

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from pipeline.picture_set import PictureSet


@click.command()
@submitted_job_argument
@click.option("--pictures", type=click.IntRange(min=1), default=12, show_default=True, help="Most pictures on it.")
@click.option("--columns", type=click.IntRange(min=1), default=4, show_default=True, help="Pictures in a row.")
@target_option("; JOB/sheet.png if omitted")
def sheet(job: str, output: Path, pictures: int, columns: int, target: Path | None) -> None:
    """Put frames of a job side by side on one picture, spread evenly over those that are there. Works while it runs.

    \b
    pipeline sheet quickstart
    pipeline sheet quickstart --pictures 30 --columns 6 --to quickstart.webp
    """
    from PIL import Image

    from pipeline.job.loading import load_job
    from pipeline.picture_set import evenly_spread, picture_set
    from render.errors import InvalidFileError
    from render.sheet import contact_sheet

    layout = find_job(job, output)
    submitted = load_job(layout.job_file)
    frames = picture_set(submitted, layout)
    if not frames.all:
        raise PipelineError(f"no frame of {layout.root} has been rendered yet")
    path = layout.root / "sheet.png" if target is None else target
    if path.suffix.lower() not in Image.registered_extensions():
        raise PipelineError(f'{path}: "{path.suffix}" is no kind of picture; use .png, .jpg or .webp')
    try:
        contact_sheet(evenly_spread(frames.all, pictures), path, columns=columns)
    except (InvalidFileError, ValueError, OSError) as error:
        raise PipelineError(f"cannot make {path}: {error}") from error
    _say_remark(submitted, frames)
    click.echo(path)


@click.command()
@click.argument("jobs", metavar="JOB...", nargs=-1, required=True)
@output_option
@target_option("; JOB/report.html if omitted, which several jobs cannot")
def report(jobs: tuple[str, ...], output: Path, target: Path | None) -> None:
    """Write what a job took and what its solvers told into one HTML file: timings, plots, pictures, warnings.

    Several jobs are compared in the same plots. Submitting a job writes its report at the end. Works while it runs.

    \b
    pipeline report quickstart
    pipeline report bunny-wcsph bunny-dfsph --to energy.html
    """
    from pipeline.report.writing import write_report

    layouts = [find_job(job, output) for job in jobs]
    if target is None and len(layouts) > 1:
        raise click.UsageError("say where to write the comparison: --to comparison.html")
    path = layouts[0].report if target is None else target
    try:
        write_report(layouts, path)
    except OSError as error:
        raise PipelineError(f"cannot write {path}: {error.strerror}") from error
    click.echo(path)


@click.command()
@click.argument("jobs", metavar="JOB JOB...", nargs=-1, required=True)
@output_option
@click.option("--width", type=click.IntRange(128, 7680), default=1920, show_default=True, help="Most pixels across.")
@target_option(": an MP4", required=True)
def compare(jobs: tuple[str, ...], output: Path, width: int, target: Path) -> None:
    """Put the films of jobs side by side into one, each with its name under it.

    Of the frames that were made alike, from the first one on; as long as the shortest. Frames of the same time stand
    beside each other.

    \b
    pipeline compare bunny-wcsph bunny-dfsph -o solvers.mp4
    """
    from pipeline.files import replacing
    from pipeline.job.loading import load_job
    from pipeline.picture_set import picture_set
    from pipeline.resources import machine_capacity
    from render.errors import InvalidFileError
    from render.side_by_side import Film, compare_films

    if len(jobs) < 2:
        raise click.UsageError("name two jobs at least")
    if target.suffix.lower() != ".mp4":
        raise PipelineError(f'{target}: a comparison is an MP4, so its name must end in ".mp4"')
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
    try:
        with replacing(target) as part:
            count = compare_films(films, part, width=width, threads=machine_capacity().cores)
    except (InvalidFileError, ValueError, OSError) as error:
        raise PipelineError(f"cannot make {target}: {error}") from error
    click.echo(f"{target}: {count} frames")


@click.command()
@submitted_job_argument
@click.option("--width", type=click.IntRange(16, 3840), default=480, show_default=True, help="Most pixels across.")
@click.option("--fps", type=click.FloatRange(1.0, 120.0), default=15.0, show_default=True, help="Of the loop.")
@click.option("--from", "first", type=click.IntRange(min=0), default=0, show_default=True, help="Its first frame.")
@click.option("--until", "last", type=click.IntRange(min=0), help="Its last frame; the job's if omitted.")
@target_option(": .webp or .gif", required=True)
def loop(job: str, *, output: Path, width: int, fps: float, first: int, last: int | None, target: Path) -> None:
    """Make a small film that starts again, for a README or a web page: an animated WebP or GIF.

    \b
    pipeline loop quickstart -o quickstart.webp
    pipeline loop quickstart --width 320 --fps 12 --from 20 --until 59 -o splash.gif
    """
    from pipeline.files import replacing
    from pipeline.job.loading import load_job
    from pipeline.picture_set import picture_set
    from render.errors import InvalidFileError
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
    try:
        with replacing(target) as part:
            count = write_loop(
                pictures[first : last + 1],
                part,
                fps=submitted.movie.playback_fps or submitted.fps,
                width=width,
                loop_fps=fps,
            )
    except (InvalidFileError, ValueError, OSError) as error:
        raise PipelineError(f"cannot make {target}: {error}") from error
    click.echo(f"{target}: {count} frames, {target.stat().st_size / 1e6:.2g} MB")


def _say_remark(job: Job, frames: PictureSet) -> None:
    """Say on standard error what is to be said of the frames that are shown."""
    if frames.remark:
        click.echo(f"{job.name}: {frames.remark}", err=True)
