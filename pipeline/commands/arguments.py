"""Arguments that several commands share, and what they stand for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from pipeline.errors import PipelineError
from pipeline.layout import JobLayout

DEFAULT_OUTPUT = Path("renders")


def job_options(command: Any) -> Any:
    """The job file and the options that change the job."""
    for decorate in (
        click.option("--preview", is_flag=True, help="A fast, small version of the same job."),
        click.option(
            "--set", "overrides", multiple=True, metavar="KEY=VALUE", help="Override a key: render.quality=final"
        ),
        click.argument("job_file", metavar="JOB.toml", type=click.Path(path_type=Path)),
    ):
        command = decorate(command)
    return command


def output_option(command: Any) -> Any:
    """The folder that jobs' folders lie in."""
    return click.option(
        "--output",
        type=click.Path(path_type=Path, file_okay=False),
        default=DEFAULT_OUTPUT,
        show_default=True,
        help="Folder that holds the jobs' folders.",
    )(command)


def submitted_job_argument(command: Any) -> Any:
    """A job that was submitted before: its folder, its name, or its job file."""
    return output_option(click.argument("job", metavar="JOB")(command))


def json_option(command: Any) -> Any:
    """For machines."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(command)


def print_warnings(warnings: Sequence[str]) -> None:
    """Warnings go to the error stream, so that output stays fit for a pipe."""
    for warning in warnings:
        click.secho(f"warning: {warning}", err=True, fg="yellow")


def find_job(job: str, output: Path) -> JobLayout:
    """The folder of a submitted job.

    Args:
        job: path of its folder, its name under `output`, or its job file.
        output: the folder that jobs' folders lie in.

    Raises:
        PipelineError: there is none.
        JobFileError: the job file that was named is wrong.
    """
    path = Path(job)
    if path.is_file():
        from pipeline.job.loading import load_job

        folder = output / load_job(path).name
        if path.name == "job.toml" and (path.parent / "manifest.db").exists():
            folder = path.parent
    else:
        # A name wins over a folder of the same name that is no job's.
        folder = path if JobLayout(path).job_file.exists() else output / job
    layout = JobLayout(folder)
    if not layout.job_file.exists():
        raise PipelineError(f"no submitted job in {folder}; submit one with: pipeline submit JOB.toml")
    return layout


def parse_frames(text: str) -> frozenset[int]:
    """Frame numbers from `3`, `0-9` or `0-9,20,30-39`. Raises BadParameter."""
    frames: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdigit() or (dash and not last.isdigit()):
            raise click.BadParameter(f'"{part.strip()}" is not a frame or a range of frames, like 7 or 0-29')
        start, stop = int(first), int(last or first)
        if stop < start:
            raise click.BadParameter(f'"{part.strip()}" runs backwards')
        if stop - start > 1_000_000:
            raise click.BadParameter(f'"{part.strip()}" is more than a million frames')
        frames.update(range(start, stop + 1))
    return frozenset(frames)
