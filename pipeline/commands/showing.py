"""Commands that show what a job has made: sheet, report."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.commands.arguments import find_job, output_option, submitted_job_argument
from pipeline.errors import PipelineError


@click.command()
@submitted_job_argument
@click.option("--pictures", type=click.IntRange(min=1), default=12, show_default=True, help="Most pictures on it.")
@click.option("--columns", type=click.IntRange(min=1), default=4, show_default=True, help="Pictures in a row.")
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Where to write it; JOB/sheet.png if omitted.",
)
def sheet(job: str, output: Path, pictures: int, columns: int, target: Path | None) -> None:
    """Put frames of a job side by side on one picture, spread evenly over those that are there. Works while it runs.

    \b
    pipeline sheet quickstart
    pipeline sheet quickstart --pictures 30 --columns 6 --to quickstart.webp
    """
    from PIL import Image

    from pipeline.committed_pictures import committed_pictures, evenly_spread
    from render.errors import InvalidFileError
    from render.sheet import contact_sheet

    layout = find_job(job, output)
    frames = committed_pictures(layout)
    if not frames:
        raise PipelineError(f"no frame of {layout.root} has been rendered yet")
    path = layout.root / "sheet.png" if target is None else target
    if path.suffix.lower() not in Image.registered_extensions():
        raise PipelineError(f'{path}: "{path.suffix}" is no kind of picture; use .png, .jpg or .webp')
    try:
        contact_sheet(evenly_spread(frames, pictures), path, columns=columns)
    except (InvalidFileError, ValueError, OSError) as error:
        raise PipelineError(f"cannot make {path}: {error}") from error
    click.echo(path)


@click.command()
@click.argument("jobs", metavar="JOB...", nargs=-1, required=True)
@output_option
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Where to write it; JOB/report.html if omitted, which several jobs cannot.",
)
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
