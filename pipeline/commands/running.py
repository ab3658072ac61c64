"""Commands that run a job: submit, resume, rerun."""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields, replace
from functools import reduce, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import click

from pipeline import wording
from pipeline.commands.arguments import (
    PRIORITY,
    find_job,
    job_options,
    output_option,
    parse_frames,
    parse_size,
    print_warnings,
    require_own_programs,
    require_plannable,
    submission_folder,
    submitted_job_argument,
)
from pipeline.commands.executing import ExecutorChoice, executor_options, require_named_devices, require_possible
from pipeline.errors import (
    DiskFullError,
    MissingInputError,
    OutdatedManifestError,
    PipelineError,
)
from pipeline.executors.failures import is_disk_full
from pipeline.layout import JobLayout

if TYPE_CHECKING:
    from pipeline.assessing import JobAssessment
    from pipeline.disk import Size
    from pipeline.job.loading import LoadedJob
    from pipeline.job.models import Job
    from pipeline.run_control import Selection
    from pipeline.spool import QueuedJob


@dataclass(frozen=True)
class QueueOptions:
    """How a job waits its turn.

    Attributes:
        cores: processor cores to use at most; None: all.
        detach: return at once, and let it run in the background.
        priority: higher ones go first; None: as before, 0 for a new one.
        reserve_bytes: free disk space at which it pauses [bytes]; None: the usual.
        executor: what runs its tasks; see `pipeline.commands.executing`.
        scheduler: address of a Dask scheduler.
        workers: how many Dask workers to start on this machine.
    """

    cores: int | None = None
    detach: bool = False
    priority: int | None = None
    reserve_bytes: int | None = None
    executor: str | None = None
    scheduler: str | None = None
    workers: int | None = None


_QUEUE_OPTIONS = (
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
    click.option(
        "--cores", type=click.IntRange(min=1), help="Use at most this many processor cores; all of them if omitted."
    ),
    *executor_options,
)


def queue_options(command: Any) -> Any:
    """How a job waits its turn, and who waits for it; the command gets them as `options`."""

    @wraps(command)
    def with_options(**arguments: Any) -> Any:
        taken = {field.name: arguments.pop(field.name) for field in fields(QueueOptions)}
        return command(**arguments, options=QueueOptions(**taken))

    return reduce(lambda decorated, decorate: decorate(decorated), _QUEUE_OPTIONS, with_options)


@click.command()
@job_options
@output_option
@queue_options
def submit(job_file: Path, overrides: tuple[str, ...], preview: bool, output: Path, options: QueueOptions) -> None:
    """Run a job until its film is there.

    Whatever is there already is kept. Submitted again after a crash, a kill or Ctrl-C, it continues. Submitted again
    after a change, it runs what the change concerns, and says so first. Jobs of the same output folder take turns: if
    another one runs, this one waits in the queue, and if this one runs already, that run is watched.

    \b
    pipeline submit jobs/quickstart.toml
    pipeline submit dam.toml --preview
    pipeline submit dam.toml --set render.quality=final --set camera.f_stop=2.8
    pipeline submit dam.toml --detach --priority 10
    pipeline submit dam.toml --output /shared/renders --scheduler tcp://farm:8786
    """
    from pipeline.job.loading import read_job

    if job_file.name == "job.toml":
        _complete_take(JobLayout(job_file.parent))
    loaded = read_job(job_file, overrides, preview=preview)
    require_own_programs(loaded, overrides)
    require_plannable(loaded)
    layout = submission_folder(job_file, loaded.job.name, output, is_changed=bool(overrides) or preview)
    state = _look_at(loaded.job, layout)
    todo = _stages_to_run(state)
    if todo:
        # Checking the scene builds its shapes, which takes longer than finding out that there is nothing to do.
        from pipeline.disk import size_of
        from pipeline.job.checks import load_checked_job

        loaded, findings = load_checked_job(job_file, overrides, preview=preview)
        print_warnings(loaded.warnings)
        if state is not None:
            _say_what_it_takes(state, size_of(loaded.job, findings), layout, options.reserve_bytes)
    _end_if_at_rest(state, layout, loaded.text)
    run(loaded.job, layout, todo, submitted=loaded, options=options)


