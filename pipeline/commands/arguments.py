"""Arguments that several commands share, and what they stand for."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pipeline.errors import JobFileError, PipelineError
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob

DEFAULT_OUTPUT = Path("renders")

PRIORITY = click.IntRange(-1000, 1000)

BLENDER_VARIABLE = "PIPELINE_BLENDER"
"""Names the Blender that job files may name, too."""


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


def target_option(meaning: str, *, required: bool = False) -> Callable[[Any], Any]:
    """Where to write a file."""
    path = click.Path(path_type=Path, dir_okay=False)
    return click.option("-o", "--to", "target", type=path, required=required, help=f"Where to write it{meaning}.")


def json_option(command: Any) -> Any:
    """For machines."""
    return click.option("--json", "as_json", is_flag=True, help="Print JSON.")(command)


def print_warnings(warnings: Sequence[str]) -> None:
    """Warnings go to the error stream, so that output stays fit for a pipe."""
    for warning in warnings:
        click.secho(f"warning: {warning}", err=True, fg="yellow")


def require_own_programs(loaded: LoadedJob, overrides: Sequence[str]) -> None:
    """Refuse a job file that names a program to be run: whose file it is decides nothing about what runs here.

    The user names it with `--set`, or in the environment. A job's folder keeps what its user has named.

    Raises:
        JobFileError: it names one.
    """
    program = loaded.job.render.blender
    if program is None or any(override.replace(" ", "").startswith("render.blender=") for override in overrides):
        return
    if loaded.path.name == "job.toml" and JobLayout(loaded.path.parent).manifest.exists():
        return
    if os.environ.get(BLENDER_VARIABLE) != program:
        raise JobFileError(
            [
                f"{loaded.path.name}: render.blender names a program, and a job file may not choose what runs here; "
                f"if you trust it: --set render.blender={shlex.quote(program)}"
            ]
        )


def require_plannable(loaded: LoadedJob) -> None:
    """Refuse numbers that planning would overflow with, before the whole scene is looked at.

    Raises:
        JobFileError: carries every such number.
    """
    from pipeline.job.magnitudes import check_magnitudes
    from pipeline.job.problems import Findings

    findings = Findings()
    if not check_magnitudes(loaded.job, findings):
        raise JobFileError(loaded.source.describe_all(findings.errors))


def submission_folder(job_file: Path, name: str, output: Path, *, is_changed: bool) -> JobLayout:
    """The folder that submitting a job file fills: its own, if it is the job file of a job's folder as it stands.

    Args:
        job_file: as it was named.
        name: of the job.
        output: the folder that jobs' folders lie in.
        is_changed: whether options change the job.
    """
    own_folder = JobLayout(job_file.parent)
    is_own = output == DEFAULT_OUTPUT and job_file.name == "job.toml" and not is_changed
    return own_folder if is_own and own_folder.manifest.exists() else JobLayout(output / name)


def job_folder(job: str, output: Path) -> JobLayout:
    """The folder that a job has, or will have when its first run begins.

    Args:
        job: path of its folder, its name under `output`, or its job file.
        output: the folder that jobs' folders lie in.

    Raises:
        JobFileError: the job file that was named is wrong.
    """
    path = Path(job)
    if path.is_file():
        from pipeline.job.loading import load_job

        if path.name == "job.toml" and JobLayout(path.parent).manifest.exists():
            return JobLayout(path.parent)
        return JobLayout(output / load_job(path).name)
    named = JobLayout(output / job)
    # A name wins over a folder of the same name that is no job's.
    if JobLayout(path).job_file.exists() or (path.is_dir() and not named.root.is_dir()):
        return JobLayout(path)
    return named


def find_job(job: str, output: Path) -> JobLayout:
    """The folder of a job that has been run; see `job_folder`.

    Raises:
        PipelineError: there is none.
        JobFileError: the job file that was named is wrong.
    """
    layout = job_folder(job, output)
    if not layout.job_file.exists():
        raise PipelineError(f"no submitted job in {layout.root}; submit one with: pipeline submit JOB.toml")
    return layout


_SIZE = re.compile(r"(\d+(?:\.\d*)?)\s*([KMGT]?)(I?)B?", re.IGNORECASE)
_AGE = re.compile(r"(\d+(?:\.\d*)?)\s*([smhdw])")
_AGE_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0, "w": 604800.0}


def parse_size(_context: click.Context, _parameter: click.Parameter, text: str | None) -> int | None:
    """Bytes from `500MB`, `2GiB`, `1.5TB` or `0`; None stays None. Raises BadParameter."""
    if text is None:
        return None
    number, prefix, binary = _match(_SIZE, text, "a size like 500MB or 2GiB")
    return int(float(number) * (1024 if binary else 1000) ** " KMGT".index(prefix.upper() or " "))


def parse_age(_context: click.Context, _parameter: click.Parameter, text: str | None) -> float | None:
    """Seconds from `90m`, `12h`, `7d` or `2w`; None stays None. Raises BadParameter."""
    if text is None:
        return None
    number, unit = _match(_AGE, text, "an age like 12h or 7d")
    return float(number) * _AGE_UNITS_S[unit]


def _match(pattern: re.Pattern[str], text: str, wanted: str) -> tuple[str, ...]:
    match = pattern.fullmatch(text.strip())
    if match is None:
        raise click.BadParameter(f'"{text}" is not {wanted}')
    return match.groups()


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
