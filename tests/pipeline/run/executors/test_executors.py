"""The executors of one machine: the contract of all, and what the one with processes promises besides."""

import errno
import os
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from executor_contract import (
    PATIENCE_S,
    ExecutorContract,
    ProcessesContract,
    assert_gone,
    assign,
    events_until_end,
    failure,
    layout,
    run,
    wait_for_pid,
)
from processes_seen import pid_lives
from refused_removal import refuse_removal
from synthetic_stages import write_faults

from pipeline.base.errors import InvalidArtifactError, StageUnavailableError
from pipeline.base.memory import read_oom_kills
from pipeline.base.task import FailureKind, Resources, TaskId
from pipeline.run.events import Committed, ExecutorEvent, Failed, Finished, GpuWithdrawn, Progress, Started, TaskEvent
from pipeline.run.executors.base import Assignment, Executor
from pipeline.run.executors.failures import classify
from pipeline.run.executors.inline import InlineExecutor
from pipeline.run.executors.processes import ProcessExecutor, WorkerLimits
from render.blender import BlenderDiedError, FrameRenderError
from sim.core.runtime import DeviceUnavailableError
from sim.core.solver import OutgrownError

__all__ = ["layout"]


class TestInline(ExecutorContract):
    @pytest.fixture
    def executor(self) -> Iterator[Executor]:
        with InlineExecutor() as executor:
            yield executor

    def test_a_cancelled_task_does_not_run(self, executor, layout):
        executor.submit(assign(layout, "steps"))
        executor.cancel(TaskId("steps"), grace_s=1.0)
        assert failure(events_until_end(executor)).kind is FailureKind.CANCELLED
        assert not (layout.root / "steps").exists()