@click.command()
@submitted_job_argument
@queue_options
def resume(job: str, output: Path, options: QueueOptions) -> None:
    """Continue a job from its own folder, without its original file.

    A job that pauses goes on. A folder that was moved to another disk continues there.

    \b
    pipeline resume quickstart
    pipeline resume /mnt/films/dam-break --detach
    """
    from pipeline.commands.queueing import place
    from pipeline.job.loading import job_of_text

    spool, name = place(job, output)
    waiting = spool.find(name)
    if waiting is not None and waiting.text is not None:  # paused before its run took its job file over
        layout = spool.layout(name)
        submitted = job_of_text(waiting.text, layout.job_file)
    else:
        layout = find_job(job, output)
        _complete_take(layout)
        submitted = _job_in(layout)
    state = _look_at(submitted, layout)
    _end_if_at_rest(state, layout, None)
    run(submitted, layout, _stages_to_run(state), options=options, paused=waiting)


@click.command()
@submitted_job_argument
@click.option("--stage", "stages", multiple=True, help="Only this stage; may be given several times.")
@click.option("--frames", metavar="RANGES", help="Only these frames: 7 or 0-29 or 0-29,60-89.")
@queue_options
def rerun(job: str, output: Path, stages: tuple[str, ...], frames: str | None, options: QueueOptions) -> None:
    """Run stages or frames again although they are up to date.

    What depends on them follows if they turn out different.

    \b
    pipeline rerun quickstart --stage render --frames 10-19
    pipeline rerun quickstart --stage surface
    """
    from pipeline.plan import plan_job
    from pipeline.run_control import Selection
    from pipeline.stages import STAGES

    if not stages and frames is None:
        raise click.UsageError("say what to run again: --stage, --frames or both")
    layout = find_job(job, output)
    selection = Selection(frozenset(stages), None if frames is None else parse_frames(frames))
    submitted = _job_in(layout)
    if submitted.recorded is not None and "simulate" in stages:
        raise PipelineError(f"{submitted.name} is a live take ({submitted.recorded}): it cannot be simulated again")
    selection.of(plan_job(submitted, layout, STAGES))  # what is not in the plan is told now, not when its turn comes
    run(submitted, layout, frozenset(stage.name for stage in STAGES), options=options, rerun=selection)


def run(
    job: Job,
    layout: JobLayout,
    todo: frozenset[str],
    *,
    options: QueueOptions,
    submitted: LoadedJob | None = None,
    rerun: Selection | None = None,
    paused: QueuedJob | None = None,
) -> NoReturn:
    """Queue a job, run or watch it, say how it ended, and exit with the outcome's code.

    Args:
        job: the job.
        layout: its folder; made if it is not there.
        todo: the stages that will have to run; that they can run here is made sure of before any work.
        options: how it waits its turn.
        submitted: the job file, kept in the folder with the meshes that it names; None: it is there already.
        rerun: tasks to run again although they are up to date.
        paused: its entry in the queue, which is to go on as it was meant.

    Raises:
        PipelineError: the folder cannot be written to, the record is damaged, or there is nothing such to run again.
        DiskFullError: not even the record could be opened; nothing is lost.
        StageUnavailableError: a stage that has to run cannot run on this machine.
        JobBusyError: the job is being run by another process, and something is to run again. (Otherwise that run is
            watched.)
    """
    choice = ExecutorChoice.of(options.executor, options.scheduler, options.workers)
    if paused is not None and options.executor is None and not choice.settings:
        choice = ExecutorChoice.from_settings(paused.settings)
    if choice.scheduler is None:
        require_possible(job, todo)
    else:  # it is not this machine that has to be able to
        if options.cores is not None:
            raise click.UsageError("--cores is for this machine; on a cluster the workers' tags say what they offer")
        require_named_devices(job, todo)
    _make_folder(layout)
    from pipeline.commands.turns import run_now, stand_in_queue
    from pipeline.lease import live_holder, refuse_if_held
    from pipeline.spool import Spool, checked_name, submission

    spool = Spool.of(layout)
    name = checked_name(layout.root.absolute().name)
    if job.recorded is not None and spool.find(name) is None:
        refuse_if_held(layout.lease)  # by who records it: only the end of a take writes how many frames it has
    job_text = None
    if submitted is not None:
        job, job_text = _keep(submitted, layout)
    entry = submission(
        name,
        text=job_text,
        rerun_stages=None if rerun is None else tuple(sorted(rerun.stages)),
        rerun_frames=None if rerun is None or rerun.frames is None else tuple(sorted(rerun.frames)),
        cores=options.cores,
        reserve_bytes=options.reserve_bytes,
        priority=spool.priority_of(name) if options.priority is None else options.priority,
        background=options.detach,
        settings=choice.settings,
    )
    if paused is not None:
        entry = replace(entry, text=paused.text, rerun_stages=paused.rerun_stages, rerun_frames=paused.rerun_frames)
        cores = paused.cores if options.cores is None else options.cores
        reserve_bytes = paused.reserve_bytes if options.reserve_bytes is None else options.reserve_bytes
        entry = replace(entry, cores=cores, reserve_bytes=reserve_bytes)
    if rerun is not None:
        refuse_if_held(layout.lease)
    try:
        if not todo and live_holder(layout.lease) is None:
            # Nothing has to wait its turn for finding out that there is nothing to do.
            code = run_now(spool, layout, job, entry)
            if code is not None:
                sys.exit(code)
        sys.exit(stand_in_queue(spool, layout, entry, detach=options.detach))
    except OSError as error:
        if not is_disk_full(error):
            raise
        raise DiskFullError.of(layout.root) from error


