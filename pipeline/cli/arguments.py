"""Arguments that several commands share, and what they stand for."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from difflib import get_close_matches
from functools import reduce, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from pipeline.base.errors import JobFileError, PipelineError, PlanError
from pipeline.base.layout import JobLayout
from pipeline.base.places import check_places
from pipeline.queue.submitting import QueueOptions
from pipeline.run.executors.choice import executor_options

if TYPE_CHECKING:
    from pipeline.base.task import Resources
    from pipeline.queue.job_queue import JobQueue

DEFAULT_OUTPUT = Path("renders")
SUFFIX = ".toml"

PRIORITY = click.IntRange(-1000, 1000)


cores_option = click.option(
    "--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all if omitted."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
output_option = click.option(
    "--farm",
    "output",
    type=click.Path(path_type=Path, file_okay=False),
    default=DEFAULT_OUTPUT,
    show_default=True,
    is_eager=True,  # names of jobs are looked up in it
    help="Folder that holds the jobs' folders.",
)


def _known_ends(_context: click.Context, _parameter: click.Parameter, until: tuple[str, ...]) -> tuple[str, ...]:
    """What is given to --until, refused before anything is read if no job could end there. Raises PlanError."""
    from pipeline.run.plan import require_ends
    from pipeline.stages import STAGES

    require_ends(until, STAGES)
    return until


until_option = click.option(
    "--until",
    multiple=True,
    callback=_known_ends,
    metavar="STAGE",
    help="End after this stage: simulate, spray, surface, cloth, volume, whitewater, render, ...; or after frames of "
    "it, as render:0-9. May be given several times.",
)


class JobFilePath(click.ParamType):  # type: ignore[type-arg]
    """A job file: by its path, by its name without the ending, or as that of a job that was submitted."""

    name = "job file"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:  # noqa: ARG002
        """The job file's path; --farm has been read before."""
        output = DEFAULT_OUTPUT if ctx is None else ctx.params.get("output", DEFAULT_OUTPUT)
        return value if isinstance(value, Path) else find_job_file(value, output)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Names of submitted jobs, and files."""
        return [*complete_jobs(ctx, param, incomplete), CompletionItem(incomplete, type="file")]


def complete_jobs(ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Names of the jobs in the output folder, for the shell."""
    output = ctx.params.get("output") or DEFAULT_OUTPUT
    folders = sorted(output.iterdir()) if output.is_dir() else []
    jobs = [folder.name for folder in folders if JobLayout(folder).manifest.exists()]
    return [CompletionItem(job) for job in jobs if job.startswith(incomplete)]


def job_options(command: Any) -> Any:
    """The job file and the options that change the job."""
    command = click.option("--preview", is_flag=True, help="A fast, small version of the same job.")(command)
    command = overrides_option("render.quality=final")(command)
    return click.argument("job_file", metavar="JOB", type=JobFilePath())(command)


def overrides_option(example: str) -> Callable[[Any], Any]:
    """Keys of the job with other values."""
    return click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help=f"Override a key: {example}")


def claim_cores(cores: int | None) -> Resources:
    """What one task in this process may use; tells the libraries that count cores for themselves."""
    from pipeline.base.resources import machine_capacity
    from pipeline.base.threads import thread_variables

    capacity = machine_capacity(gpus=1)
    capacity = replace(capacity, cores=min(cores or capacity.cores, capacity.cores))
    os.environ.update(thread_variables(capacity.cores))  # before anything reads them
    return capacity


def submitted_job_argument(command: Any) -> Any:
    """A job that was submitted before: its name, its job file, or its folder."""
    return output_option(click.argument("job", metavar="JOB", shell_complete=complete_jobs)(command))


def target_option(meaning: str, *, required: bool = False) -> Callable[[Any], Any]:
    """Where to write a file."""
    path = click.Path(path_type=Path, dir_okay=False)
    return click.option("-o", "--output", "target", type=path, required=required, help=f"Where to write it{meaning}.")


def submission_folder(job_file: Path, name: str, output: Path, *, is_changed: bool) -> JobLayout:
    """The folder that submitting a job file fills: its own, if it is the job file of a job's folder as it stands.

    `is_changed`: whether options change the job.
    """
    own_folder = JobLayout(job_file.parent)
    is_own = output == DEFAULT_OUTPUT and job_file.name == "job.toml" and not is_changed
    return own_folder if is_own and own_folder.manifest.exists() else JobLayout(output / name)


