"""Watching a run of another process: what counts is how that run ended."""

import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from record_samples import commit, film

from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.task import TaskState
from pipeline.queue.following import CTRL_C, Follower, watch
from pipeline.queue.job_queue import JobQueue, new_entry
from pipeline.record.manifest import Manifest
from pipeline.run.events import JobOutcome
from pipeline.run.progress import PlainDisplay

TASKS = film(2)
DONE = {task.id: TaskState.SUCCEEDED for task in TASKS}


@pytest.fixture
def layout(tmp_path, monkeypatch) -> JobLayout:
    """A job whose last run did everything."""
    monkeypatch.setattr("pipeline.queue.following.POLL_INTERVAL_S", 0.02)
    layout = JobLayout(tmp_path)
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film", run="earlier")
        manifest.record_plan(TASKS, DONE)
        manifest.end_run(JobOutcome.SUCCEEDED)
    return layout


def watch_while(layout: JobLayout, runner: Callable[[Lease], None]) -> int:
    """Watch a run that goes on for a few looks, does what `runner` does, and gives its lease back."""
    lease = Lease.acquire(layout.lease)

    def run() -> None:
        time.sleep(0.2)
        runner(lease)
        lease.release()

    running = threading.Thread(target=run)
    running.start()
    try:
        return watch(layout)
    finally:
        running.join()


def test_frames_are_counted_as_the_run_itself_counts_them(layout, monkeypatch):
    """The simulation is one task, and one frame of its two is there."""
    receipt = commit(layout, TASKS[0], TASKS[0].outputs[0], "frame END")
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan(TASKS, {task.id: TaskState.RUNNING for task in TASKS[:1]})
        manifest.record_artifacts([receipt])
    seen = {}
    monkeypatch.setattr(PlainDisplay, "show", lambda _, stages: seen.update({each.name: each for each in stages}))
    watch(layout)
    assert (seen["simulate"].done, seen["simulate"].total) == (1, 2)
    assert (seen["render"].done, seen["render"].total) == (0, 2)


def test_a_film_that_was_done_when_its_entry_went_was_not_cancelled(layout):
    queue = JobQueue.of(layout)
    entry = queue.enqueue(new_entry(layout.root.name))
    with Lease.acquire(layout.lease):  # it runs, and its run is on record as ended already
        follower = Follower(queue, layout, submission=entry.submission)
    queue.drop(entry.name)
    assert follower.follow() == 0


def test_a_runner_that_ends_between_two_looks_leaves_a_film_and_not_a_job_that_waits(layout, monkeypatch):
    queue = JobQueue.of(layout)
    entry = queue.enqueue(new_entry(layout.root.name))
    with Lease.acquire(layout.lease):
        follower = Follower(queue, layout, submission=entry.submission)

    def look(lease: Path) -> None:
        if lease == queue.lease:
            queue.drop(entry.name)  # by a runner that ends right before its lease is looked at

    monkeypatch.setattr("pipeline.queue.following.live_holder", look)
    assert follower.follow() == 0


def test_a_job_that_is_watched_no_more_when_its_runner_ends_goes_on_in_the_background(layout, monkeypatch):
    queue = JobQueue.of(layout)
    follower = Follower(queue, layout, submission=queue.enqueue(new_entry(layout.root.name)).submission)
    runner = Lease.acquire(queue.lease)
    started: list[JobQueue] = []

    def interrupt(_seconds: float) -> None:
        runner.release()
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupt)
    monkeypatch.setattr("pipeline.queue.following.start_in_background", started.append)
    assert (follower.follow(), started) == (CTRL_C, [queue])


def succeed(layout: JobLayout, lease: Lease) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film", run=lease.holder.token)
        manifest.end_run(JobOutcome.SUCCEEDED)


def die_while_planning(layout: JobLayout, lease: Lease) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film", run=lease.holder.token)


def drain(layout: JobLayout, lease: Lease) -> None:
    with Manifest(layout.manifest) as manifest:
        manifest.begin_run("film", run=lease.holder.token)
        manifest.set_states({TASKS[-1].id: TaskState.CANCELLED})
        manifest.end_run(JobOutcome.DRAINED)


@pytest.mark.parametrize(
    ("runner", "code", "told"),
    [
        (succeed, 0, "movie.mp4 is done"),
        (drain, 5, "it is stopped with 3 of 4 tasks done"),
        (die_while_planning, 5, "it is interrupted"),
        (lambda *_: None, 5, "it is interrupted with 4 of 4 tasks done; continue with: pipeline resume"),
    ],
)
def test_a_run_is_a_success_only_if_it_says_so(layout, capsys, runner, code, told):
    assert watch_while(layout, partial(runner, layout)) == code
    assert told in capsys.readouterr().err


def test_the_film_so_far_is_named_once_while_the_job_runs(layout, capsys):
    def make_film(_: Lease) -> None:
        layout.preview_movie.touch()
        time.sleep(0.2)

    watch_while(layout, make_film)
    assert capsys.readouterr().err.count(f"the preview movie, made anew now and then: {layout.preview_movie}") == 1


def test_a_run_that_ended_before_the_first_look_is_judged_by_the_record(layout):
    assert watch(layout) == 0


def test_a_runner_that_is_still_making_its_manifest_is_waited_for(layout):
    layout.manifest.write_bytes(b"")  # as SQLite leaves it until the first commit

    assert watch_while(layout, partial(succeed, layout)) == 0