def _complete_take(layout: JobLayout) -> None:
    """Take over all frames of a take whose recorder crashed, and say so."""
    from pipeline.crashed_take import complete_crashed_take

    if sentence := complete_crashed_take(layout):
        click.echo(sentence, err=True)


def _say_what_it_takes(state: JobAssessment, size: Size, layout: JobLayout, reserve_bytes: int | None) -> None:
    """Say how much a job will write, about, and warn if the disk has no room for it."""
    from pipeline import disk

    folder = next(each for each in (layout.root.absolute(), *layout.root.absolute().parents) if each.is_dir())
    free = disk.free_bytes(folder)
    takes = disk.estimate_bytes(state.assessments, state.costs, size)
    if takes:
        click.echo(f"about {wording.size(takes)} to write; {wording.size(free)} are free", err=True)
    reserve = disk.usual_reserve_bytes(folder) if reserve_bytes is None else reserve_bytes
    if takes > free - reserve:
        print_warnings(
            [f"the disk may be too small: the job pauses when only the reserve of {wording.size(reserve)} is left"]
        )


def _look_at(job: Job, layout: JobLayout) -> JobAssessment | None:
    """How a job stands, by its record and its files; None if only a run can tell."""
    from pipeline.assessing import assess_job

    try:
        return assess_job(job, layout)
    except (OutdatedManifestError, MissingInputError):
        # Only the runner may bring the record up to date; and what is missing is for the check of the job to say.
        return None


def _stages_to_run(state: JobAssessment | None) -> frozenset[str]:
    """The stages with a task that is not up to date."""
    from pipeline.plan import Verdict
    from pipeline.stages import STAGES

    if state is None:
        return frozenset(stage.name for stage in STAGES)
    return frozenset(each.task.stage for each in state.assessments if each.verdict is not Verdict.UP_TO_DATE)


def _end_if_at_rest(state: JobAssessment | None, layout: JobLayout, text: str | None) -> None:
    """End the command if there is nothing at all to do: the film is there, made from this very job file.

    Args:
        state: how the job stands.
        layout: its folder.
        text: the job file; None: that of the folder.
    """
    from pipeline.spool import Spool

    spool = Spool.of(layout)
    if (
        state is not None
        and state.at_rest
        and (text is None or text == _text_of(layout.job_file))
        and spool.find(layout.root.absolute().name) is None
    ):
        click.echo(f"up to date: {layout.film}")
        sys.exit(0)


def _text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.exists() else ""


def _job_in(layout: JobLayout) -> Job:
    from pipeline.job.loading import load_job

    return load_job(layout.job_file)


def _keep(submitted: LoadedJob, layout: JobLayout) -> tuple[Job, str]:
    """Copy what the job reads into its folder; returns the job that reads the copies, and its text."""
    from pipeline.job.inputs import keep_inputs

    try:
        return keep_inputs(submitted, layout)
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError.of(layout.root) from error
        raise PipelineError(f"cannot copy {error.filename} into {layout.root}: {error.strerror}") from error


def _make_folder(layout: JobLayout) -> None:
    try:
        layout.root.mkdir(parents=True, exist_ok=True)
        probe = layout.root / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError.of(layout.root) from error
        raise PipelineError(
            f"cannot write to {layout.root}: {error.strerror}; name another folder with --output"
        ) from error
