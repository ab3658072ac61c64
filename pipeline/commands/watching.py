"""Watch a job that another process runs."""

from __future__ import annotations

import time

from pipeline.errors import OutdatedManifestError
from pipeline.layout import JobLayout
from pipeline.lease import live_holder
from pipeline.manifest_reader import LastRun, ManifestReader, StageSummary
from pipeline.progress import Display, StageProgress, open_display
from pipeline.scheduler_events import JobOutcome
from pipeline.task import TaskState

POLL_INTERVAL_S = 0.5

INTERRUPTED = 130
"""As shells report a program that Ctrl-C ended."""

DONE = (TaskState.SUCCEEDED, TaskState.UP_TO_DATE)


def watch(layout: JobLayout) -> int:
    """Show a running job's progress until its runner ends.

    Returns:
        0 if that run itself says that it has done everything, else 5, as `submit` would have; INTERRUPTED after Ctrl-C.
    """
    watched: str | None = None
    display = open_display()
    stages: dict[str, StageProgress] = {}
    try:
        while True:
            holder = live_holder(layout.lease)
            if holder is not None:
                watched = holder.token
            summary, last_run = _record(layout)
            _update(stages, summary)
            display.show(stages.values())
            if holder is None:
                # A run that ended before we looked has no name for us; it is the last one on record then.
                ended_as = last_run.outcome if watched in (None, last_run.run) else None
                return _say_how_it_ended(display, layout, summary, ended_as)
            time.sleep(POLL_INTERVAL_S)
    except KeyboardInterrupt:
        display.say("not watching any more; the job runs on")
        return INTERRUPTED
    finally:
        display.close()


def _say_how_it_ended(display: Display, layout: JobLayout, summary: list[StageSummary], ended_as: str | None) -> int:
    """Counts alone do not tell: a run that is killed before it has planned leaves those of the run before it."""
    if ended_as == JobOutcome.SUCCEEDED:
        display.say(f"{layout.path(layout.movie())} is done")
        return 0
    done, total = sum(map(_done, summary)), sum(stage.total for stage in summary)
    how = "was cut short" if ended_as is None else f"ended ({ended_as})"
    display.say(f"it {how} with {done} of {total} tasks done; continue with: pipeline resume {layout.root}")
    return 5


def _record(layout: JobLayout) -> tuple[list[StageSummary], LastRun]:
    """Counts by stage and the last run; nothing while the runner is still making its manifest, or renewing it."""
    if not layout.manifest.exists():
        return [], LastRun(None, None)
    try:
        with ManifestReader.open_readonly(layout.manifest) as manifest:
            return manifest.summary(), manifest.last_run()
    except OutdatedManifestError:
        return [], LastRun(None, None)


def _update(stages: dict[str, StageProgress], summary: list[StageSummary]) -> None:
    now = time.monotonic()
    for counts in summary:
        done = _done(counts)
        stage = stages.setdefault(counts.stage, StageProgress(counts.stage, counts.total, done, at_start=done))
        stage.total = counts.total
        stage.failed = counts.counts.get(TaskState.FAILED, 0)
        if done > stage.done:
            stage.advance(done - stage.done, now)


def _done(stage: StageSummary) -> int:
    return sum(stage.counts.get(state, 0) for state in DONE)
