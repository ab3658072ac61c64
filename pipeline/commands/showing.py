"""Commands that show what a job has made: sheet."""

from __future__ import annotations

from pathlib import Path

import click

from pipeline.commands.arguments import find_job, submitted_job_argument
from pipeline.errors import PipelineError
from pipeline.layout import JobLayout


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


def committed_pictures(layout: JobLayout) -> list[Path]:
    """The frames that have their receipt, first to last: a file without one may be half a frame."""
    folder = layout.path(layout.picture(0)).parent
    receipts = sorted((layout.receipts / folder.name).glob("[0-9]*.png.json"))
    return [folder / receipt.name.removesuffix(".json") for receipt in receipts]


def evenly_spread(frames: list[Path], count: int) -> list[Path]:
    """At most so many of the frames, the first and the last among them."""
    if len(frames) <= count:
        return frames
    if count == 1:
        return frames[-1:]
    return [frames[round(index * (len(frames) - 1) / (count - 1))] for index in range(count)]
