"""A job's turn in the queue: run it with progress, or watch whoever does, and say how it ended."""

from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

import click

from pipeline.base.errors import DiskFullError, JobBusyError, PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.resources import machine_capacity
from pipeline.base.wording import print_warnings
from pipeline.job.loading import job_of_text, load_job
from pipeline.model.gpus import gpu_count, render_trouble
from pipeline.model.job import Job
from pipeline.queue.cost import Costs, Teacher
from pipeline.queue.endings import tell_end
from pipeline.queue.farm import Ended, FarmControl, FarmRunner, StopReason, TakeOver, start_in_background
from pipeline.queue.following import CTRL_C, STOPPED_FROM_ELSEWHERE, Follower
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob, QueueError
from pipeline.queue.notifications import notification_of, send
from pipeline.queue.preview_movie import PreviewMovie
from pipeline.run.checked_job import needs_pictures
from pipeline.run.control import RunControl, Selection
from pipeline.run.events import JobOutcome, Observer, Outcome
from pipeline.run.executors.attempt import STAGES_REFERENCE
from pipeline.run.executors.choice import ExecutorChoice, open_machines
from pipeline.run.goal import own_goal, return_to
from pipeline.run.progress import ProgressObserver, open_display
from pipeline.run.rates import known_rates
from pipeline.run.runner import run_job
from pipeline.run.solver_numbers import SolverWatch
from pipeline.stages import STAGES


def stand_in_queue(queue: JobQueue, layout: JobLayout, entry: QueuedJob, *, detach: bool) -> int:
    """Queue a job and see it through: run the queue if nobody does, else watch; returns the exit code."""
    follower = Follower(queue, layout)
    entry = follower.enqueue(entry)
    if detach:
        pid = start_in_background(queue)
        how = "runs in the background" if pid is None else f"runs in the background, process {pid}"
        click.echo(f"{entry.name} is queued; the queue {how}")
        click.echo(f"see: pipeline status --farm {queue.farm}; pipeline status {layout.root} --follow")
        return 0
    while True:
        try:
            lease = Lease.acquire(queue.lease)
        except JobBusyError:
            code = follower.follow()
            if code is not None:
                return code
        else:
            try:
                with lease:
                    code = _run_queue(queue, layout, lease, follower.submission)
            finally:
                _hand_over(queue)
            if code is None:  # somebody else has settled it, or submitted it anew, while we ran another job
                code = follower.follow()
            if code is not None:
                return code


def _run_queue(queue: JobQueue, layout: JobLayout, lease: Lease, submission: str) -> int | None:
    """Run the queue until our job is settled; returns the exit code, or None if somebody else has to settle it."""
    turns = Turns(queue, submission)
    runner = FarmRunner(queue, lease, turns.run, say, turns.ended, submission=submission)
    if lease.takeover is not None:
        say(f"{lease.takeover}; its queue goes on")
    try:
        ended = runner.work()
    except KeyboardInterrupt:  # between two jobs, or while another one ran, which stays in the queue
        entry = queue.find(layout.root.absolute().name)
        if entry is not None and entry.submission == submission and entry.desired is Desired.RUN:
            queue.change(entry.name, desired=Desired.PAUSE, note="stopped by hand")
        click.echo(f"continue with: pipeline resume {layout.root}", err=True)
        return CTRL_C
    if ended is None:
        return None
    if ended.error is not None:
        raise ended.error
    return exit_code_of(ended)


def exit_code_of(ended: Ended) -> int:
    """What a command exits with whose job ended so."""
    if ended.outcome is not None and (ended.reason is None or ended.outcome.kind not in _STOPPED):
        return ended.outcome.exit_code  # it came to its own end before it could obey
    return DiskFullError.exit_code if ended.reason is StopReason.DISK_SHORT else STOPPED_FROM_ELSEWHERE


_STOPPED = {JobOutcome.DRAINED, JobOutcome.CANCELLED}