def find_job_file(job: str, output: Path) -> Path:
    """The job file that is meant: by its path, with or without the ending, as a job's folder, or as a submitted job.

    One that was named with its ending need not be there. Raises JobFileError if there is none, or there are two.
    """
    path = Path(job)
    if path.exists() and not path.is_dir():
        return path
    named = _with_ending(path)
    own = JobLayout(path).job_file
    found = [each for each in (named, own) if each.is_file()]
    if len(found) == 2:
        raise JobFileError([f'"{job}" is a job file and the folder of a job; name one of them: {named} or {own}'])
    if found:
        return found[0]
    submitted = JobLayout(output / job).job_file
    if submitted.is_file():
        return submitted
    if path.suffix == SUFFIX or path.is_dir():
        return path  # reading it says what is wrong
    near = nearest(named.name, [each.name for each in Path(named.parent).glob(f"*{SUFFIX}")])
    remedy = near or f"; a new one: pipeline new {job}"
    raise JobFileError([f'there is neither a job file {named} nor a job "{job}" in {output}{remedy}'])


def job_folder(job: str, output: Path) -> JobLayout:
    """The folder that a job has, or will have when its first run begins.

    `job` is the path of its folder, its name under `output`, or its job file, with or without the ending.

    Raises:
        PipelineError: there are two such jobs.
        JobFileError: the job file that was named is wrong.
    """
    path = Path(job)
    if path.is_file():
        own = JobLayout(path.parent)
        return own if path.name == own.job_file.name and own.manifest.exists() else _folder_of_file(path, output)
    here, named = JobLayout(path), JobLayout(output / job)
    if here.job_file.exists():
        if "/" not in job and named.job_file.exists() and not named.root.samefile(here.root):
            raise PipelineError(f'there are two jobs "{job}"; name one of them by its path: ./{job} or {named.root}')
        return here
    # A name wins over a folder of the same name that is no job's.
    if path.is_dir() and not named.root.is_dir():
        return here
    if not named.root.is_dir():
        if _with_ending(path).is_file():
            return _folder_of_file(_with_ending(path), output)
        if path.suffix == SUFFIX:  # the file is gone; its job may be there
            return JobLayout(output / path.stem)
    return named


def find_job(job: str, output: Path) -> JobLayout:
    """The folder of a job that was submitted, as by `job_folder`.

    Raises PipelineError: there is none, or something is in the place of a file or a folder of it.
    """
    layout = job_folder(job, output)
    if not layout.job_file.exists():
        file = next((each for each in (Path(job), _with_ending(Path(job))) if each.is_file()), None)
        near = nearest(layout.root.name, [each.parent.name for each in layout.root.parent.glob("*/job.toml")])
        submit = f"pipeline submit {shlex.quote(str(file)) if file else f'JOB{SUFFIX}'}"
        raise PipelineError(f"no submitted job in {layout.root}{near}; submit one with: {submit}")
    check_places(layout)
    return layout


def place(job: str, output: Path) -> tuple[JobQueue, str]:
    """The queue and the name of a job, which may have no folder yet."""
    from pipeline.queue.job_queue import JobQueue

    root = job_folder(job, output).root.absolute()
    return JobQueue(root.parent), root.name


def _with_ending(path: Path) -> Path:
    """The job file that goes by a name."""
    return path.with_name(f"{path.name}{SUFFIX}") if path.name else path


def _folder_of_file(path: Path, output: Path) -> JobLayout:
    from pipeline.job.loading import load_job

    return JobLayout(output / load_job(path).name)


def nearest(name: str, names: Sequence[str]) -> str:
    """The end of a message about an unknown name: the one that may be meant, if there is such."""
    near = get_close_matches(name, names, n=1)
    return f'; did you mean "{near[0]}"?' if near else ""


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
    from pipeline.run import plan

    try:
        return plan.parse_frames(text)
    except PlanError as error:
        raise click.BadParameter(str(error)) from None


_QUEUE_OPTIONS: tuple[Callable[[Any], Any], ...] = (
    click.option("--detach", is_flag=True, help="Return at once; the job runs in the background."),
    click.option(
        "--priority",
        type=PRIORITY,
        help="Jobs of higher priority go first, and interrupt others without loss; 0, or as before, if omitted.",
    ),
    click.option(
        "--reserve",
        "reserve_bytes",
        metavar="SIZE",
        callback=parse_size,
        help="Pause when less than this is free on the disk, such as 20GB; 2 GiB if omitted.",
    ),
    cores_option,
    *executor_options,
)


def queue_options(command: Any) -> Any:
    """How a job waits its turn, and who waits for it; the command gets them as `options`."""

    @wraps(command)
    def with_options(**arguments: Any) -> Any:
        taken = {field.name: arguments.pop(field.name) for field in fields(QueueOptions)}
        return command(**arguments, options=QueueOptions(**taken))

    return reduce(lambda decorated, decorate: decorate(decorated), _QUEUE_OPTIONS, with_options)