class TestProcesses(ProcessesContract):
    @pytest.fixture
    def executor(self) -> Iterator[ProcessExecutor]:
        executor = ProcessExecutor()
        yield executor
        pids = executor.worker_pids
        executor.shutdown()
        assert executor.worker_pids == []
        assert not any(psutil.pid_exists(pid) for pid in pids)

    def test_shutdown_does_not_wait_for_a_process_that_cannot_end(self, executor, layout, monkeypatch):
        # As one in a call to a network file system that does not answer: signals reach it only afterwards.
        monkeypatch.setattr("pipeline.run.executors.processes._RETIRE_GRACE_S", 0.1)
        monkeypatch.setattr("pipeline.run.executors.processes._DEATH_S", 0.1)
        write_faults(layout.root, {"steps": ["hang"]})
        executor.submit(assign(layout, "steps"))
        while not any(isinstance(event, Started) for event in executor.wait(PATIENCE_S)):
            pass
        (pid,) = executor.worker_pids
        with monkeypatch.context() as patch:
            patch.setattr("os.killpg", lambda *_: None)
            executor.shutdown()
        assert failure(executor.wait(0.0)).kind is FailureKind.CANCELLED
        assert not executor.worker_pids
        os.killpg(pid, signal.SIGKILL)
        assert_gone(pid)

    @pytest.mark.parametrize(
        ("fault", "sentence"),
        [
            ("half a message", "exited with code 1"),
            pytest.param("kill", "died of SIGKILL", marks=pytest.mark.slow),
            pytest.param("exit", "exited with code 7", marks=pytest.mark.slow),
        ],
    )
    def test_a_lost_worker_costs_its_own_task_only(self, executor, layout, fault, sentence):
        write_faults(layout.root, {"steps": [f"{fault}@2"]})
        failed = failure(run(executor, assign(layout, "steps")))
        assert failed.kind is FailureKind.WORKER_LOST
        assert sentence in failed.message
        assert isinstance(run(executor, assign(layout, "steps", attempt=2))[-1], Finished)

    def test_a_segfault_leaves_its_stack_in_the_log(self, executor, layout):
        write_faults(layout.root, {"steps": ["segfault"]})
        failed = failure(run(executor, assign(layout, "steps")))
        assert "died of SIGSEGV" in failed.message
        assert "in _segfault" in failed.details

    def test_a_lost_worker_leaves_its_neighbour_alone(self, executor, layout):
        run(executor, assign(layout, "steps"))
        write_faults(layout.root, {"double/000000": ["kill"]}, pause_s=0.2)
        executor.submit(assign(layout, "double/000000"))
        executor.submit(assign(layout, "double/000001"))
        ends = {
            event.task_id: type(event)
            for event in events_until_end(executor, 2)
            if isinstance(event, Finished | Failed)
        }
        assert ends == {"double/000000": Failed, "double/000001": Finished}

    def test_what_c_prints_is_in_the_log(self, executor, layout):
        write_faults(layout.root, {"steps": ["puts"]})
        run(executor, assign(layout, "steps"))
        executor.shutdown()
        assert "a line from C" in layout.log(TaskId("steps"), 1).read_text()

    def test_a_warm_worker_is_kept_for_its_stage_and_replaced_when_worn_out(self, layout):
        with ProcessExecutor(WorkerLimits(tasks_per_worker=2)) as executor:
            run(executor, assign(layout, "steps"))
            starts = [run(executor, assign(layout, f"double/{frame:06d}"))[0] for frame in range(4)]
        pids = [event.pid for event in starts if isinstance(event, Started)]
        assert pids[0] == pids[1] != pids[2] == pids[3]

    def test_stages_that_take_turns_keep_their_workers_even_on_one_core(self, layout, monkeypatch):
        monkeypatch.setattr("os.cpu_count", lambda: 1)
        with ProcessExecutor() as executor:
            run(executor, assign(layout, "steps"))
            pids: dict[int, set[int]] = {1: set(), 2: set()}  # by number of threads: workers as unlike as of two stages
            for frame in range(3):
                for threads, workers in pids.items():
                    started = run(executor, assign(layout, f"double/{frame:06d}", threads=threads))[0]
                    assert isinstance(started, Started)
                    workers.add(started.pid)
        assert [len(workers) for workers in pids.values()] == [1, 1]

    @pytest.mark.slow
    def test_a_worker_that_grew_too_large_is_replaced(self, layout):
        with ProcessExecutor(WorkerLimits(resident_memory_bytes=1)) as executor:
            run(executor, assign(layout, "steps"))
            starts = [run(executor, assign(layout, f"double/{frame:06d}"))[0] for frame in range(2)]
        pids = [event.pid for event in starts if isinstance(event, Started)]
        assert pids[0] != pids[1]

    def test_idle_workers_make_room_for_another_stage(self, layout):
        with ProcessExecutor(WorkerLimits(workers=1)) as executor:
            run(executor, assign(layout, "steps"))
            run(executor, assign(layout, "double/000000"))
            run(executor, assign(layout, "double/000001", threads=2))
            staying = [pid for pid in executor.worker_pids if pid_lives(pid)]
            assert len(staying) <= 2  # the new one, and perhaps one that is on its way out

    def test_what_a_task_left_running_ends_with_its_worker(self, executor, layout):
        write_faults(layout.root, {"steps": ["leave child@0"]})
        assert isinstance(run(executor, assign(layout, "steps"))[-1], Finished)
        executor.shutdown()
        assert_gone(wait_for_pid(executor, layout.root / "child.pid"))

    def test_what_a_lost_worker_had_started_dies_with_it(self, executor, layout):
        write_faults(layout.root, {"film": ["child"]})
        executor.submit(assign(layout, "film"))
        child = wait_for_pid(executor, layout.root / "child.pid")
        os.kill(executor.worker_pids[0], signal.SIGKILL)
        assert failure(events_until_end(executor)).kind is FailureKind.WORKER_LOST
        assert_gone(child)

    @pytest.mark.parametrize("fault", ["temporary files", "temporary files and kill", "temporary files and hang"])
    def test_temporary_files_of_a_worker_go_with_it(self, layout, tmp_path, monkeypatch, fault):
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
        (tmp_path / "temporary").mkdir()
        write_faults(layout.root, {"film": [fault]})
        with ProcessExecutor() as executor:
            for name in ("steps", *(f"double/{frame:06d}" for frame in range(6))):
                run(executor, assign(layout, name))
            for environment in (psutil.Process(pid).environ() for pid in executor.worker_pids):
                assert environment["TMP"] == environment["TMPDIR"]  # Blender up to 4.5 asks the first before the second
            executor.submit(assign(layout, "film"))
            if fault.endswith("hang"):
                wait_for_pid(executor, layout.root / "child.pid")
                executor.cancel(TaskId("film"), grace_s=0.0)
            events_until_end(executor)
            folder = Path((layout.root / "temporary").read_text())
            assert folder.is_relative_to(tmp_path / "temporary")
            assert folder.exists() == (fault == "temporary files")  # whose worker is kept
        assert list((tmp_path / "temporary").iterdir()) == []

    def test_a_full_disk_of_temporary_files_is_named_where_no_worker_can_be_started(self, layout, monkeypatch):
        def full(**_options: object) -> str:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/temporary/pipeline-worker-1")

        monkeypatch.setattr("render.temporary_folder.mkdtemp", full)
        with ProcessExecutor() as executor:
            failed = failure(run(executor, assign(layout, "steps")))
        assert (failed.kind, failed.full_place) == (FailureKind.DISK_FULL, "/temporary/pipeline-worker-1")

    def test_a_temporary_folder_that_cannot_be_removed_costs_no_run(self, layout, tmp_path, monkeypatch):
        temporary = tmp_path / "temporary"
        temporary.mkdir()
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        with ProcessExecutor() as executor:
            run(executor, assign(layout, "steps"))
            refuse_removal(monkeypatch, temporary)

    def test_a_task_has_a_time_limit(self, executor, layout):
        write_faults(layout.root, {"film": ["hang"]})
        failed = failure(run(executor, assign(layout, "film", timeout_s=2.0)))
        assert (failed.kind, failed.message) == (
            FailureKind.TIMED_OUT,
            "not done after 2 s, which is limits.film.timeout_s; the log shows where it was",
        )

    def test_what_is_prepared_once_is_ended_neither_as_stalled_nor_by_the_time_limit_that_counts_after_it(self, layout):
        with ProcessExecutor() as executor:
            run(executor, assign(layout, "steps"))
            run(executor, assign(layout, "double/000000"))  # the worker is there: its start takes no time of the next
            write_faults(layout.root, {"double/000001": ["prepare"], "double/000002": ["prepare and hang"]})
            executor.submit(replace(assign(layout, "double/000001", timeout_s=2.0), stall_s=2.0))
            events = events_until_end(executor)
            assert Progress(TaskId("double/000001"), 1, 0, 1, "compiling", preparing=True) in events
            assert isinstance(events[-1], Finished), events[-1]
            failed = failure(run(executor, assign(layout, "double/000002", timeout_s=2.0)))
        assert failed.kind is FailureKind.TIMED_OUT

    def test_each_task_on_a_gpu_has_one_for_itself_and_its_worker_stays_with_that(self, layout):
        def on_gpu(name: str) -> Assignment:
            return replace(assign(layout, name), need=Resources(gpus=1))

        def workers(events: list[TaskEvent]) -> list[int]:
            started = {event.task_id: event.pid for event in events if isinstance(event, Started)}
            return [started[task_id] for task_id in sorted(started)]

        with ProcessExecutor() as executor:
            run(executor, assign(layout, "steps"))
            write_faults(layout.root, {}, pause_s=1.0)
            executor.submit(on_gpu("double/000000"))
            executor.submit(on_gpu("double/000001"))
            first, second = workers(events_until_end(executor, 2))
            assert executor.worker_gpus == {first: 0, second: 1}
            assert workers(run(executor, on_gpu("double/000002"))) == [first]
            assert workers(run(executor, assign(layout, "double/000003"))) not in ([first], [second])

    @pytest.mark.parametrize("fault", ["lose GPU", "lose GPU and abort"])
    def test_a_gpu_that_fails_a_task_gets_no_other(self, layout, fault):
        def on_gpu(name: str, attempt: int = 1) -> Assignment:
            return replace(assign(layout, name, attempt=attempt), need=Resources(gpus=1))

        with ProcessExecutor(gpus=2) as executor:
            run(executor, assign(layout, "steps"))
            run(executor, on_gpu("double/000001"))
            (idle,) = executor.worker_gpus.items()
            assert idle[1] == 1
            write_faults(layout.root, {"double/000000": [fault, fault]})
            withdrawn, failed = _end_of(executor, on_gpu("double/000000"))
            assert isinstance(withdrawn, GpuWithdrawn) and withdrawn.left == 1
            assert failure([failed]).kind is FailureKind.GPU_ERROR
            assert set(executor.worker_gpus.values()) <= {1}  # one that is on its way out
            (finished,) = _end_of(executor, on_gpu("double/000001", 2))
            assert isinstance(finished, Finished)
            assert 0 in executor.worker_gpus.values()
            withdrawn, failed = _end_of(executor, on_gpu("double/000000", 2))
            assert isinstance(withdrawn, GpuWithdrawn) and withdrawn.left == 0
            assert failure([failed]).kind is FailureKind.GPU_ERROR
            assert failure(run(executor, on_gpu("double/000002"))).kind is FailureKind.GPU_ERROR
        with ProcessExecutor(gpus=1) as another_run:
            assert isinstance(run(another_run, on_gpu("double/000000", 3))[-1], Finished)

    @pytest.mark.slow
    def test_sigterm_from_outside_lets_the_task_stop_and_the_worker_leave(self, executor, layout):
        write_faults(layout.root, {"steps": ["wait for stop@1"]})
        executor.submit(assign(layout, "steps"))
        while not any(isinstance(event, Committed) for event in executor.wait(0.5)):
            pass
        os.kill(executor.worker_pids[0], signal.SIGTERM)
        assert failure(events_until_end(executor)).kind is FailureKind.CANCELLED

    def test_threads_of_native_libraries_are_limited(self, executor, layout):
        write_faults(layout.root, {"film": ["hang"]})
        executor.submit(assign(layout, "film", threads=3))
        assert any(isinstance(event, Started) for event in executor.wait(PATIENCE_S))
        environment = psutil.Process(executor.worker_pids[0]).environ()
        assert (environment["OMP_NUM_THREADS"], environment["OPENBLAS_NUM_THREADS"]) == ("3", "1")

    def test_a_long_assignment_does_not_block_the_supervisor(self, executor, layout):
        """Larger than any socket buffer, to a worker that has not begun to read."""
        large = assign(layout, "steps")
        object.__setattr__(large, "inputs", {f"double/{k:06d}.bin": "0" * 64 for k in range(50_000)})
        assert isinstance(run(executor, large)[-1], Finished)


