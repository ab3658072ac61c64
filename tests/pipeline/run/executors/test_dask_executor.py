"""The executor on a Dask cluster: the contract of all executors, and what a cluster's losses cost."""

import asyncio
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from dask_processes import HOST, free_port, running, start_scheduler, start_worker
from distributed import Client
from executor_contract import (
    PATIENCE_S,
    ProcessesContract,
    assert_gone,
    assign,
    events_until_end,
    failure,
    layout,
    run,
    wait_for_commit,
    wait_for_pid,
)
from processes_seen import words_of
from synthetic_jobs import contents, run_synthetic
from synthetic_stages import write_faults

from pipeline.base.layout import JobLayout
from pipeline.base.task import FailureKind, Resources, TaskId
from pipeline.run.events import (
    CapacityChanged,
    Committed,
    ExecutorEvent,
    Failed,
    Finished,
    JobOutcome,
    Outcome,
    RunEvent,
    Started,
)
from pipeline.run.executors.choice import ExecutorChoice, open_machines
from pipeline.run.executors.dask import ClusterError, DaskExecutor
from pipeline.run.executors.dask_connection import Connection
from pipeline.run.executors.dask_local import local_cluster
from pipeline.run.executors.inline import InlineExecutor

__all__ = ["layout"]

START_PATIENCE_S = 150.0
"""Interpreters with all of Dask take seconds to start, and much longer where a machine does other things as well."""

SHARE = Resources(cores=1, memory_bytes=4_000_000_000)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    with local_cluster([SHARE, SHARE]) as address:
        yield address


def _dask_workers() -> list[psutil.Process]:
    """The processes of the module's cluster."""
    children = psutil.Process().children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(words_of(child))]


def test_a_cluster_of_this_machine_listens_to_this_machine_only(cluster):
    assert len(_dask_workers()) == 2
    listening = {
        connection.laddr.ip
        for process in (psutil.Process(), *_dask_workers())
        for connection in process.net_connections("tcp")
        if connection.status == psutil.CONN_LISTEN
    }
    assert listening == {HOST}


class TestDask(ProcessesContract):
    @pytest.fixture
    def executor(self, cluster, layout) -> Iterator[DaskExecutor]:
        with DaskExecutor(cluster, layout.root, of_runner=True) as executor:
            yield executor

    def test_tasks_run_side_by_side_on_all_workers(self, executor, layout):
        run(executor, assign(layout, "steps"))
        frames = [TaskId(f"double/{frame:06d}") for frame in range(3)]
        write_faults(layout.root, {frame: ["wait for stop"] for frame in frames})
        for frame in frames:
            executor.submit(assign(layout, frame))
        two = _until_started(executor, 2)
        # Two at once, and the third waits for room.
        assert sorted(each.task_id for each in two) == frames[:2]
        executor.cancel(frames[0], grace_s=PATIENCE_S)
        ended, *_, third = _until_started(executor, 1)
        assert (ended.task_id, third.task_id) == (frames[0], frames[2])
        for frame in frames[1:]:
            executor.cancel(frame, grace_s=PATIENCE_S)
        assert {each.task_id for each in events_until_end(executor, 2) if isinstance(each, Finished | Failed)} == {
            *frames[1:]
        }

    def test_ctrl_c_at_the_terminal_is_the_runners_business(self, executor, layout):
        write_faults(layout.root, {}, pause_s=0.3)
        executor.submit(assign(layout, "steps"))
        wait_for_commit(executor, "steps/000000.bin")
        for process in _dask_workers():
            process.send_signal(signal.SIGINT)
        assert isinstance(events_until_end(executor)[-1], Finished)

    def test_no_process_of_the_job_outlives_the_run(self, cluster, layout):
        with DaskExecutor(cluster, layout.root, of_runner=True) as executor:
            started = run(executor, assign(layout, "steps"))[0]
        assert isinstance(started, Started)
        assert_gone(started.pid)

    def test_a_killed_dask_worker_takes_its_children_with_it_and_the_task_runs_elsewhere(self, executor, layout):
        write_faults(layout.root, {"film": ["child"]})
        executor.submit(assign(layout, "film"))
        started = _wait_for_start(executor)
        child = wait_for_pid(executor, layout.root / "child.pid")
        dask_worker = psutil.Process(started.pid).parent()
        assert dask_worker is not None
        dask_worker.kill()
        assert failure(events_until_end(executor)).kind is FailureKind.WORKER_LOST
        assert_gone(child)
        assert_gone(started.pid)
        write_faults(layout.root, {"steps": ["wait for stop"]})
        executor.submit(assign(layout, "steps", attempt=2))
        parent = psutil.Process(_wait_for_start(executor).pid).parent()
        assert parent is not None
        assert parent.pid != dask_worker.pid
        executor.cancel(TaskId("steps"), grace_s=PATIENCE_S)
        assert failure(events_until_end(executor)).kind is FailureKind.CANCELLED


