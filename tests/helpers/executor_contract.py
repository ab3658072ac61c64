"""What executors promise: tests that the test class of each inherits, and what they are written with."""

import time
from pathlib import Path

import pytest
import synthetic_stages
from processes_seen import pid_lives
from synthetic_stages import write_faults

from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Task, TaskId
from pipeline.job.loading import load_job
from pipeline.run.events import CapacityChanged, Committed, Failed, Finished, Progress, Started, TaskEvent
from pipeline.run.executors.base import Assignment, Executor

JOB = """
name = "synthetic"
frames = 6

[[smoke]]
name = "plume"
source = [{ shape = { type = "sphere", radius = 0.1 }, position = [0.0, 0.0, 0.2] }]
"""
PATIENCE_S = 120.0  # far above the second that anything here takes, so that only a hang gets there


@pytest.fixture
def layout(tmp_path: Path) -> JobLayout:
    layout = JobLayout(tmp_path / "job")
    layout.root.mkdir()
    layout.job_file.write_text(JOB)
    return layout


def tasks_of(layout: JobLayout) -> dict[TaskId, Task]:
    job = load_job(layout.job_file)
    return {task.id: task for stage in synthetic_stages.STAGES for task in stage.plan(job, layout)}


def assign(
    layout: JobLayout, name: str, *, attempt: int = 1, threads: int = 1, timeout_s: float | None = None
) -> Assignment:
    return Assignment(
        task=tasks_of(layout)[TaskId(name)],
        attempt=attempt,
        fingerprint=f"fingerprint of {name}",
        inputs={},
        threads=threads,
        job_file=layout.job_file,
        root=layout.root,
        stages=synthetic_stages.REFERENCE,
        timeout_s=timeout_s,
    )


def events_until_end(executor: Executor, count: int = 1) -> list[TaskEvent]:
    """What is told of attempts, up to the end of `count` of them; workers may come and go meanwhile."""
    events: list[TaskEvent] = []
    until = time.monotonic() + PATIENCE_S
    while sum(isinstance(event, Finished | Failed) for event in events) < count:
        assert time.monotonic() < until, f"no end; so far {events}"
        events += [event for event in executor.wait(0.5) if not isinstance(event, CapacityChanged)]
    return events


def run(executor: Executor, assignment: Assignment) -> list[TaskEvent]:
    executor.submit(assignment)
    return events_until_end(executor)


def failure(events: list[TaskEvent]) -> Failed:
    assert isinstance(events[-1], Failed), events[-1]
    return events[-1]


def wait_for_commit(executor: Executor, artifact: str) -> None:
    until = time.monotonic() + PATIENCE_S
    while not any(isinstance(each, Committed) and each.receipt.artifact == artifact for each in executor.wait(0.5)):
        assert time.monotonic() < until


def wait_for_pid(executor: Executor, path: Path) -> int:
    until = time.monotonic() + PATIENCE_S
    while not (path.exists() and path.read_text()):
        assert time.monotonic() < until
        executor.wait(0.05)
    return int(path.read_text())


def assert_gone(pid: int) -> None:
    """The kernel delivers a kill in its own time, and a zombie that nobody has collected yet is gone, too."""
    until = time.monotonic() + PATIENCE_S
    while pid_lives(pid):
        assert time.monotonic() < until, f"{pid} is still there"
        time.sleep(0.02)


