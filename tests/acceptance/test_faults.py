"""Whatever happens, there is a clear line, nothing is lost, and submitting again ends in the very same bytes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from films import (
    FRAMES,
    PATIENCE_S,
    PROJECT,
    STAGE_NAMES,
    Finished,
    Studio,
    assert_all_gone,
    family_of,
    finish,
    kill,
    stage_of,
)

from pipeline.task import FailureKind

# --- killed ---


@pytest.mark.slow
def test_runner_killed_in_every_stage_and_the_film_is_the_same(empty: Studio, reference: Studio) -> None:
    spared = set(STAGE_NAMES)
    runner = empty.start("submit", "tiny.toml")
    while (found := empty.wait_for_attempt(runner, spared)) is not None:
        spared.discard(stage_of(found[0].task))
        kill(runner)
        runner = empty.start("submit", "tiny.toml")
    finish(runner).assert_code(0)
    assert spared == set()
    empty.assert_whole(like=reference)
    empty.assert_nothing_done_twice()


@pytest.mark.slow
def test_worker_killed_in_every_stage_and_the_run_goes_on_to_the_same_film(empty: Studio, reference: Studio) -> None:
    spared = set(STAGE_NAMES)
    runner = empty.start("submit", "tiny.toml")
    while (found := empty.wait_for_attempt(runner, spared)) is not None:
        attempt, worker = found
        os.kill(worker, signal.SIGKILL)
        spared.discard(stage_of(attempt.task))
    finished = finish(runner).assert_code(0)
    lost = {
        stage_of(task)
        for task, history in empty.histories().items()
        for attempt in history
        if attempt.outcome == FailureKind.WORKER_LOST
    }
    assert lost == set(STAGE_NAMES)
    assert "died of SIGKILL in the middle of its task" in finished.err
    empty.assert_whole(like=reference)
    empty.assert_nothing_done_twice()


def test_runner_killed_while_it_renders_leaves_nobody_behind_and_the_next_one_takes_over(
    finished: Studio, reference: Studio
) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    runner = finished.start("submit", "tiny.toml")
    assert finished.wait_for_attempt(runner, ["render"]) is not None
    kill(runner)
    assert "not running" in finished.run("status", "tiny").assert_code(0).out
    taken_over = finished.submit()
    assert f"taking over from process {runner.pid}" in taken_over.err
    finished.assert_whole(like=reference)


# --- stopped ---


def interrupt_while_worker_stands_still(studio: Studio, stage: str, *, times: int) -> Finished:
    """Start the job, stop the clock of a worker of this stage, and press Ctrl-C."""
    runner = studio.start("submit", "tiny.toml")
    found = studio.wait_for_attempt(runner, [stage])
    assert found is not None
    _, worker = found
    os.kill(worker, signal.SIGSTOP)
    assert runner.stderr is not None
    said = ""
    for expected in ("stopping: what runs is finished or checkpointed", "stopping at once")[:times]:
        runner.send_signal(signal.SIGINT)
        while expected not in said:
            line = runner.stderr.readline()
            assert line, said
            said += line
    if times == 1:
        os.kill(worker, signal.SIGCONT)  # it hears of the wish to stop, and obeys
    family = [psutil.Process(worker)] if psutil.pid_exists(worker) else []
    out, err = runner.communicate(timeout=PATIENCE_S)
    assert_all_gone(family)
    return Finished(runner.returncode, out, said + err)


@pytest.mark.slow
def test_ctrl_c_once_keeps_a_checkpoint_that_the_simulation_continues_from(finished: Studio, reference: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "simulate", "--yes").assert_code(0)
    stopped = interrupt_while_worker_stands_still(finished, "simulate", times=1).assert_code(130)
    assert "continue with: pipeline resume renders/tiny" in stopped.err
    assert len(finished.artifacts()) < len(reference.artifacts())
    [checkpoint] = finished.layout.checkpoints.glob("[0-9]*.h5")
    finished.run("resume", "tiny").assert_code(0)
    assert f"starting at frame {int(checkpoint.stem)}\n" in finished.run("logs", "tiny", "simulate").out
    finished.assert_whole(like=reference)
    # The frames came out the same, so nothing that is made of them was made again.
    assert {task for task, count in finished.attempts().items() if count > 1} == {"simulate"}


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
def test_ctrl_c_while_rendering_and_the_next_run_ends_the_same(finished: Studio, reference: Studio, times: int) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    interrupt_while_worker_stands_still(finished, "render", times=times).assert_code(130)
    pictures = sum(path.startswith("frames/") for path in finished.artifacts())
    assert pictures < FRAMES
    finished.submit()
    finished.assert_whole(like=reference)
    finished.assert_nothing_done_twice()


# --- two at a time ---


@pytest.mark.slow
def test_a_second_submit_watches_the_first(finished: Studio, reference: Studio) -> None:
    finished.run("clean", "tiny", "--stage", "render", "--yes").assert_code(0)
    first = finished.start("submit", "tiny.toml")
    assert finished.wait_for_attempt(first, ["render"]) is not None
    second = finished.start("submit", "tiny.toml")
    state = json.loads(finished.run("status", "tiny", "--json").assert_code(0).out)
    assert state["runner"]["pid"] == first.pid
    assert f"running, process {first.pid}" in finished.run("status", "tiny").assert_code(0).out
    assert "is being run already" in finished.run("clean", "tiny", "--stage", "movie", "--yes").assert_code(4).err
    watched, made = finish(second).assert_code(0), finish(first).assert_code(0)
    assert f"is being run already, by process {first.pid}" in watched.err
    assert "watching it instead" in watched.err
    assert made.out.startswith("renders/tiny/movie.mp4: ")
    finished.assert_whole(like=reference)
    finished.assert_nothing_done_twice()


# --- damaged files ---

ONE_OF_EACH_KIND = (
    "cache/000002.h5",
    "frames/000003.png",
    "meshes/ball.ply",
    "movie.mp4",
    "movie/0000.mp4",
    "surfaces/water/000001.ply",
    "volumes/plume/000004.vdb",
)
THEIR_TASKS = {
    "bodies/ball",
    "movie/film",
    "movie/segment-0000",
    "render/000003",
    "simulate",
    "surface/water/000001",
    "volume/plume/000004",
}


def truncate(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def flip_a_bit_unseen(path: Path) -> None:
    """As a failing disk does: the time of modification stays."""
    status = path.stat()
    flip_a_bit(path)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def delete(path: Path) -> None:
    path.unlink()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "options", "words", "kept_aside"),
    [
        (truncate, (), "truncated", True),
        (flip_a_bit, (), "its hash differs", True),
        (flip_a_bit_unseen, ("--deep",), "its hash differs", True),
        (delete, (), "file is missing", False),
    ],
)
def test_damaged_files_are_named_and_just_they_are_made_again(
    finished: Studio,
    reference: Studio,
    damage: Callable[[Path], None],
    options: tuple[str, ...],
    words: str,
    kept_aside: bool,
) -> None:
    for artifact in ONE_OF_EACH_KIND:
        damage(finished.layout.root / artifact)
    damaged = finished.artifacts()
    attempts = finished.attempts()
    verified = finished.run("verify", "tiny", *options).assert_code(1)
    lines = verified.out.splitlines()
    assert tuple(line.partition(": ")[0] for line in lines[: len(ONE_OF_EACH_KIND)]) == ONE_OF_EACH_KIND
    assert all(words in line for line in lines[: len(ONE_OF_EACH_KIND)])
    planned = {
        each["task"]: each["reasons"]
        for each in json.loads(finished.run("plan", "tiny.toml", "--json").assert_code(0).out)
        if each["verdict"] == "stale"
    }
    assert planned.keys() == THEIR_TASKS
    assert all(len(reasons) == 1 for reasons in planned.values()), planned
    finished.submit()
    assert finished.tasks_run_since(attempts) == THEIR_TASKS
    finished.assert_whole(like=reference)
    finished.run("verify", "tiny", "--deep").assert_code(0)
    for artifact in ONE_OF_EACH_KIND:
        edited = finished.layout.root / f"{artifact}.edited-1"
        assert edited.exists() == kept_aside
        if kept_aside:
            assert edited.stat().st_size == (0 if artifact not in damaged else edited.stat().st_size) or damaged


@pytest.mark.slow
def test_a_damaged_manifest_is_made_anew_of_the_receipts(finished: Studio, reference: Studio) -> None:
    finished.layout.manifest.write_bytes(b"this is no database" * 100)
    refused = finished.run("submit", "tiny.toml").assert_code(1)
    assert "pipeline verify --rebuild" in refused.err
    finished.run("verify", "tiny", "--rebuild").assert_code(0)
    assert finished.submit().out.startswith("up to date")
    finished.assert_whole(like=reference)


# --- places that cannot be written to ---

FILL_THE_DISK = """
    mount -t tmpfs -o size={size_kb}k films "$1" || exit 99
    shift
    "$@" > first.out 2> first.err
    echo $? > first.code
    mount -o remount,size=64m films
    "$@" > second.out 2> second.err
    echo $? > second.code
    cp -a renders kept