# --- machines that come and go ---


@pytest.fixture
def port() -> Iterator[int]:
    """Of a Dask scheduler that runs; use `start_worker(port)`."""
    port = free_port()
    with running(start_scheduler(port)):
        yield port


def test_machines_that_come_and_go_are_told(port, layout):
    with running(start_worker(port)), _executor(port, layout.root) as executor:
        assert executor.capacity == executor.machine == Resources(cores=1, memory_bytes=4_000_000_000)
        with running(start_worker(port, "CPU=3 MEM=1e9 GPU=1")):
            _wait_for(executor, CapacityChanged(Resources(cores=4, memory_bytes=5_000_000_000, gpus=1)))
        _wait_for(executor, CapacityChanged(Resources(cores=1, memory_bytes=4_000_000_000)))


def test_a_task_for_a_gpu_runs_where_there_is_one(port, layout):
    with (
        running(start_worker(port, "CPU=1 GPU=1")) as gifted,
        _executor(port, layout.root) as executor,
        running(start_worker(port, "CPU=8")),
    ):
        _wait_for_cores(executor, 9)
        write_faults(layout.root, {"steps": ["wait for stop"]})
        executor.submit(replace(assign(layout, "steps"), need=Resources(gpus=1)))
        parent = psutil.Process(_wait_for_start(executor).pid).parent()
        assert parent is not None
        assert parent.pid == gifted.pid


def test_a_worker_that_loses_its_gpu_hands_its_task_back_and_gets_no_other_one(port, layout):
    told: list[str] = []
    on_gpu = Resources(cores=1, gpus=1)
    with (
        running(start_worker(port, "CPU=1 GPU=1")),
        running(start_worker(port, "CPU=1 GPU=1")),
        DaskExecutor(f"tcp://{HOST}:{port}", layout.root, patience_s=START_PATIENCE_S, say=told.append) as executor,
    ):
        _wait_for_cores(executor, 2)
        write_faults(layout.root, {"steps": ["lose GPU"]})
        parents = set()
        for attempt in (1, 2):
            executor.submit(replace(assign(layout, "steps", attempt=attempt), need=on_gpu))
            started = _wait_for_start(executor)
            end = events_until_end(executor)[-1]
            parents.add(started.pid)
            assert isinstance(end, Failed if attempt == 1 else Finished)
            assert executor.capacity.gpus == 1
        assert isinstance(run(executor, replace(assign(layout, "double/000000"), need=on_gpu))[-1], Finished)
    assert any("failed in steps and gets no task any more in this run" in sentence for sentence in told)


def test_what_fits_on_no_worker_is_a_failure_in_the_end(cluster, layout):
    told: list[str] = []
    with DaskExecutor(cluster, layout.root, of_runner=True, say=told.append) as executor:
        executor.patience_s = 1.0
        executor.submit(replace(assign(layout, "steps"), need=Resources(cores=1, gpus=2)))
        failed = failure(events_until_end(executor))
    assert failed.kind is FailureKind.WORKER_LOST
    assert failed.message == "no worker of the cluster has offered 1 cores, 0.0 GB and 2 GPUs for 1 s"
    assert told == ["steps waits for a worker with 1 cores, 0.0 GB and 2 GPUs"]


