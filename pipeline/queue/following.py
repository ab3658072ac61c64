"""Followers of a job that another process runs, or that waits in the queue."""

import time
from collections.abc import Callable
from functools import partial

import click

from pipeline.base.errors import DamagedManifestError
from pipeline.base.layout import JobLayout
from pipeline.base.lease import LeaseHolder, busy_error, live_holder
from pipeline.base.task import TaskId, TaskState
from pipeline.queue.farm import start_in_background
from pipeline.queue.job_queue import Desired, JobQueue, QueuedJob
from pipeline.queue.states import ending_of
from pipeline.record.reader import LastRun, ManifestReader, StageSummary, done_and_total, record_of
from pipeline.run.events import JobOutcome
from pipeline.run.goal import what_is_made
from pipeline.run.progress import Display, StageProgress, open_display
from pipeline.run.solver_numbers import SIMULATE

POLL_INTERVAL_S = 0.5

CTRL_C = 130
"""As shells report a program that Ctrl-C ended."""

STOPPED_FROM_ELSEWHERE = 8
"""The job was paused or cancelled by another command."""


def watch(layout: JobLayout) -> int:
    """Show a running job's progress until its runner ends.

    Returns 0 if that run itself says that it has done everything, else 5, as `submit` would have; CTRL_C after Ctrl-C.
    """
    watched: str | None = None
    preview_said = False
    display = open_display(layout.root.absolute().name)
    stages: dict[str, StageProgress] = {}
    try:
        while True:
            holder = live_holder(layout.lease)
            if holder is not None:
                watched = holder.token
            summary, last_run = record_of(layout)
            _update(stages, layout, summary)
            display.show(stages.values())
            preview_said = preview_said or (holder is not None and _say_preview_movie(display, layout))
            if holder is None:
                # A run that ended before we looked has no name for us; it is the last one on record then.
                ended_as = last_run.outcome if watched in (None, last_run.run) else None
                return _say_how_it_ended(display, layout, summary, ended_as)
            time.sleep(POLL_INTERVAL_S)
    except KeyboardInterrupt:
        display.say("not watching any more; the job runs on")
        return CTRL_C
    finally:
        display.close()


def _record_to_be(layout: JobLayout) -> tuple[list[StageSummary], LastRun]:
    """As `record_of`; nothing of a damaged record, which the run that is waited for makes anew."""
    try:
        return record_of(layout)
    except DamagedManifestError:
        return [], LastRun(None, None)