class ExecutorContract:
    """What the runner relies on; every executor's test class inherits these tests and has a fixture `executor`."""

    def test_an_attempt_starts_commits_and_finishes(self, executor: Executor, layout: JobLayout) -> None:
        events = run(executor, assign(layout, "steps"))
        assert isinstance(events[0], Started)
        assert isinstance(events[-1], Finished)
        assert events[-1].peak_memory_bytes > 10e6  # no Python with these imports is smaller
        receipts = [event.receipt for event in events if isinstance(event, Committed)]
        assert [receipt.artifact for receipt in receipts] == [f"steps/{k:06d}.bin" for k in range(6)]
        assert all(layout.path(receipt.artifact).stat().st_size == receipt.size for receipt in receipts)
        assert {receipt.fingerprint for receipt in receipts} == {"fingerprint of steps"}
        assert [event for event in events if isinstance(event, Progress)][-1].done == 6

    def test_tasks_run_one_after_another(self, executor: Executor, layout: JobLayout) -> None:
        run(executor, assign(layout, "steps"))
        for frame in range(3):
            assert isinstance(run(executor, assign(layout, f"double/{frame:06d}"))[-1], Finished)

    def test_an_exception_becomes_a_failure_with_its_traceback(self, executor: Executor, layout: JobLayout) -> None:
        write_faults(layout.root, {"steps": ["fail@2"]})
        failed = failure(run(executor, assign(layout, "steps")))
        assert (failed.kind, failed.message) == (FailureKind.FAILED, "ValueError: a fault of the task's own")
        assert "in _fail" in failed.details
        assert "in _fail" in layout.log(TaskId("steps"), 1).read_text()

    @pytest.mark.parametrize(
        ("fault", "kind"),
        [
            ("disk full", FailureKind.DISK_FULL),
            ("memory error", FailureKind.OUT_OF_MEMORY),
            ("diverge", FailureKind.DIVERGED),
        ],
    )
    def test_failures_are_told_apart(
        self, executor: Executor, layout: JobLayout, fault: str, kind: FailureKind
    ) -> None:
        write_faults(layout.root, {"steps": [fault]})
        assert failure(run(executor, assign(layout, "steps"))).kind is kind

    def test_a_failed_attempt_leaves_no_artifact_and_the_next_one_makes_it(
        self, executor: Executor, layout: JobLayout
    ) -> None:
        run(executor, assign(layout, "steps"))
        write_faults(layout.root, {"double/000000": ["fail"]})
        failure(run(executor, assign(layout, "double/000000")))
        assert list((layout.root / "double").iterdir()) == []
        assert isinstance(run(executor, assign(layout, "double/000000", attempt=2))[-1], Finished)

    def test_an_unknown_stage_is_a_failure_and_not_a_crash(self, executor: Executor, layout: JobLayout) -> None:
        broken = assign(layout, "steps")
        object.__setattr__(broken, "stages", "synthetic_stages:ABSENT")
        assert "ABSENT" in failure(run(executor, broken)).message

    def test_the_log_has_what_the_task_printed(self, executor: Executor, layout: JobLayout) -> None:
        run(executor, assign(layout, "steps", attempt=3))
        assert layout.log(TaskId("steps"), 3).read_text().startswith("steps, attempt 3, on ")

    def test_shutdown_reports_what_it_ended_and_may_be_repeated(self, executor: Executor, layout: JobLayout) -> None:
        write_faults(layout.root, {"steps": ["hang"]})
        executor.submit(assign(layout, "steps"))
        executor.shutdown()
        executor.shutdown()
        assert failure(events_until_end(executor)).kind is FailureKind.CANCELLED
        assert executor.wait(0.0) == []


class ProcessesContract(ExecutorContract):
    """What those executors promise besides whose tasks run in processes of their own."""

    def test_a_cancelled_task_may_stop_by_itself(self, executor: Executor, layout: JobLayout) -> None:
        write_faults(layout.root, {"steps": ["wait for stop@3"]})
        executor.submit(assign(layout, "steps"))
        wait_for_commit(executor, "steps/000002.bin")
        executor.cancel(TaskId("steps"), grace_s=PATIENCE_S)
        failed = failure(events_until_end(executor))
        assert failed.kind is FailureKind.CANCELLED
        # The task looks before a frame; the request comes just before or after its look at the fourth.
        assert failed.message in {"stopped after 3 of 6 outputs", "stopped after 4 of 6 outputs"}

    def test_a_task_that_does_not_stop_is_killed_with_all_it_started(
        self, executor: Executor, layout: JobLayout
    ) -> None:
        write_faults(layout.root, {"film": ["child"]})
        executor.submit(assign(layout, "film"))
        child = wait_for_pid(executor, layout.root / "child.pid")
        executor.cancel(TaskId("film"), grace_s=0.1)
        assert failure(events_until_end(executor)).kind is FailureKind.CANCELLED
        assert_gone(child)
