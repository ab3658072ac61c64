"""Watch a job that another process runs."""

from __future__ import annotations

import time

from pipeline.layout import JobLayout
from pipeline.lease import live_holder
from pipeline.manifest_reader import ManifestReader, StageSummary
from pipeline.progress import Display, StageProgress, open_display
from pipeline.task import TaskState

POLL_INTERVAL_S = 0.5

INTERRUPTED = 130
"""As shells report a program that Ctrl-C ended."""

DONE = (TaskState.SUCCEEDED, TaskState.UP_TO_DATE)


def watch(layout: JobLayout) -> int:
    """Show a running job's progress until its runner ends.

    Returns:
        0 if everything is done then, else 5, as `submit` would have; INTERRUPTED after Ctrl-C.
    """
    display = open_display()
    stages: dict[str, StageProgress] = {}
    try:
        while True:
            running = live_holder(layout.lease) is not None
            summary = _summary(layout)
            _update(stages, summary)
            display.show(stages.values())
            if not running:
                return _say_how_it_ended(display, layout, summary)
            time.sleep(POLL_INTERVAL_S)
    except KeyboardInterrupt:
        display.say("not watching any more; the job runs on")
        return INTERRUPTED
    finally:
        display.close()


def _say_how_it_ended(display: Display, layout: JobLayout, summary: list[StageSummary]) -> int:
    done, total = sum(map(_done, summary)), sum(stage.total for stage in summary)
    if done == total > 0:
        display.say(f"{layout.path(layout.movie())} is done")
        return 0
    display.say(f"it ended with {done} of {total} tasks done; continue with: pipeline resume {layout.root}")
    return 5


def _summary(layout: JobLayout) -> list[StageSummary]:
    """Counts by stage; empty while the runner has not made its manifest yet."""
    if not layout.manifest.exists():
        return []
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        return manifest.summary()


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