def test_a_worker_with_a_gpu_may_come_later(cluster, tmp_path):
    choice = ExecutorChoice("dask", cluster)
    with open_machines(choice, JobLayout(tmp_path / "job"), Resources(1), print) as machines:
        assert (machines.capacity.gpus, machines.machine) == (0, replace(SHARE, gpus=1))


@pytest.mark.slow
def test_a_worker_that_hangs_is_told_of_and_costs_the_others_nothing(port, layout):
    told: list[str] = []
    with running(start_worker(port)) as hung, running(start_worker(port, "CPU=2")):
        with _executor(port, layout.root) as executor:
            _wait_for_cores(executor, 3)
        hung.send_signal(signal.SIGSTOP)
        with DaskExecutor(
            f"tcp://{HOST}:{port}", layout.root, patience_s=START_PATIENCE_S, say=told.append
        ) as executor:
            assert executor.capacity.cores == 2
            assert isinstance(run(executor, assign(layout, "steps"))[-1], Finished)
            until = time.monotonic() + START_PATIENCE_S
            while not told:
                assert time.monotonic() < until
                assert executor.wait(0.5) == []
    assert told[0].endswith("gets no task: it does not answer")


def test_a_worker_without_this_program_is_told_of(port, layout, tmp_path):
    (tmp_path / "elsewhere" / "pipeline").mkdir(parents=True)
    (tmp_path / "elsewhere" / "pipeline" / "__init__.py").touch()

    class Told(Exception):  # noqa: N818
        pass

    def end_with_it(sentence: str) -> None:
        if "gets no task" in sentence:
            raise Told(sentence)

    with running(start_worker(port, cwd=tmp_path / "elsewhere")), pytest.raises(Told, match="ModuleNotFoundError"):
        DaskExecutor(f"tcp://{HOST}:{port}", layout.root, patience_s=START_PATIENCE_S, say=end_with_it)


def test_without_a_scheduler_there_is_a_clear_line(tmp_path):
    port = free_port()
    with pytest.raises(ClusterError, match=f"no Dask scheduler at tcp://{HOST}:{port} for 1 s"):
        DaskExecutor(f"tcp://{HOST}:{port}", tmp_path, patience_s=1.0)


def test_a_machine_that_was_too_busy_to_connect_tries_again(cluster, tmp_path, monkeypatch):
    """Dask asserts that its thread starts within ten seconds; a machine that sleeps for a while fails that."""
    sleeps = iter([True])

    def connect(*arguments: Any, **options: Any) -> Client:
        assert not next(sleeps, False)
        return Client(*arguments, **options)

    monkeypatch.setattr("pipeline.run.executors.dask_connection.Client", connect)
    said: list[str] = []
    with DaskExecutor(cluster, tmp_path, of_runner=True, say=said.append) as executor:
        assert executor.capacity.cores == 2
    assert ["very busy, or was asleep" in sentence for sentence in said] == [True]


def test_all_workers_of_the_terminal_are_waited_for(cluster, tmp_path, monkeypatch):
    """On a busy machine one may say who it is long after the other."""
    greet, late = Connection._greet, []

    async def greet_one_late(self: Connection, address: str, host: str) -> None:
        if not late or address in late:
            late.append(address)
            await asyncio.sleep(1.5)
        await greet(self, address, host)

    monkeypatch.setattr(Connection, "_greet", greet_one_late)
    with DaskExecutor(cluster, tmp_path, of_runner=True) as executor:
        assert executor.capacity.cores == 2
    assert len(late) == 1


def test_a_worker_that_does_not_see_the_folder_gets_no_task(cluster, tmp_path):
    with pytest.raises(ClusterError, match="the folder must be shared, under the same path"):
        DaskExecutor(cluster, tmp_path / "absent", of_runner=True, patience_s=3.0)


# --- whole jobs ---


class Trigger:
    """Calls a function once, in a thread of its own, when an artifact was committed."""

    def __init__(self, artifact: str, action: Callable[[], None]) -> None:
        self._artifact = artifact
        self._action: Callable[[], None] | None = action

    def notify(self, event: RunEvent) -> None:
        if isinstance(event, Committed) and event.receipt.artifact == self._artifact and self._action is not None:
            threading.Thread(target=self._action).start()
            self._action = None