class Follower:
    """Sees one submission through that waits in the queue or runs in another process."""

    def __init__(self, queue: JobQueue, layout: JobLayout, *, submission: str = "") -> None:
        self._queue = queue
        self._layout = layout
        self._name = layout.root.absolute().name
        self._before = _record_to_be(layout)[1].run
        self._seen_running = live_holder(layout.lease) is not None
        self._holder_named = bool(submission)  # who asks to follow knows that it runs
        self._said = ""
        self._preview_said = False
        self.submission = submission

    def enqueue(self, entry: QueuedJob) -> QueuedJob:
        """Queue a job and follow it from now on; returns its entry as it is in the queue."""
        queued = self._queue.enqueue(entry)
        self.submission = queued.submission
        holder = live_holder(self._layout.lease)
        if holder is not None:
            self._name_holder(holder, partial(click.echo, err=True))
            if queued.submission == entry.submission:
                click.echo("it runs an earlier version of the job; this one follows", err=True)
        return queued

    def follow(self) -> int | None:
        """Show progress until the submission is settled, or nobody runs the queue any more.

        Returns 0 if its run says that it has done everything, else what `submit` would have returned; None if somebody
        has to run the queue, and nobody does. CTRL_C after Ctrl-C: the job stays in the queue.
        """
        display = open_display(self._name)
        stages: dict[str, StageProgress] = {}
        try:
            while True:
                entry = self._queue.find(self._name)
                holder = live_holder(self._layout.lease)
                runs = holder is not None
                summary, last_run = _record_to_be(self._layout)
                _update(stages, self._layout, summary)
                if holder is not None:
                    self._seen_running = True
                    self._name_holder(holder, display.say)
                    display.show(stages.values())
                    self._preview_said = self._preview_said or _say_preview_movie(display, self._layout)
                if entry is None:
                    if not runs:
                        return self._say_how_it_left(display, summary, last_run)
                elif entry.submission != self.submission:
                    self.submission = entry.submission
                    display.say("the job has been submitted again since; following that")
                elif entry.desired is not Desired.RUN:
                    if not runs:
                        return self._say_why_it_stands(display, entry)
                elif live_holder(self._queue.lease) is None and self._queue.find(self._name) == entry:
                    # Looked up again: the job, and with it the runner, may have ended since the entry was read.
                    return None
                elif not runs:
                    self._say_place(display)
                time.sleep(POLL_INTERVAL_S)
        except KeyboardInterrupt:
            entry = self._queue.find(self._name)
            if entry is not None and entry.submission == self.submission and entry.desired is Desired.RUN:
                self._queue.change(self._name, background=True)  # nobody waits for it here any more
                start_in_background(self._queue)
            display.say("not watching any more; the job runs on, or waits in the queue")
            return CTRL_C
        finally:
            display.close()

    def _name_holder(self, holder: LeaseHolder, tell: Callable[[str], None]) -> None:
        if not self._holder_named:
            self._holder_named = True
            tell(f"{busy_error(self._layout.lease, holder)}; watching it instead (Ctrl-C ends the watching only)")

    def _say_place(self, display: Display) -> None:
        names = [job.name for job in self._queue.waiting()]
        ahead = names[: names.index(self._name)] if self._name in names else []
        if ahead:
            sentence = f"waiting for {', '.join(ahead[:3])}{f' and {len(ahead) - 3} more' if len(ahead) > 3 else ''}"
            if sentence != self._said:
                self._said = sentence
                display.say(f"{self._name} is queued, {sentence} (Ctrl-C leaves it in the queue)")

    def _say_how_it_left(self, display: Display, summary: list[StageSummary], last_run: LastRun) -> int:
        if last_run.run == self._before and not self._seen_running:
            display.say("it was cancelled before it ran")
            return STOPPED_FROM_ELSEWHERE
        code = _say_how_it_ended(display, self._layout, summary, last_run.outcome)
        return STOPPED_FROM_ELSEWHERE if last_run.outcome in (JobOutcome.CANCELLED, JobOutcome.DRAINED) else code

    def _say_why_it_stands(self, display: Display, entry: QueuedJob) -> int:
        if entry.desired is Desired.NONE:
            display.say(f"it failed: {entry.note}; try again with: pipeline rerun --failed {self._layout.root}")
            return 5
        why = f" ({entry.note})" if entry.note else ""
        display.say(f"it pauses{why}; continue with: pipeline resume {self._layout.root}")
        return STOPPED_FROM_ELSEWHERE


def _say_how_it_ended(display: Display, layout: JobLayout, summary: list[StageSummary], ended_as: str | None) -> int:
    """Counts alone do not tell: a run that is killed before it has planned leaves those of the run before it."""
    if ended_as == JobOutcome.SUCCEEDED:
        display.say(f"{what_is_made(layout)} is done")
        return 0
    done, total = done_and_total(summary)
    display.say(
        f"it is {ending_of(ended_as)} with {done} of {total} tasks done; continue with: pipeline resume {layout.root}"
    )
    return 5


def _say_preview_movie(display: Display, layout: JobLayout) -> bool:
    """Name the preview movie, if there is one; returns whether there is."""
    if not layout.preview_movie.exists():
        return False
    display.say(f"the preview movie, made anew now and then: {layout.preview_movie}")
    return True


def _update(stages: dict[str, StageProgress], layout: JobLayout, summary: list[StageSummary]) -> None:
    """Count as the run itself does, by files: the simulation's one task makes one a frame."""
    now = time.monotonic()
    for counts in summary:
        done, total = counts.done, counts.total
        if counts.stage == SIMULATE:
            with ManifestReader.open_readonly(layout.manifest) as manifest:
                total = manifest.frame_count() or total
                done = total if counts.done else min(total, manifest.artifacts_of(TaskId(SIMULATE))[0])
        stage = stages.setdefault(counts.stage, StageProgress(counts.stage, total, done, at_start=done))
        stage.total = total
        stage.failed = counts.counts.get(TaskState.FAILED, 0)
        if done > stage.done:
            stage.advance(done - stage.done, now)
