"""Commands that run a job: submit, resume, rerun."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from pipeline import wording
from pipeline.commands.arguments import (
    DEFAULT_OUTPUT,
    find_job,
    job_options,
    output_option,
    parse_frames,
    print_warnings,
    submitted_job_argument,
)
from pipeline.errors import (
    DiskFullError,
    JobBusyError,
    MissingInputError,
    OutdatedManifestError,
    PipelineError,
    StageUnavailableError,
)
from pipeline.executors.failures import is_disk_full
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.job.models import Job
    from pipeline.run_events import Outcome
    from pipeline.runner import Selection

STALL_TIMEOUT_S = 3600.0
"""A task without a sign of life for so long is ended. A single frame shows none while Cycles draws it, and a final one
in film resolution takes half an hour on a few cores."""

GPU_TASKS = 1
"""One task at a time on the GPU. Whether there is one is not asked here: if not, a stage that has to run names it as an
obstacle, and what is up to date needs none."""

DISK_FULL = "the disk is full ({}); free some space and submit the job again"

cores_option = click.option(
    "--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all of them if omitted."
)


@click.command()
@job_options
@output_option
@cores_option
def submit(job_file: Path, overrides: tuple[str, ...], preview: bool, output: Path, cores: int | None) -> None:
    """Run a job until its film is there.

    Whatever is there already is kept. Submitted again after a crash, a kill or Ctrl-C, it continues. Submitted again
    after a change, it runs what the change concerns, and says so first. If the job is running already, it watches that
    run first.

    \b
    pipeline submit jobs/quickstart.toml
    pipeline submit dam.toml --preview
    pipeline submit dam.toml --set render.quality=final --set camera.f_stop=2.8
    """
    from pipeline.job.loading import read_job

    loaded = read_job(job_file, overrides, preview=preview)
    in_its_folder = output == DEFAULT_OUTPUT and job_file.name == "job.toml" and not overrides and not preview
    own_folder = JobLayout(job_file.parent)
    layout = own_folder if in_its_folder and own_folder.manifest.exists() else JobLayout(output / loaded.job.name)
    todo = _stages_to_run(loaded.job, layout)
    if todo:
        # Checking the scene builds its shapes, which takes longer than finding out that there is nothing to do.
        from pipeline.job.checks import load_checked_job

        loaded, _ = load_checked_job(job_file, overrides, preview=preview)
        print_warnings(loaded.warnings)
    run(loaded.job, layout, todo, submitted=loaded, cores=cores)


@click.command()
@submitted_job_argument
@cores_option
def resume(job: str, output: Path, cores: int | None) -> None:
    """Continue a job from its own folder, without its original file.

    \b
    pipeline resume quickstart
    pipeline resume /mnt/films/dam-break
    """
    layout = find_job(job, output)
    submitted = _job_in(layout)
    run(submitted, layout, _stages_to_run(submitted, layout), cores=cores)


@click.command()
@submitted_job_argument
@click.option("--stage", "stages", multiple=True, help="Only this stage; may be given several times.")
@click.option("--frames", metavar="RANGES", help="Only these frames: 7 or 0-29 or 0-29,60-89.")
@cores_option
def rerun(job: str, output: Path, stages: tuple[str, ...], frames: str | None, cores: int | None) -> None:
    """Run stages or frames again although they are up to date.

    What depends on them follows if they turn out different.

    \b
    pipeline rerun quickstart --stage render --frames 10-19
    pipeline rerun quickstart --stage surface
    """
    from pipeline.runner import Selection
    from pipeline.stages import STAGES

    if not stages and frames is None:
        raise click.UsageError("say what to run again: --stage, --frames or both")
    layout = find_job(job, output)
    selection = Selection(frozenset(stages), None if frames is None else parse_frames(frames))
    run(_job_in(layout), layout, frozenset(stage.name for stage in STAGES), cores=cores, rerun=selection)


def run(
    job: Job,
    layout: JobLayout,
    todo: frozenset[str],
    *,
    submitted: LoadedJob | None = None,
    cores: int | None = None,
    rerun: Selection | None = None,
) -> NoReturn:
    """Run a job with progress on standard error, say how it ended, and exit with the outcome's code.

    Args:
        job: the job.
        layout: its folder; made if it is not there.
        todo: the stages that will have to run; that they can run here is made sure of before any work.
        submitted: the job file, kept in the folder with the meshes that it names; None: it is there already.
        cores: how many cores to use at most.
        rerun: tasks to run again although they are up to date.

    Raises:
        PipelineError: the folder cannot be written to, the record is damaged, or there is nothing such to run again.
        DiskFullError: not even the record could be opened; nothing is lost.
        StageUnavailableError: a stage that has to run cannot run on this machine.
        JobBusyError: the job is being run by another process, and something is to run again. (Otherwise that run is
            watched.)
    """
    _require_possible(job, todo)
    _make_folder(layout)
    job_text = None
    if submitted is not None:
        job, job_text = _keep(submitted, layout)
    while True:
        try:
            outcome = _run_once(job, layout, job_text=job_text, cores=cores, rerun=rerun)
        except OSError as error:
            if not is_disk_full(error):
                raise
            raise DiskFullError(DISK_FULL.format(layout.root)) from error
        except JobBusyError as busy:
            if rerun is not None:
                raise
            _watch(busy, layout, job_text)
        else:
            _report(job, layout, outcome)
            sys.exit(outcome.exit_code)


def _run_once(
    job: Job, layout: JobLayout, *, job_text: str | None, cores: int | None, rerun: Selection | None
) -> Outcome:
    from pipeline.executors.processes import ProcessExecutor, WorkerLimits
    from pipeline.progress import ProgressObserver, open_display
    from pipeline.resources import machine_capacity
    from pipeline.run_events import Observers
    from pipeline.runner import run_job
    from pipeline.solver_numbers import SolverWatch

    capacity = machine_capacity(gpus=GPU_TASKS)
    if cores is not None:
        capacity = replace(capacity, cores=min(cores, capacity.cores))
    limits = WorkerLimits(stall_timeout_s=STALL_TIMEOUT_S)
    with ProgressObserver(open_display()) as progress, ProcessExecutor(limits) as executor:
        solvers = SolverWatch(layout, lambda sentence: progress.display.say(f"warning: {sentence}", style="yellow"))
        return run_job(
            job,
            layout,
            executor=executor,
            job_text=job_text,
            observer=Observers(progress, solvers),
            rerun=rerun,
            capacity=capacity,
        )


def _watch(busy: JobBusyError, layout: JobLayout, job_text: str | None) -> None:
    """Watch the run that is under way; returns when it has ended if our version of the job is another than that one."""
    from pipeline.commands.watching import INTERRUPTED, watch

    click.echo(f"{busy}; watching it instead (Ctrl-C ends the watching only)", err=True)
    another_version = job_text is not None and _text_of(layout.job_file) != job_text
    if another_version:
        click.echo("it runs an earlier version of the job; this one follows", err=True)
    code = watch(layout)
    if code == INTERRUPTED or not another_version:
        sys.exit(code)


def _report(job: Job, layout: JobLayout, outcome: Outcome) -> None:
    from pipeline.scheduler import JobOutcome
    from pipeline.solver_numbers import simulation_numbers

    film = layout.path(layout.movie())
    if outcome.kind is not JobOutcome.SUCCEEDED:
        click.secho(f"{job.name}: {outcome.kind.value} after {wording.duration(outcome.seconds)}", err=True, fg="red")
        for failed in outcome.failures[:5]:
            click.echo(f"  {failed.task_id}: {failed.message}", err=True)
            click.echo(f"    pipeline logs {layout.root} {failed.task_id}", err=True)
        click.echo(f"continue with: pipeline resume {layout.root}", err=True)
    elif outcome.ran == 0:
        click.echo(f"up to date: {film}")
    else:
        click.echo(
            f"{film}: {job.frame_count} frames, {job.frame_count / (job.movie.playback_fps or job.fps):.3g} s of film, "
            f"in {wording.duration(outcome.seconds)}"
        )
    if outcome.ran or outcome.failures:
        print_warnings([str(each) for each in simulation_numbers(layout).warnings()])
        _write_report(layout)


def _write_report(layout: JobLayout) -> None:
    """Leave the report in the job's folder. That it cannot be written is said, and changes nothing about the run."""
    from pipeline.report.writing import write_report

    try:
        write_report([layout], layout.report)
    except (OSError, PipelineError) as error:
        print_warnings([f"no report was written: {error}"])
    else:
        click.echo(f"report: {layout.report}", err=True)


