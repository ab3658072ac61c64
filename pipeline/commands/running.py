"""Commands that run a job: submit, resume, rerun."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.commands.arguments import find_job, job_options, output_option, parse_frames, submitted_job_argument
from pipeline.errors import JobBusyError, PipelineError, StageUnavailableError
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from pipeline.run_events import Outcome
    from pipeline.runner import Selection

STALL_TIMEOUT_S = 3600.0
"""A task without a sign of life for so long is ended. A single frame shows none while Cycles draws it, and a final one
in film resolution takes half an hour on a few cores."""

cores_option = click.option(
    "--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all of them if omitted."
)


@click.command()
@job_options
@output_option
@cores_option
def submit(job_file: Path, overrides: tuple[str, ...], preview: bool, output: Path, cores: int | None) -> None:
    """Run a job until its film is there; whatever is there already is kept.

    Submitted again after a crash, a kill or Ctrl-C, it continues. Submitted again after a change, it runs what the
    change concerns, and says so first. If the job is running already, it watches that run instead.

    \b
    pipeline submit jobs/quickstart.toml
    pipeline submit dam.toml --preview
    pipeline submit dam.toml --set render.quality=final --set camera.f_stop=2.8
    """
    from pipeline.commands.arguments import DEFAULT_OUTPUT
    from pipeline.job.checks import load_checked_job
    from pipeline.job.loading import read_job

    loaded = read_job(job_file, overrides, preview=preview)
    in_its_folder = output == DEFAULT_OUTPUT and job_file.name == "job.toml" and not overrides and not preview
    own_folder = JobLayout(job_file.parent)
    layout = own_folder if in_its_folder and own_folder.manifest.exists() else JobLayout(output / loaded.job.name)
    if not _is_done(loaded.job, layout):
        # Checking the scene builds its shapes, which takes longer than finding out that there is nothing to do.
        loaded, _ = load_checked_job(job_file, overrides, preview=preview)
        for warning in loaded.warnings:
            click.secho(f"warning: {warning}", err=True, fg="yellow")
    run(loaded.job, layout, job_text=loaded.text, cores=cores)


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
    run(_job_in(layout), layout, cores=cores)


@click.command()
@submitted_job_argument
@click.option("--stage", "stages", multiple=True, help="Only this stage; may be given several times.")
@click.option("--frames", metavar="RANGES", help="Only these frames: 7 or 0-29 or 0-29,60-89.")
@cores_option
def rerun(job: str, output: Path, stages: tuple[str, ...], frames: str | None, cores: int | None) -> None:
    """Run stages or frames again although they are up to date, and then what depends on them if it changed.

    \b
    pipeline rerun quickstart --stage render --frames 10-19
    pipeline rerun quickstart --stage surface
    """
    from pipeline.runner import Selection

    if not stages and frames is None:
        raise click.UsageError("say what to run again: --stage, --frames or both")
    layout = find_job(job, output)
    selection = Selection(frozenset(stages), None if frames is None else parse_frames(frames))
    run(_job_in(layout), layout, cores=cores, rerun=selection)


def run(
    job: Job,
    layout: JobLayout,
    *,
    job_text: str | None = None,
    cores: int | None = None,
    rerun: Selection | None = None,
) -> None:
    """Run a job with progress on standard error, say how it ended, and exit with the outcome's code."""
    from pipeline.executors.processes import ProcessExecutor, WorkerLimits
    from pipeline.progress import ProgressObserver, open_display
    from pipeline.resources import machine_capacity
    from pipeline.runner import run_job

    _require_possible(job)
    _make_folder(layout)
    capacity = machine_capacity(gpus=_gpus())
    if cores is not None:
        capacity = replace(capacity, cores=min(cores, capacity.cores))
    try:
        limits = WorkerLimits(stall_timeout_s=STALL_TIMEOUT_S)
        with ProgressObserver(open_display()) as observer, ProcessExecutor(limits) as executor:
            outcome = run_job(
                job,
                layout,
                executor=executor,
                job_text=job_text,
                observer=observer,
                rerun=rerun,
                capacity=capacity,
            )
    except JobBusyError as busy:
        from pipeline.commands.watching import watch

        click.echo(f"{busy}; watching it instead (Ctrl-C ends the watching only)", err=True)
        sys.exit(watch(layout))
    _report(job, layout, outcome)
    sys.exit(outcome.exit_code)


def _report(job: Job, layout: JobLayout, outcome: Outcome) -> None:
    from pipeline.scheduler import JobOutcome

    film = layout.path(layout.movie())
    if outcome.kind is not JobOutcome.SUCCEEDED:
        click.secho(f"{job.name}: {outcome.kind.value} after {_duration(outcome.seconds)}", err=True, fg="red")
        for failed in outcome.failures[:5]:
            click.echo(f"  {failed.task_id}: {failed.message}", err=True)
            click.echo(f"    pipeline logs {layout.root} {failed.task_id}", err=True)
        click.echo(f"continue with: pipeline resume {layout.root}", err=True)
    elif outcome.ran == 0:
        click.echo(f"up to date: {film}")
    else:
        click.echo(
            f"{film}: {job.frame_count} frames, {job.frame_count / (job.movie.playback_fps or job.fps):.3g} s of film, "
            f"in {_duration(outcome.seconds)}"
        )


def _is_done(job: Job, layout: JobLayout) -> bool:
    """Whether every file of the job is there and up to date."""
    from pipeline.commands.inspecting import assess_job
    from pipeline.plan import Verdict

    if not layout.manifest.exists():
        return False
    assessments, _ = assess_job(job, layout)
    return all(assessment.verdict is Verdict.UP_TO_DATE for assessment in assessments)


def _job_in(layout: JobLayout) -> Job:
    from pipeline.job.loading import load_job

    return load_job(layout.job_file)


def _require_possible(job: Job) -> None:
    """Refuse before any work what this machine cannot do."""
    from pipeline.stages import STAGES

    obstacles = [f"{stage.name}: {obstacle}" for stage in STAGES for obstacle in stage.obstacles(job)]
    if obstacles:
        raise StageUnavailableError("\n".join(obstacles))


def _make_folder(layout: JobLayout) -> None:
    try:
        layout.root.mkdir(parents=True, exist_ok=True)
        probe = layout.root / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise PipelineError(
            f"cannot write to {layout.root}: {error.strerror}; name another folder with --output"
        ) from error


def _gpus() -> int:
    """One simulation at a time on a GPU, if there is one that works."""
    from sim.runtime import resolve_device

    return int(resolve_device("auto") != "cpu")


def _duration(seconds: float) -> str:
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s"
