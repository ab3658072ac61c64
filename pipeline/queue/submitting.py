"""Submissions: what a job still needs, its entry in the queue, and seeing it through to an exit code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.base import wording
from pipeline.base.errors import (
    DamagedManifestError,
    DiskFullError,
    MissingInputError,
    OutdatedManifestError,
    PipelineError,
)
from pipeline.base.files import holds
from pipeline.base.layout import JobLayout
from pipeline.base.places import check_places
from pipeline.base.wording import print_warnings
from pipeline.run.executors.choice import ExecutorChoice, require_named_devices, require_possible
from pipeline.run.executors.failures import is_disk_full

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.model.job import Job
    from pipeline.queue.cost import Expectation
    from pipeline.queue.disk import Size
    from pipeline.queue.job_queue import QueuedJob
    from pipeline.run.assessment import JobAssessment
    from pipeline.run.control import Selection


@dataclass(frozen=True)
class QueueOptions:
    """How a job waits its turn."""

    cores: int | None = None  # processor cores to use at most; None: all
    detach: bool = False  # return at once, and let it run in the background
    priority: int | None = None  # higher ones go first; None: as before, 0 for a new one
    reserve_bytes: int | None = None  # free disk space at which it pauses [bytes]; None: the usual
    # what runs its tasks; with `scheduler` and `workers`, see `pipeline.run.executors.choice`
    executor: str | None = None
    scheduler: str | None = None
    workers: int | None = None

    def applied_to(self, entry: QueuedJob) -> QueuedJob:
        """An entry as it was, but for what these options name."""
        return replace(
            entry,
            cores=entry.cores if self.cores is None else self.cores,
            reserve_bytes=entry.reserve_bytes if self.reserve_bytes is None else self.reserve_bytes,
            priority=entry.priority if self.priority is None else self.priority,
            settings=self.choice.settings if self.executor or self.choice.settings else entry.settings,
        )

    @property
    def choice(self) -> ExecutorChoice:
        """The executor that they name. Raises UsageError if they do not go together."""
        return ExecutorChoice.of(self.executor, self.scheduler, self.workers)


def submit(loaded: LoadedJob, layout: JobLayout, *, options: QueueOptions, until: Sequence[str] = ()) -> int:
    """Check a job that was read, and run it in its folder as far as that is not done; returns the exit code.

    Raises JobFileError with every problem, and as `run`.
    """
    from pipeline.run.checked_job import checked, require_plannable

    require_plannable(loaded)
    state = look_at(loaded.job, layout, until)
    todo = stages_to_run(state)
    if todo:
        # Checking the scene builds its shapes, which takes longer than finding out that there is nothing to do.
        from pipeline.queue.disk import size_of

        loaded, findings = checked(loaded, until)
        print_warnings(loaded.warnings)
        if state is not None:
            _say_what_it_takes(loaded.job, state, size_of(loaded.job, findings), layout, options, until=until)
    if is_finished(state, layout, loaded.text, until):
        from pipeline.queue.endings import say_finished

        say_finished(layout)
        return 0
    return run(loaded.job, layout, todo, submitted=loaded, options=options, until=until)


def run(
    job: Job,
    layout: JobLayout,
    todo: frozenset[str],
    *,
    options: QueueOptions,
    submitted: LoadedJob | None = None,
    rerun: Selection | None = None,
    paused: QueuedJob | None = None,
    until: Sequence[str] = (),
) -> int:
    """Queue a job, run or watch it, say how it ended, and return the exit code of that.

    Args:
        layout: its folder; made if it is not there.
        todo: the stages that will have to run; that they can run here is made sure of before any work.
        submitted: the job file, kept in the folder with the meshes that it names; None: it is there already.
        rerun: tasks to run again although they are up to date.
        paused: its entry in the queue, which is to go on as it was meant.
        until: the stages after which it ends; empty: the film.

    Raises:
        PipelineError: the folder cannot be written to, something is in the place of a part of it, the record is
            damaged, or there is nothing such to run again.
        StageUnavailableError: a stage that has to run cannot run on this machine.
        JobBusyError: the job is being run by another process, and something is to run again.
    """
    from pipeline.base.lease import live_holder, refuse_if_held
    from pipeline.queue.job_queue import JobQueue, checked_name, new_entry
    from pipeline.queue.turns import run_now, stand_in_queue

    choice = options.choice
    if paused is not None and options.executor is None and not choice.settings:
        choice = ExecutorChoice.from_settings(paused.settings)
    if choice.scheduler is None:
        require_possible(job, todo)
    else:  # it is not this machine that has to be able to
        if options.cores is not None:
            raise click.UsageError("--cores is for this machine; on a cluster the workers' tags say what they offer")
        require_named_devices(job, todo)
    make_folder(layout)
    check_places(layout)
    queue = JobQueue.of(layout)
    name = checked_name(layout.root.absolute().name)
    if job.recorded is not None and queue.find(name) is None:
        refuse_if_held(layout.lease)  # by who records it: only the end of a recording writes how many frames it has
    job, job_text = (job, None) if submitted is None else _keep(submitted, layout)
    if paused is not None:
        entry = options.applied_to(paused.again(background=options.detach, settings=choice.settings))
    else:
        entry = new_entry(
            name,
            text=job_text,
            rerun_stages=None if rerun is None else tuple(sorted(rerun.stages)),
            rerun_frames=None if rerun is None or rerun.frames is None else tuple(sorted(rerun.frames)),
            until=tuple(until),
            cores=options.cores,
            reserve_bytes=options.reserve_bytes,
            priority=queue.priority_of(name) if options.priority is None else options.priority,
            background=options.detach,
            settings=choice.settings,
        )
    if rerun is not None:
        refuse_if_held(layout.lease)
    try:
        if not todo and live_holder(layout.lease) is None:
            # Nothing has to wait its turn for finding out that there is nothing to do.
            code = run_now(queue, layout, job, entry)
            if code is not None:
                return code
        return stand_in_queue(queue, layout, entry, detach=options.detach)
    except OSError as error:
        if not is_disk_full(error):
            raise
        raise DiskFullError.of(layout.root) from error


def look_at(job: Job, layout: JobLayout, until: Sequence[str] = ()) -> JobAssessment | None:
    """How a job stands, by its record and its files; None if only a run can tell."""
    from pipeline.run.assessment import assess_job

    try:
        return assess_job(job, layout, until)
    except (DamagedManifestError, OutdatedManifestError, MissingInputError):
        # Only the runner may put the record in order; and what is missing is for the check of the job to say.
        return None


def stages_to_run(state: JobAssessment | None) -> frozenset[str]:
    """The stages with a task that is not up to date."""
    from pipeline.run.plan import Verdict
    from pipeline.stages import STAGES

    if state is None:
        return frozenset(stage.name for stage in STAGES if not stage.on_demand)
    return frozenset(each.task.stage for each in state.assessments if each.verdict is not Verdict.UP_TO_DATE)


def is_finished(state: JobAssessment | None, layout: JobLayout, text: str | None, until: Sequence[str]) -> bool:
    """Whether there is nothing at all to do: all that is wanted is there, made from this very job file.

    `text` is the job file; None: that of the folder.
    """
    from pipeline.queue.job_queue import JobQueue
    from pipeline.run.goal import read_goal

    return (
        state is not None
        and state.at_rest
        and (text is None or holds(layout.job_file, text))
        and read_goal(layout) == tuple(until)
        and JobQueue.of(layout).find(layout.root.absolute().name) is None
    )


def _say_what_it_takes(
    job: Job, state: JobAssessment, size: Size, layout: JobLayout, options: QueueOptions, *, until: Sequence[str] = ()
) -> None:
    """Say how long a job will take, what disk space and memory, and warn if that is days, or more than there is.

    On a cluster only the disk space is told: how fast its machines are is theirs to know.
    """
    from pipeline.queue import cost, disk
    from pipeline.run.checked_job import needs_pictures

    folder = next(each for each in (layout.root.absolute(), *layout.root.absolute().parents) if each.is_dir())
    free = disk.free_bytes(folder)
    costs = cost.costs_here(job, draws=needs_pictures(until), cores=options.cores, say=say_aside)
    expected, without_gpu = cost.both_ways(job, state.assessments, size, costs, state.costs)
    takes = expected.disk_bytes
    if takes:
        told = f"about {wording.size(takes)} to write; {wording.size(free)} are free"
        here = options.choice.scheduler is None
        say_aside(f"{cost.describe(expected, without_gpu)}; {wording.size(free)} of disk are free" if here else told)
        warning = cost.too_long(expected, job) if here else None
        print_warnings([warning] if warning else [])
    reserve = disk.usual_reserve_bytes(folder) if options.reserve_bytes is None else options.reserve_bytes
    if takes > free - reserve:
        print_warnings(
            [f"the disk may be too small: the job pauses when only the reserve of {wording.size(reserve)} is left"]
        )


def first_cost(job: Job, size: Size, until: Sequence[str] = ()) -> tuple[Expectation, Expectation | None]:
    """What a job takes that was never submitted; see `cost.both_ways`.

    Raises StageUnavailableError: it cannot be planned here, as for want of a Blender.
    """
    from pipeline.queue import cost
    from pipeline.run.checked_job import needs_pictures
    from pipeline.run.plan import assess, plan_job
    from pipeline.stages import STAGES

    tasks = plan_job(job, JobLayout(Path(job.name)), STAGES, until)
    assessments = assess(tasks, {}, {}, parameters=lambda _: None)
    return cost.both_ways(job, assessments, size, cost.costs_here(job, draws=needs_pictures(until), say=say_aside))


def say_aside(sentence: str) -> None:
    """On the error stream, so that output stays fit for a pipe."""
    click.echo(sentence, err=True)


def _keep(submitted: LoadedJob, layout: JobLayout) -> tuple[Job, str]:
    """Copy what the job reads into its folder; returns the job that reads the copies, and its text."""
    from pipeline.job.inputs import keep_inputs

    try:
        return keep_inputs(submitted, layout)
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError.of(layout.root) from error
        raise PipelineError(f"cannot copy {error.filename} into {layout.root}: {error.strerror}") from error


def make_folder(layout: JobLayout) -> None:
    """Make a job's folder, if it is not there. Raises PipelineError: it cannot be written to."""
    try:
        layout.root.mkdir(parents=True, exist_ok=True)
        probe = layout.root / ".writable"
        probe.touch()
        probe.unlink(missing_ok=True)  # another host may have looked at the same moment
    except OSError as error:
        if is_disk_full(error):
            raise DiskFullError.of(layout.root) from error
        raise PipelineError(
            f"cannot write to {layout.root}: {error.strerror}; name another folder with --farm"
        ) from error
