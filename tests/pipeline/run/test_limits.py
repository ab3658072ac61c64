"""Limits of a stage's tasks: what they end, with which evidence, and that they decide no output."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from checked_jobs import load_checked_job
from executor_contract import PATIENCE_S, assert_gone, assign, events_until_end, failure, layout, run
from memory_group import memory_group
from places import HELPERS
from synthetic_jobs import Recorder, job_text, run_synthetic
from synthetic_stages import write_faults

from pipeline.base import memory
from pipeline.base.errors import JobFileError
from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, TaskId, TaskState
from pipeline.job.loading import load_job
from pipeline.record.reader import ManifestReader
from pipeline.run.events import Failed, JobOutcome
from pipeline.run.executors import worker_process
from pipeline.run.executors.failures import classify
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor, WorkerLimits
from pipeline.stages import STAGES
from render.blender import BlenderUnavailableError, ChildRenderer, FrameRenderError

__all__ = ["layout"]


@pytest.fixture
def executor() -> Iterator[ProcessExecutor]:
    with ProcessExecutor() as executor:
        yield executor


def limited(layout: JobLayout, name: str, **limits: float) -> object:
    assignment = assign(layout, name)
    for limit, value in limits.items():
        object.__setattr__(assignment, limit, value)
    return assignment


# --- memory ---


def test_a_task_whose_child_grew_too_large_is_out_of_memory_and_its_child_gone(executor, layout):
    write_faults(layout.root, {"film": ["large child"]})
    failed = failure(run(executor, limited(layout, "film", memory_bytes=300_000_000)))
    assert failed.kind is FailureKind.OUT_OF_MEMORY
    assert "may hold 0.3 GB" in failed.message
    assert failed.peak_memory_bytes > 300e6
    assert "the runner ends this attempt: its processes held" in failed.details
    child = int((layout.root / "child.pid").read_text())
    assert f"process {child}, " in failed.details
    assert_gone(child)


def test_a_blender_that_the_kernel_killed_for_want_of_memory_is_no_lost_worker(executor, layout, monkeypatch):
    kills = iter([4, 5])  # before the task, and when it failed
    monkeypatch.setattr(worker_process, "out_of_memory_kills", lambda: next(kills))
    write_faults(layout.root, {"steps": ["lose Blender"]})
    failed = failure(run(executor, assign(layout, "steps")))
    assert failed.kind is FailureKind.OUT_OF_MEMORY
    assert "Blender is gone" in failed.message
    assert "the machine is out of memory" in failed.message


def test_idle_workers_leave_before_a_task_that_has_all_memory(executor, layout):
    run(executor, assign(layout, "steps"))
    run(executor, assign(layout, "double/000000"))
    idle = executor.worker_pids
    assert idle
    run(executor, replace(assign(layout, "film"), need=Resources(memory_bytes=memory.machine_memory_bytes())))
    assert not {*idle} & {*executor.worker_pids}


@pytest.mark.slow
def test_a_worker_that_the_kernel_kills_in_a_small_group_is_tried_once_more_and_refused(layout):
    write_faults(layout.root, {"double/000002": 2 * ["take memory at once"]})
    program = (
        "import runpy, sys, pipeline.run.executors.processes as processes\n"
        "processes._MEMORY_WATCH_S = 1.0e9  # the runner itself may see it first, and end it\n"
        "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
    )
    command = [sys.executable, "-c", program, str(HELPERS / "run_synthetic.py"), str(layout.root), "6"]
    with memory_group(600_000_000) as group:
        ended = subprocess.run(
            ["sh", "-c", 'echo $$ > "$0/cgroup.procs" && exec "$@"', str(group), *command],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == 5, ended.stderr
    with ManifestReader.open_readonly(layout.manifest) as manifest:
        attempts = manifest.history(TaskId("double/000002"))
    assert [attempt.outcome for attempt in attempts] == ["out of memory", "out of memory"]
    for attempt in attempts:
        assert re.search(r"the kernel killed worker \d+: the machine is out of memory, of 0.6 GB", attempt.message)
        assert attempt.message.endswith("; less is needed with fewer frames")


def test_a_log_that_cannot_be_read_ends_nothing(tmp_path):
    assert worker_process.log_tail(tmp_path) == ""  # a folder: an OSError, as from a shared disk whose server is away
    assert worker_process.log_tail(tmp_path / "absent") == ""


def test_a_blender_that_was_killed_otherwise_is_a_lost_worker(executor, layout):
    write_faults(layout.root, {"steps": ["lose Blender"]})
    assert failure(run(executor, assign(layout, "steps"))).kind is FailureKind.WORKER_LOST


@pytest.mark.parametrize(
    ("end", "kind"), [("os.kill(os.getpid(), 9)", FailureKind.WORKER_LOST), ("sys.exit(1)", FailureKind.FAILED)]
)
def test_a_blender_that_is_killed_while_it_starts_is_lost_and_one_that_refuses_is_not(tmp_path, end, kind):
    blender = tmp_path / "blender"
    blender.write_text(
        f"#!{sys.executable}\nimport os, sys\nif sys.argv[1:] != ['--version']:\n    {end}\nprint('Blender 5.0.1')\n"
    )
    blender.chmod(0o755)
    with pytest.raises(BlenderUnavailableError) as refused:
        ChildRenderer(tmp_path / "scene.json", threads=1, blender=str(blender))
    assert classify(refused.value) is kind


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("CUDA Error CUDA_ERROR_OUT_OF_MEMORY: out of memory while calling malloc_async_impl"),
        FrameRenderError(3, "System is out of GPU memory"),
    ],
)
def test_libraries_that_run_out_of_memory_are_understood(error):
    assert classify(error) is FailureKind.OUT_OF_MEMORY


def test_a_process_tree_has_the_grandchildren_and_their_memory():
    grandchild = "import time; held = bytearray(b'x') * 60_000_000; print('held', flush=True); time.sleep(600)"
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {grandchild!r}])"
    process = subprocess.Popen([sys.executable, "-c", child], stdout=subprocess.PIPE, start_new_session=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        tree = memory.process_tree(process.pid)
        assert tree == [process.pid, *(each.pid for each in psutil.Process(process.pid).children(recursive=True))]
        assert len(tree) == 2
        assert memory.tree_memory_bytes(process.pid) > 60e6
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
    assert memory.tree_memory_bytes(process.pid) == 0


def test_a_containers_memory_is_what_its_control_group_leaves(tmp_path, monkeypatch):
    inner = tmp_path / "inner"
    inner.mkdir()
    monkeypatch.setattr(memory, "_control_groups", lambda: [inner, tmp_path])
    assert memory.machine_memory_bytes() == psutil.virtual_memory().total
    (inner / "memory.max").write_text("max\n")
    (tmp_path / "memory.max").write_text("100000000\n")
    assert memory.machine_memory_bytes() == 100_000_000


# --- stalls and timeouts ---


def test_a_stalled_task_is_ended_with_its_processes_and_stacks_in_its_log(executor, layout):
    write_faults(layout.root, {"film": ["child"]})
    # Longer than a worker takes to start on a busy machine, which shows no sign of life.
    failed = failure(run(executor, limited(layout, "film", stall_s=5.0)))
    assert (failed.kind, failed.message) == (
        FailureKind.STALLED,
        "no sign of life for 5 s, which is limits.film.stall_s; the log shows where it hung",
    )
    log = layout.log(TaskId("film"), 1).read_text()
    assert "the runner ends this attempt: no sign of life for 5 s" in log
    assert f"process {int((layout.root / 'child.pid').read_text())}, sleeping" in log
    assert "in _start_child_and_hang" in log


def test_a_worker_that_was_stopped_from_outside_is_ended_as_stalled_and_the_log_says_that_it_was_stopped(
    executor, layout
):
    write_faults(layout.root, {"film": ["hang"]})
    executor.submit(limited(layout, "film", stall_s=15.0))
    until = time.monotonic() + PATIENCE_S
    while not (layout.root / "used_faults" / "film").exists():  # it is about to hang
        assert time.monotonic() < until
        executor.wait(0.05)
    [worker] = executor.worker_pids
    os.kill(worker, signal.SIGSTOP)
    assert failure(events_until_end(executor)).kind is FailureKind.STALLED
    log = layout.log(TaskId("film"), 1).read_text()
    assert f"process {worker}, stopped" in log
    assert "in apply_fault" in log


# --- in the job file ---


def run_with(root: Path, limits: str, **options: object) -> tuple[object, Recorder]:
    recorder = Recorder()
    with ProcessExecutor(WorkerLimits(workers=2)) as executor:
        return run_synthetic(root, executor, job_text() + limits, observers=[recorder.notify], **options), recorder


def test_a_frame_that_takes_too_long_fails_and_the_others_go_on(tmp_path):
    write_faults(tmp_path / "job", {"double/000002": ["hang"]})
    outcome, recorder = run_with(tmp_path / "job", "[limits.double]\ntimeout_s = 15\nattempts = 1\n")
    assert outcome.kind is JobOutcome.FAILED
    assert [(each.task_id, each.kind) for each in outcome.failures] == [("double/000002", FailureKind.TIMED_OUT)]
    assert outcome.counts["double", TaskState.SUCCEEDED] == 5
    assert outcome.counts["film", TaskState.UPSTREAM_FAILED] == 1
    assert len(recorder.of(Failed)) == 1


def test_a_stage_says_how_often_its_tasks_are_tried(tmp_path):
    write_faults(tmp_path / "job", {"double/000001": ["segfault"] * 4, "film": ["segfault"] * 2})
    outcome, recorder = run_with(tmp_path / "job", "[limits.double]\nattempts = 5\n")
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert [each.task_id for each in recorder.of(Failed)].count("double/000001") == 4


def test_a_stage_says_which_share_of_failures_stops_the_job(tmp_path):
    write_faults(tmp_path / "job", {f"double/{k:06d}": ["fail"] for k in range(6)})
    with InlineExecutor() as executor:
        outcome = run_synthetic(
            tmp_path / "job",
            executor,
            job_text() + "[limits.double]\nfailure_count = 2\nfailure_share = 0.5\n",
            capacity=Resources(cores=1),
        )
    assert (outcome.kind, len(outcome.failures)) == (JobOutcome.TOO_MANY_FAILURES, 2)


def test_limits_rerun_nothing(tmp_path):
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "job", executor)
        limits = "".join(f"[limits.{stage}]\ntimeout_s = 600\nmemory_gb = 2\n" for stage in ("steps", "double"))
        assert run_synthetic(tmp_path / "job", executor, job_text() + limits).ran == 0


def test_limits_are_in_no_fingerprint_of_any_stage(tmp_path):
    (tmp_path / "plain.toml").write_text(job_text())
    limits = "".join(f"[limits.{stage.name}]\ntimeout_s = 600\nattempts = 7\n" for stage in STAGES)
    (tmp_path / "limited.toml").write_text(job_text() + limits)
    plain, with_limits = (
        [
            task
            for stage in STAGES
            if not stage.on_demand
            for task in stage.plan(load_job(tmp_path / name), JobLayout(tmp_path))
        ]
        for name in ("plain.toml", "limited.toml")
    )
    assert [task.parameters for task in plain] == [task.parameters for task in with_limits]


@pytest.mark.parametrize(
    ("limits", "complaint"),
    [
        ("[limits.rendr]", 'no stage is named "rendr"; did you mean "render"?'),
        ("[limits.double]\nattempts = 2", 'no stage is named "double"'),
        ("[limits.render]\nattempts = 0", "must be >= 1"),
        ("[limits.render]\ntimeout = 5", "timeout_s"),
    ],
)
def test_limits_of_what_is_no_stage_or_no_limit_are_refused(tmp_path, limits, complaint):
    (tmp_path / "job.toml").write_text(job_text() + limits)
    with pytest.raises(JobFileError) as refused:
        load_checked_job(tmp_path / "job.toml")
    assert complaint in str(refused.value)