"""


def may_mount() -> bool:
    attempt = ["unshare", "--mount", "mount", "-t", "tmpfs", "films", "/mnt"]
    return sys.platform == "linux" and os.geteuid() == 0 and subprocess.run(attempt, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(not may_mount(), reason="only root may mount a small disk, in a namespace of its own")
@pytest.mark.parametrize("size_kb", [60, 250, 700])
def test_a_full_disk_pauses_the_job_and_loses_nothing(empty: Studio, reference: Studio, size_kb: int) -> None:
    folder = empty.folder
    (folder / "renders").mkdir()
    command = [sys.executable, "-m", "pipeline", "submit", "tiny.toml"]
    script = textwrap.dedent(FILL_THE_DISK).format(size_kb=size_kb)
    subprocess.run(
        ["unshare", "--mount", "sh", "-c", script, "sh", str(folder / "renders"), *command],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(PROJECT)},
        check=True,
        timeout=2 * PATIENCE_S,
    )
    first, second = (
        Finished(
            *(
                int((folder / f"{which}.code").read_text()),
                (folder / f"{which}.out").read_text(),
                (folder / f"{which}.err").read_text(),
            )
        )
        for which in ("first", "second")
    )
    first.assert_code(7)
    assert "the disk is full (renders/tiny)" in first.err
    second.assert_code(0)
    (folder / "renders").rmdir()
    (folder / "kept").rename(folder / "renders")
    empty.assert_whole(like=reference)
    empty.assert_nothing_done_twice()


@pytest.mark.parametrize("place", ["a file", "a file/films", "/proc/films"])
def test_a_place_that_cannot_be_written_to_is_refused_in_one_line(empty: Studio, place: str) -> None:
    (empty.folder / "a file").write_text("mine")
    refused = empty.run("submit", "tiny.toml", "--output", place)
    assert refused.code in (1, 2)
    assert refused.out == ""
    [line] = [line for line in refused.err.splitlines() if line.startswith(("error: ", "Error: "))]
    assert place in line
    assert "Traceback" not in refused.err
    assert (empty.folder / "a file").read_text() == "mine"


# --- physics that goes wrong ---


@pytest.mark.slow
def test_a_simulation_that_diverges_says_where_and_a_smaller_step_mends_it(empty: Studio, reference: Studio) -> None:
    failed = empty.run("submit", "tiny.toml", "--set", "fluid.water.dt=0.02").assert_code(5)
    assert "simulate (attempt 1) diverged" in failed.err
    assert '"water"' in failed.err
    assert "frame" in failed.err
    assert [history[-1].outcome for task, history in empty.histories().items() if task == "simulate"] == ["diverged"]
    assert "upstream failed" in empty.run("status", "tiny").out
    empty.submit()
    empty.assert_whole(like=reference)


# --- a Blender of one's own ---


@pytest.fixture
def blender(tmp_path: Path) -> Path:
    """An executable with Blender's command line around this environment's own Blender, the bpy module."""
    script = tmp_path / "stand in" / "blender"
    script.parent.mkdir()
    script.write_text(
        f"#!{sys.executable}\n"
        + textwrap.dedent(
            """
            import runpy, sys
            arguments = sys.argv[1:]
            if arguments == ["--version"]:
                print("Blender 5.0.1")
                sys.exit()
            runpy.run_path(arguments[arguments.index("--python") + 1], run_name="__main__")
            """
        )
    )
    script.chmod(0o755)
    return script


@pytest.mark.slow
def test_an_external_blender_dies_with_its_runner_and_draws_the_same_pixels(
    finished: Studio, reference: Studio, blender: Path
) -> None:
    external = ("--set", f"render.blender={blender}")
    attempts = finished.attempts()
    runner = finished.start("submit", "tiny.toml", *external)
    assert finished.wait_for_attempt(runner, ["render"]) is not None
    until = time.monotonic() + PATIENCE_S
    while not any(str(blender) in process.cmdline() for process in family_of(runner)):
        assert time.monotonic() < until
        assert runner.poll() is None
        time.sleep(0.01)
    kill(runner)
    submitted = finished.submit(*external)
    assert "render" in submitted.err
    finished.assert_whole(like=reference)
    assert {stage_of(task) for task in finished.tasks_run_since(attempts)} == {"render"}