def _stages_to_run(job: Job, layout: JobLayout) -> frozenset[str]:
    """The stages with a task that is not up to date, going by a look at the record and the files."""
    from pipeline.commands.inspecting import assess_job
    from pipeline.plan import Verdict
    from pipeline.stages import STAGES

    try:
        assessments, _ = assess_job(job, layout)
    except (OutdatedManifestError, MissingInputError):
        # Only the runner may bring the record up to date; and what is missing is for the check of the job to say.
        return frozenset(stage.name for stage in STAGES)
    return frozenset(each.task.stage for each in assessments if each.verdict is not Verdict.UP_TO_DATE)


def _job_in(layout: JobLayout) -> Job:
    from pipeline.job.loading import load_job

    return load_job(layout.job_file)


def _text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


def _require_possible(job: Job, todo: frozenset[str]) -> None:
    """Refuse before any work what has to be done and cannot be done here."""
    from pipeline.stages import STAGES

    obstacles = [
        f"{stage.name}: {obstacle}" for stage in STAGES if stage.name in todo for obstacle in stage.obstacles(job)
    ]
    if obstacles:
        raise StageUnavailableError("\n".join(obstacles))


def _keep(submitted: LoadedJob, layout: JobLayout) -> tuple[Job, str]:
    """Copy what the job reads into its folder; returns the job that reads the copies, and its text."""
    from pipeline.job.inputs import keep_inputs

    try:
        return keep_inputs(submitted, layout)
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError(DISK_FULL.format(layout.root)) from error
        raise PipelineError(f"cannot copy {error.filename} into {layout.root}: {error.strerror}") from error


def _make_folder(layout: JobLayout) -> None:
    try:
        layout.root.mkdir(parents=True, exist_ok=True)
        probe = layout.root / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError(DISK_FULL.format(layout.root)) from error
        raise PipelineError(
            f"cannot write to {layout.root}: {error.strerror}; name another folder with --output"
        ) from error
