"""Killed anywhere, as often as you like: the next run continues, and the bytes are those of an undisturbed run."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from farm_processes import wait_until
from places import HELPERS
from processes_seen import lives
from synthetic_jobs import contents, job_text, run_synthetic
from synthetic_stages import write_faults

from pipeline.base.layout import JobLayout
from pipeline.base.lease import read_holder
from pipeline.record.manifest import Manifest
from pipeline.record.reader import SUCCEEDED
from pipeline.run.executors.inline import InlineExecutor

FRAMES = 12
ARTIFACTS = 2 * FRAMES + 1
PATIENCE_S = 60.0  # a run takes a few seconds; only a hang gets there


def start_runner(root: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(HELPERS / "run_synthetic.py"), str(root), str(FRAMES)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def committed(root: Path) -> int:
    return sum(1 for _ in JobLayout(root).receipts.rglob("*.bin.json"))


def wait_for_artifacts(root: Path, count: int, runner: subprocess.Popen[str]) -> None:
    until = time.monotonic() + PATIENCE_S
    while committed(root) < count and runner.poll() is None:
        assert time.monotonic() < until, f"{committed(root)} of {count} artifacts"
        time.sleep(0.005)  # so that the kill comes at that artifact, and not some later


def wait_for_child(root: Path) -> None:
    pid = root / "child.pid"
    wait_until(lambda: pid.exists() and pid.read_text() != "", "no child was ever started")


def workers_of(runner: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(runner.pid).children()


def assert_all_gone(processes: list[psutil.Process]) -> None:
    wait_until(lambda: not any(map(lives, processes)), f"still there: {processes}")


def assert_like_undisturbed(root: Path, tmp_path: Path) -> None:
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "undisturbed", executor, job_text(frames=FRAMES))
    assert contents(root) == contents(tmp_path / "undisturbed")
    assert list(root.rglob(".*.part.*")) == []
    with Manifest(JobLayout(root).manifest) as manifest:
        assert len(manifest.artifacts()) == ARTIFACTS
        for task in manifest.states():
            outcomes = [attempt.outcome for attempt in manifest.history(task)]
            # Nothing is tried again after it succeeded. (A success whose runner was killed before it could note it
            # stands as lost, but its artifact was adopted.)
            assert SUCCEEDED not in outcomes[:-1], f"{task}: {outcomes}"


def disturb(root: Path, seed: int, kills: int) -> list[str]:
    """Kill the runner or a worker, as chance has it, each time that one of so many numbers of artifacts is reached.

    Returns who was killed, in order.
    """
    killed = []
    chance = random.Random(seed)
    write_faults(root, {}, pause_s=0.01)
    runner = start_runner(root)
    for count in sorted(chance.sample(range(ARTIFACTS - 1), kills)):
        wait_for_artifacts(root, count, runner)
        if runner.poll() is not None:
            break
        workers = workers_of(runner)
        if workers and chance.random() < 0.5:
            chance.choice(workers).kill()
            killed.append("worker")
            continue
        killed.append("runner")
        runner.send_signal(signal.SIGKILL)
        runner.communicate()
        assert_all_gone(workers)
        runner = start_runner(root)
    output, _ = runner.communicate(timeout=PATIENCE_S)
    assert runner.returncode == 0, output
    return killed


def test_killed_at_random_moments_a_job_ends_like_an_undisturbed_one(tmp_path):
    assert {"runner", "worker"} <= set(disturb(tmp_path / "job", seed=1, kills=4))
    assert_like_undisturbed(tmp_path / "job", tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_killed_at_every_artifact_a_job_ends_like_an_undisturbed_one(tmp_path, seed):
    assert len(disturb(tmp_path / "job", seed=seed, kills=ARTIFACTS - 1)) >= 12
    assert_like_undisturbed(tmp_path / "job", tmp_path)


def test_a_killed_runner_takes_its_workers_with_it_and_its_lease_is_taken_over(tmp_path):
    root = tmp_path / "job"
    write_faults(root, {"film": ["child"]})
    runner = start_runner(root)
    wait_for_child(root)
    family = psutil.Process(runner.pid).children(recursive=True)
    assert int((root / "child.pid").read_text()) in {process.pid for process in family}
    runner.kill()
    runner.communicate()
    assert_all_gone(family)
    holder = read_holder(JobLayout(root).lease)
    assert holder is not None
    assert holder.pid == runner.pid
    second = start_runner(root)
    output, _ = second.communicate(timeout=PATIENCE_S)
    assert second.returncode == 0, output
    assert f"taking over from process {runner.pid}" in output
    assert_like_undisturbed(root, tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_signal_drains_the_runner_and_the_next_run_continues(tmp_path, number):
    root = tmp_path / "job"
    write_faults(root, {}, pause_s=0.1)
    runner = start_runner(root)
    wait_for_artifacts(root, 3, runner)
    runner.send_signal(number)
    output, _ = runner.communicate(timeout=PATIENCE_S)
    assert runner.returncode == 130, output
    assert "stopping: what runs is finished or checkpointed" in output
    assert 3 <= committed(root) < ARTIFACTS
    write_faults(root, {})
    assert start_runner(root).wait(timeout=PATIENCE_S) == 0
    assert_like_undisturbed(root, tmp_path)


def test_temporary_files_of_workers_go_although_the_runner_was_killed(tmp_path, monkeypatch):
    root, temporary = tmp_path / "job", tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    write_faults(root, {"film": ["temporary files and hang"]})
    runner = start_runner(root)
    wait_for_child(root)
    assert Path((root / "temporary").read_text()).is_relative_to(temporary)
    family = psutil.Process(runner.pid).children(recursive=True)
    runner.kill()
    runner.communicate()
    assert_all_gone(family)
    wait_until(lambda: not list(temporary.iterdir()), "temporary files are left")