def _run(root: Path, executor: DaskExecutor, **options: Any) -> Outcome:
    return run_synthetic(root, executor, capacity=executor.capacity, machine=executor.machine, **options)


def undisturbed(tmp_path: Path) -> dict[str, bytes]:
    with InlineExecutor() as executor:
        run_synthetic(tmp_path / "undisturbed", executor)
    return contents(tmp_path / "undisturbed")


def test_a_job_on_a_cluster_ends_like_one_on_this_machine(cluster, tmp_path):
    root = tmp_path / "job"
    write_faults(root, {"double/000002": ["kill"], "steps": ["kill@3"]})
    with DaskExecutor(cluster, root, of_runner=True) as executor:
        outcome = _run(root, executor)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert contents(root) == undisturbed(tmp_path)


@pytest.mark.slow
def test_a_run_outlives_a_restart_of_the_scheduler(tmp_path):
    root, port = tmp_path / "job", free_port()
    write_faults(root, {}, pause_s=0.3)
    with ExitStack() as processes:
        scheduler = processes.enter_context(running(start_scheduler(port)))
        processes.enter_context(running(start_worker(port)))

        def restart() -> None:
            scheduler.kill()
            scheduler.wait()
            processes.enter_context(running(start_scheduler(port)))
            processes.enter_context(running(start_worker(port)))

        with _executor(port, root) as executor:
            outcome = _run(root, executor, observers=[Trigger("steps/000001.bin", restart).notify])
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert contents(root) == undisturbed(tmp_path)


@pytest.mark.slow
def test_a_run_that_lost_its_scheduler_for_good_can_be_resumed(cluster, tmp_path):
    root, port = tmp_path / "job", free_port()
    write_faults(root, {}, pause_s=0.3)
    with running(start_scheduler(port)) as scheduler, running(start_worker(port)) as worker:
        with _executor(port, root) as executor:

            def lose_scheduler() -> None:
                executor.patience_s = 3.0
                scheduler.kill()

            with pytest.raises(ClusterError, match=r"no Dask (scheduler|worker that can be used)"):
                _run(root, executor, observers=[Trigger("steps/000001.bin", lose_scheduler).notify])
        worker.wait(START_PATIENCE_S)  # it leaves by itself, with its processes
    assert (root / "steps" / "000001.bin").exists()
    write_faults(root, {})
    with DaskExecutor(cluster, root, of_runner=True) as executor:
        outcome = _run(root, executor)
    assert outcome.kind is JobOutcome.SUCCEEDED
    assert contents(root) == undisturbed(tmp_path)


# --- waiting ---


def _executor(port: int, folder: Path) -> DaskExecutor:
    return DaskExecutor(f"tcp://{HOST}:{port}", folder, patience_s=START_PATIENCE_S)


def _events_until(executor: DaskExecutor, enough: Callable[[list[ExecutorEvent]], bool]) -> list[ExecutorEvent]:
    until = time.monotonic() + START_PATIENCE_S
    told: list[ExecutorEvent] = []
    while not enough(told):
        assert time.monotonic() < until, f"{told}; there is {executor.capacity}"
        told += executor.wait(0.5)
    return told


def _wait_for(executor: DaskExecutor, awaited: ExecutorEvent) -> None:
    _events_until(executor, lambda told: awaited in told)


def _wait_for_cores(executor: DaskExecutor, cores: int) -> None:
    _events_until(executor, lambda _: executor.capacity.cores >= cores)


def _until_started(executor: DaskExecutor, count: int) -> list[Started | Finished | Failed]:
    """Starts and ends, until so many have started."""
    told = _events_until(executor, lambda told: sum(isinstance(each, Started) for each in told) >= count)
    return [each for each in told if isinstance(each, Started | Finished | Failed)]


def _wait_for_start(executor: DaskExecutor) -> Started:
    return next(each for each in _until_started(executor, 1) if isinstance(each, Started))