class Turns:
    """Runs the jobs of a queue, one at a time, and says how each turn ended once the queue knows it, too."""

    def __init__(self, queue: JobQueue, submission: str | None) -> None:
        """Make the turns of a queue; what `submission`, that of this command, makes is said on standard output."""
        self._queue = queue
        self._submission = submission
        self._job: Job | None = None
        self._own_goal: tuple[str, ...] = ()
        self._aside = False

    def run(self, entry: QueuedJob, control: FarmControl, observer: TakeOver) -> Outcome:
        """One job's turn: run it with progress on standard error."""
        layout = as_given(self._queue.layout(entry.name))
        self._job = None
        self._aside = entry.submission != self._submission
        if self._aside:
            say(f"{entry.name}: its turn")
        job = load_job(layout.job_file) if entry.text is None else job_of_text(entry.text, layout.job_file)
        self._own_goal = own_goal(layout)
        outcome = _run_once(job, layout, entry, control=control, observer=observer.notify)
        self._job = job
        return outcome

    def ended(self, name: str, folder: Path, ended: Ended) -> None:
        """Say how a turn ended, here and to those who want to be told."""
        if ended.outcome is not None and self._job is not None:
            try:
                _end(self._job, as_given(JobLayout(folder)), ended.outcome, self._own_goal, aside=self._aside)
            except (OSError, PipelineError) as error:  # of its folder: the other jobs go on
                print_warnings([f"{name}: {error}"])
        notification = notification_of(name, folder, ended)
        if notification is not None:
            print_warnings(send(notification))


def as_given(layout: JobLayout) -> JobLayout:
    """A folder below the working one by its short name, for messages."""
    with suppress(ValueError):
        return JobLayout(layout.root.relative_to(Path.cwd()))
    return layout


def run_now(queue: JobQueue, layout: JobLayout, job: Job, entry: QueuedJob) -> int | None:
    """Run a job in which nothing is to be done, beside the queue.

    Returns the exit code; None if somebody else works in its folder now.
    """
    before = own_goal(layout)
    try:
        outcome = _run_once(job, layout, replace(entry, settings=()))  # no cluster is needed for nothing
    except JobBusyError:
        return None
    _end(job, layout, outcome, before)
    if outcome.kind is JobOutcome.SUCCEEDED and queue.folder.exists():
        with queue.locked(), suppress(QueueError):
            old = queue.find(entry.name)
            if old is not None and old.desired is not Desired.RUN:
                queue.drop(entry.name)
    return outcome.exit_code


def _end(job: Job, layout: JobLayout, outcome: Outcome, own_goal: tuple[str, ...], *, aside: bool = False) -> None:
    """Tell the end of a run; after an export what is asked of the job is about its own goal again."""
    tell_end(job, layout, outcome, aside=aside)
    if outcome.kind is JobOutcome.SUCCEEDED:
        return_to(layout, own_goal)


def _run_once(
    job: Job,
    layout: JobLayout,
    entry: QueuedJob,
    *,
    control: RunControl | None = None,
    observer: Observer | None = None,
) -> Outcome:
    choice = ExecutorChoice.from_settings(entry.settings)
    draws_here = choice.scheduler is None and needs_pictures(entry.until)
    capacity = machine_capacity(gpus=gpu_count(job, draws=draws_here))
    if entry.cores is not None:
        capacity = replace(capacity, cores=min(entry.cores, capacity.cores))
    rerun = None
    if entry.rerun_stages is not None:
        frames = None if entry.rerun_frames is None else frozenset(entry.rerun_frames)
        rerun = Selection(frozenset(entry.rerun_stages), frames)
    with (
        ProgressObserver(open_display(job.name), {stage.name: stage.about for stage in STAGES}) as progress,
        open_machines(choice, layout, capacity, progress.display.say) as machines,
        ExitStack() as stack,
    ):

        def warn(sentence: str) -> None:
            progress.display.say(f"warning: {sentence}", style="yellow")

        if draws_here and (trouble := render_trouble(job)):
            warn(f"{trouble}; frames are drawn on the processor")
        observers: list[Observer] = [progress.notify, SolverWatch(layout, warn).notify]
        if choice.scheduler is None and (rates := known_rates()) is not None:
            teacher = Teacher(job, layout, Costs(rates, capacity))
            stack.callback(teacher.teach)
            observers.append(teacher.notify)
        if observer is not None:
            observers.append(observer)
        observers.append(stack.enter_context(PreviewMovie(job, layout, progress.display.say, warn)).notify)
        return run_job(
            job,
            layout,
            executor=machines.executor,
            job_text=entry.text,
            stages=STAGES_REFERENCE,
            observers=observers,
            control=control,
            rerun=rerun,
            until=entry.until,
            capacity=machines.capacity,
            machine=machines.machine,
        )


def _hand_over(queue: JobQueue) -> None:
    """Leave jobs that no terminal waits for to a runner in the background."""
    if any(job.background for job in queue.left()):
        pid = start_in_background(queue)
        if pid is not None:
            say(f"jobs that wait go on in the background, process {pid}")


def say(sentence: str) -> None:
    """A sentence for the user, beside what a command prints."""
    click.secho(sentence, err=True, fg="yellow")
