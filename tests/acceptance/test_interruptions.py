"""Killed, stopped, or started twice: submitting again ends in the very same bytes, and nothing is done twice."""

import json
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from blender_stand_in import write_blender_stand_in
from films import (
    FRAMES,
    PATIENCE_S,
    STAGE_NAMES,
    Finished,
    Studio,
    assert_all_gone,
    family_of,
    finish,
    kill,
    listen,
    stage_of,
    standing_still,
)
from processes_seen import words_of

from pipeline.base.task import FailureKind

# --- killed ---


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_worker_and_runner_killed_in_every_stage_and_the_film_is_the_same(reference: Studio, tmp_path: Path) -> None:
    film = Studio.open(tmp_path)
    victims = {stage: ["worker", "runner"] for stage in STAGE_NAMES}
    runner = film.start("submit", "tiny.toml")
    while (found := film.wait_for_attempt(runner, [stage for stage, left in victims.items() if left])) is not None:
        attempt, worker = found
        left = victims[stage_of(attempt.task)]
        if left[0] == "worker":
            with suppress(ProcessLookupError):
                os.kill(worker, signal.SIGKILL)
            film.wait_for_end(attempt)
            ended = film.histories()[attempt.task][attempt.number - 1]
            if ended.outcome != FailureKind.WORKER_LOST:  # it was done a moment before
                continue
            assert "died of SIGKILL in the middle of its task" in ended.message
        else:
            kill(runner)
            runner = film.start("submit", "tiny.toml")
        left.pop(0)
    finish(runner).assert_code(0)
    assert victims == {stage: [] for stage in STAGE_NAMES}
    film.assert_whole(like=reference)
    film.assert_nothing_done_twice()


# --- stopped ---


def interrupt_while_worker_stands_still(studio: Studio, stage: str, *, times: int) -> Finished:
    """Start the job, stop the clock of a worker of this stage, and press Ctrl-C."""
    runner = studio.start("submit", "tiny.toml")
    _, worker = studio.wait_for_attempt(runner, [stage]) or pytest.fail(f"{stage} never ran")
    process = psutil.Process(worker)
    with standing_still(worker):
        said = ""
        for expected in ("stopping: what runs is finished or checkpointed", "stopping at once")[:times]:
            runner.send_signal(signal.SIGINT)
            said += listen(runner, expected)
        if times == 2:
            assert_all_gone([process])
    ended = finish(runner)
    assert_all_gone([process])
    return Finished(ended.code, ended.out, said + ended.err)


@pytest.mark.slow
def test_ctrl_c_once_keeps_a_checkpoint_that_the_simulation_continues_from(finished: Studio, reference: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "simulate", "--yes").assert_code(0)
    stopped = interrupt_while_worker_stands_still(finished, "simulate", times=1).assert_code(130)
    assert "continue with: pipeline resume renders/tiny" in stopped.err
    assert len(finished.artifacts()) < len(reference.artifacts())
    checkpoint = max(finished.layout.checkpoints.glob("[0-9]*.h5"))
    finished.run("resume", "tiny").assert_code(0)
    assert f"starting at frame {int(checkpoint.stem)}\n" in finished.run("explain", "tiny", "simulate", "--log").out
    finished.assert_whole(like=reference)
    # The frames came out the same, so nothing that is made of them was made again.
    assert {task for task, count in finished.attempts().items() if count > 1} == {"simulate"}


@pytest.mark.slow
def test_ctrl_c_while_rendering_once_and_then_twice_and_the_next_run_ends_the_same(
    finished: Studio, reference: Studio
) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    before = finished.attempts()
    for times in (1, 2):
        interrupt_while_worker_stands_still(finished, "render", times=times).assert_code(130)
        pictures = sum(path.startswith("frames/") for path in finished.artifacts())
        assert pictures < FRAMES
    finished.submit()
    finished.assert_whole(like=reference)
    finished.assert_nothing_done_twice(since=before)


# --- two at a time ---


@pytest.mark.slow
def test_a_second_submit_watches_the_first(finished: Studio, reference: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    before = finished.attempts()
    first = finished.start("submit", "tiny.toml")
    attempt, worker = finished.wait_for_attempt(first, ["render"]) or pytest.fail("nothing was rendered")
    with standing_still(worker):
        second = finished.start("submit", "tiny.toml")
        said = listen(second, "watching it instead")
        followed = finished.start("explain", "tiny", attempt.task, "--log", "--follow")
        state = json.loads(finished.run("status", "tiny", "--json").assert_code(0).out)
        assert state["runner"]["pid"] == first.pid
        assert f"running, process {first.pid}" in finished.run("status", "tiny").assert_code(0).out
        busy = f"is being run already, by process {first.pid}"
        assert busy in said
        assert busy in finished.run("clean", "tiny", "--stage", "movie", "--yes").assert_code(4).err
        assert busy in finished.run("rerun", "tiny", "--stage", "movie").assert_code(4).err
    watched, made = finish(second).assert_code(0), finish(first).assert_code(0)
    assert "renders/tiny/movie.mp4 is done" in watched.err
    assert made.out.startswith("renders/tiny/movie.mp4: ")
    assert f"{attempt.task}, attempt 2, on " in finish(followed).assert_code(0).out
    finished.assert_whole(like=reference)
    finished.assert_nothing_done_twice(since=before)


@pytest.mark.slow
def test_another_version_submitted_meanwhile_follows_the_one_that_runs(finished: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    first = finished.start("submit", "tiny.toml")
    _, worker = finished.wait_for_attempt(first, ["render"]) or pytest.fail("nothing was rendered")
    with standing_still(worker):
        second = finished.start("submit", "tiny.toml", "--set", "camera.focal_length_mm=70")
        listen(second, "this one follows")
    finish(first).assert_code(0)
    assert "render 0-5: stale, camera.focal_length_mm changed" in finish(second).assert_code(0).err
    planned = finished.run("plan", "tiny.toml", "--set", "camera.focal_length_mm=70", "--json").assert_code(0)
    assert {each["verdict"] for each in json.loads(planned.out)} == {"up to date"}


# --- a Blender of one's own ---


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    return write_blender_stand_in(tmp_path)


@pytest.mark.slow
def test_an_external_blender_dies_with_its_runner_and_the_next_one_takes_over_and_draws_the_same_pixels(
    finished: Studio, reference: Studio, blender: Path
) -> None:
    external = ("--set", f"render.blender={blender}")
    # The same version of Blender draws the same frames wherever it lies, so they are up to date while they are there.
    assert "up to date" in finished.submit(*external).out
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    attempts = finished.attempts()
    runner = finished.start("submit", "tiny.toml", *external)
    assert finished.wait_for_attempt(runner, ["render"]) is not None
    until = time.monotonic() + PATIENCE_S
    while not any(str(blender) in words_of(process) for process in family_of(runner)):
        assert time.monotonic() < until
        assert runner.poll() is None
        time.sleep(0.01)
    kill(runner)
    assert "tiny: queued" in finished.run("status", "tiny").assert_code(0).out
    submitted = finished.submit(*external)
    assert f"taking over from process {runner.pid}" in submitted.err
    assert "render" in submitted.err
    finished.assert_whole(like=reference)
    assert {stage_of(task) for task in finished.tasks_run_since(attempts)} == {"render"}