def _end_of(executor: Executor, assignment: Assignment) -> list[ExecutorEvent]:
    """How an attempt ended, and what was told of the machine."""
    executor.submit(assignment)
    told: list[ExecutorEvent] = []
    until = time.monotonic() + PATIENCE_S
    while not any(isinstance(event, Finished | Failed) for event in told):
        assert time.monotonic() < until
        told += executor.wait(0.5)
    return [event for event in told if isinstance(event, Finished | Failed | GpuWithdrawn)]


def test_kills_for_want_of_memory_are_counted(tmp_path):
    events = tmp_path / "memory.events"
    events.write_text("low 0\nhigh 3\nmax 12\noom 2\noom_kill 1\noom_group_kill 0\n")
    assert read_oom_kills(events) == 1
    assert read_oom_kills(tmp_path / "absent") is None


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(errno.EDQUOT, "quota"), FailureKind.DISK_FULL),
        (OSError("unable to write: error message = 'No space left on device'"), FailureKind.DISK_FULL),
        (FileNotFoundError(errno.ENOENT, "absent"), FailureKind.FAILED),
        (OutgrownError("80 cells need more than there is"), FailureKind.OUTGROWN),
        (OSError(errno.ESTALE, "the server has started anew"), FailureKind.WORKER_LOST),
        (TimeoutError(errno.ETIMEDOUT, "the server does not answer"), FailureKind.WORKER_LOST),
        (TimeoutError("a task's own"), FailureKind.FAILED),
        (StageUnavailableError("no Blender"), FailureKind.FAILED),
        (FrameRenderError(3, "the mesh is broken"), FailureKind.FAILED),
        (BlenderDiedError(3, -9, "(it wrote nothing)"), FailureKind.WORKER_LOST),
        (BlenderDiedError(3, -6, "Illegal address in CUDA queue copy_from_device"), FailureKind.GPU_ERROR),
        (FrameRenderError(3, "Error: OPTIX_ERROR_UNKNOWN in optixLaunch (...)"), FailureKind.GPU_ERROR),
        (FrameRenderError(3, "Launch failed in cuCtxSynchronize()"), FailureKind.GPU_ERROR),
        (RuntimeError("[...] CUDA Error CUDA_ERROR_ECC_UNCORRECTABLE: ..."), FailureKind.GPU_ERROR),
        (RuntimeError("[...] CUDA Error CUDA_ERROR_OUT_OF_MEMORY: out of memory"), FailureKind.OUT_OF_MEMORY),
        (DeviceUnavailableError("cuda", "its driver ends the process"), FailureKind.GPU_ERROR),
        (DeviceUnavailableError("cpu", "Taichi does not load"), FailureKind.FAILED),
        (RuntimeError("a value in cube(3)"), FailureKind.FAILED),
    ],
)
def test_exceptions_are_classified_with_what_is_behind_them(error, kind):
    assert classify(error) is kind
    try:
        raise InvalidArtifactError("not written") from error
    except InvalidArtifactError as outer:
        assert classify(outer) is kind
