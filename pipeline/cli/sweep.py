"""The command for studies: sweep, a job for each value of a key."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from pipeline.base import wording
from pipeline.base.errors import JobFileError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.wording import print_warnings
from pipeline.cli.arguments import (
    JobFilePath,
    output_option,
    queue_options,
    until_option,
)
from pipeline.queue.submitting import QueueOptions, is_finished, look_at, run, say_aside, stages_to_run

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.job.sweep import Variant
    from pipeline.model.problems import Findings

T = TypeVar("T")
Result = TypeVar("Result")


@dataclass(frozen=True)
class _Planned:
    """A job of the sweep, checked."""

    variant: Variant
    loaded: LoadedJob
    findings: Findings
    layout: JobLayout


@click.command()
@click.argument("job_file", metavar="JOB", type=JobFilePath())
@click.option(
    "--set",
    "settings",
    multiple=True,
    required=True,
    metavar="KEY=VALUE,VALUE,...",
    help="Values of a key; a grid of several.",
)
@click.option("--preview", is_flag=True, help="A fast, small version of each job.")
@click.option("--dry-run", is_flag=True, help="Say which jobs there would be, and what they cost; run nothing.")
@until_option
@output_option
@queue_options
def sweep(
    *,
    job_file: Path,
    settings: tuple[str, ...],
    preview: bool,
    dry_run: bool,
    until: tuple[str, ...],
    output: Path,
    options: QueueOptions,
) -> None:
    """Run a job for each value of a key, or each combination of several.

    The jobs are named by their values, and run one after the other in the usual queue. What several of them make from
    the same, such as the simulation where only the camera differs, is made once and shared. At the end there are one
    sheet of pictures with the values written in, NAME-KEYS-sweep.png, and one table of the solvers' numbers,
    NAME-KEYS-sweep.csv, beside the jobs' folders. The same command again goes on where it stopped.

    Commas between brackets or in quotes are part of a value.

    \b
    pipeline sweep honey.toml --set 'fluid.honey.viscosity=0.01,0.1,1'
    pipeline sweep dam.toml --set 'fluid.water.solver=wcsph,dfsph' --set 'fluid.water.particle_radius=0.02,0.01'
    pipeline sweep my-film --set 'camera.position=[0,-3,1],[2,-2,1]' --set render.quality=draft
    pipeline sweep dam.toml --set 'gravity=[0,0,-9.81],[0,0,-1.62]' --until simulate --dry-run
    """
    from pipeline.job.loading import load_job
    from pipeline.job.sweep import sweep_name, variants

    base = load_job(job_file)
    planned = _checked(job_file, base.name, variants(settings, base), output, preview=preview, until=until)
    name = sweep_name(base.name + ("-preview" if preview else ""), planned[0].variant)
    _require_own(output / f"{name}.csv", planned)
    _say_cost(planned, until, options)
    if dry_run:
        return
    code = _run_all(planned, until, options)
    if options.detach:
        say_aside("for the sheet and the table, give the same command again without --detach")
        sys.exit(code)
    _write_results(planned, output, name)
    sys.exit(code)


def _checked(
    job_file: Path, base: str, variants: list[Variant], output: Path, *, preview: bool, until: tuple[str, ...]
) -> list[_Planned]:
    """Every job, checked before any runs. Raises JobFileError with the problems of all of them, each once."""
    from pipeline.run.checked_job import checked, read_own_job, require_plannable

    def read(variant: Variant) -> LoadedJob:
        overrides = (*variant.overrides, f'name="{base[:39]}-{variant.suffix}"')
        loaded = read_own_job(job_file, overrides, preview=preview, until=until)
        require_plannable(loaded)
        return loaded

    # What is wrong with keys and values is told in a moment, scenes take seconds.
    read_jobs = _of_all(read, variants)
    found = _of_all(lambda loaded: checked(loaded, until), read_jobs)
    print_warnings([*dict.fromkeys(warning for loaded, _ in found for warning in loaded.warnings)])
    return [
        _Planned(variant, loaded, findings, JobLayout(output / loaded.job.name))
        for variant, (loaded, findings) in zip(variants, found, strict=True)
    ]


def _require_own(table: Path, planned: list[_Planned]) -> None:
    """Raises PipelineError: the table of results is of a sweep with jobs that this one has not, and would be lost."""
    from pipeline.show.sweep_results import jobs_of_table

    others = jobs_of_table(table) - {each.layout.root.name for each in planned}
    if others:
        raise PipelineError(
            f"{table} is of another sweep, with {', '.join(sorted(others)[:3])}{', ...' if len(others) > 3 else ''}; "
            "give the values of those, too, or move the table and its sheet away"
        )


def _of_all(act: Callable[[T], Result], each: Sequence[T]) -> list[Result]:
    """What `act` returns of each. Raises JobFileError with the problems of all of them, each once."""
    results, problems = [], dict[str, None]()
    for one in each:
        try:
            results.append(act(one))
        except JobFileError as error:
            problems.update(dict.fromkeys(error.problems))
    if problems:
        raise JobFileError([*problems])
    return results


def _say_cost(planned: list[_Planned], until: tuple[str, ...], options: QueueOptions) -> None:
    """The jobs, and what they cost together: what several of them make from the same counts once."""
    from pipeline.queue import cost
    from pipeline.queue.disk import size_of
    from pipeline.run.checked_job import needs_pictures
    from pipeline.run.sharing import made_once

    seen: set[str] = set()
    seconds = disk_bytes = memory = 0.0
    shared_files = 0
    for each in planned:
        job = each.loaded.job
        state = look_at(job, each.layout, until)
        if state is None:
            say_aside(f"{job.name}: its record is put in order by its run")
            continue
        costs = cost.costs_here(job, draws=needs_pictures(until), cores=options.cores, say=say_aside)
        own, shared = made_once(state.assessments, seen)
        shared_files += shared
        expected = cost.expect(job, own, size_of(job, each.findings), costs, state.costs)
        seconds, disk_bytes = seconds + expected.seconds, disk_bytes + expected.disk_bytes
        memory = max(memory, expected.memory_bytes)
        told = expected.time_text if expected.stages else "nothing left to make"
        click.echo(f"{job.name}: {told}" + (f", {wording.counted(shared, 'file')} shared" if shared else ""))
    together = "all is made"
    if seconds:
        at_a_time = f"{wording.size(memory)} of memory at a time"
        together = f"some {wording.rough_duration(seconds)}, {wording.size(disk_bytes)} of disk, {at_a_time}"
    sharing = f"; {wording.counted(shared_files, 'file')} shared with a job before" if shared_files else ""
    click.echo(f"{wording.counted(len(planned), 'job')}: {together}{sharing}")


def _run_all(planned: list[_Planned], until: tuple[str, ...], options: QueueOptions) -> int:
    """Run the jobs one after the other, or queue them all; returns the exit code of the first that did not succeed."""
    from pipeline.queue.following import CTRL_C
    from pipeline.queue.submitting import make_folder
    from pipeline.run.sharing import write_siblings

    names = [each.layout.root.name for each in planned]
    for each in planned:
        make_folder(each.layout)
        write_siblings(each.layout, names)
    code = 0
    for each in planned:
        job = each.loaded.job
        state = look_at(job, each.layout, until)
        if is_finished(state, each.layout, each.loaded.text, until):
            say_aside(f"{job.name}: finished already")
            continue
        say_aside(f"{job.name}:")
        ended = run(job, each.layout, stages_to_run(state), submitted=each.loaded, options=options, until=until)
        if ended == CTRL_C:
            return ended
        code = code or ended
    return code


def _write_results(planned: list[_Planned], output: Path, name: str) -> None:
    from pipeline.show.sweep_results import write_sheet, write_table

    made = [(each.variant, each.layout) for each in planned]
    sheet, table = output / f"{name}.png", output / f"{name}.csv"
    if shown := write_sheet(made, sheet):
        click.echo(f"{sheet}: {wording.counted(shown, 'job')}")
    if lines := write_table(made, table):
        click.echo(f"{table}: {wording.counted(lines, 'line')}")
