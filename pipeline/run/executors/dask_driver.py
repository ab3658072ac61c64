"""Code that runs inside a Dask worker: driver tasks, each of which has the worker processes here run one attempt.

A driver computes nothing. It hands its assignment to the same supervisor of processes as on a single machine, passes on
what that reports, and ends with the attempt. Whatever ends the Dask worker ends those processes: a kill, because they
die with the thread that started them; a proper end, because the plugin ends them, after time for a checkpoint.
"""

import asyncio
import pickle
import platform
import signal
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from queue import Empty, SimpleQueue

from blake3 import blake3
from distributed import Worker, get_worker
from distributed.diagnostics.plugin import WorkerPlugin

from pipeline.base.content import tool_version
from pipeline.base.task import FailureKind, TaskId
from pipeline.run.events import CapacityChanged, ExecutorEvent, Failed, Finished, GpuWithdrawn, Progress, TaskEvent
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.dask_slots import GPU_TAG
from pipeline.run.executors.processes import ProcessExecutor

_TURN_S = 0.1
"""How often a busy supervisor looks for another assignment or a cancellation [s]."""
_LOOK_S = 1.0
"""How often a driver asks whether anybody still wants its task [s]."""
_PROGRESS_INTERVAL_S = 1.0
"""Progress goes through Dask's scheduler, so of each task no more often than this [s]."""
_IDLE_S = 60.0
"""Time after its last task at which a job's processes end, with the memory that Blender keeps [s]."""
_LEAVING_GRACE_S = 20.0
"""Time that tasks get to write a checkpoint when the Dask worker leaves [s]. Dask kills it after 30."""
_PACKAGES = ("bpy", "numpy", "pysplashsurf", "taichi")
"""Whose versions decide the bits of a result."""
_FOLDERS = ("pipeline", "sim", "render", "blender_scripts")


# --- what a worker is asked before it gets a task ---


@dataclass(frozen=True, slots=True)
class Greeting:
    """What a Dask worker is."""

    identity: str  # name of this incarnation
    host: str
    sees_folder: bool  # whether the job's folder is there
    software: str  # see `software`


async def greet(folder: Path, of_runner: bool, dask_worker: Worker) -> Greeting:
    """Answer for the Dask worker in which this runs, and see to its leaving; Dask fills in `dask_worker`."""
    if LeavingPlugin.name not in dask_worker.plugins:  # to add it anew would end what runs
        await dask_worker.plugin_add(LeavingPlugin(of_runner=of_runner), catch_errors=False)
    return Greeting(dask_worker.id, platform.node(), folder.is_dir(), software())


@cache
def software() -> str:
    """Digest of the program's sources and versions of packages: equal, or results may differ between machines."""
    root = Path(__file__).parents[3]
    digest = blake3(platform.python_version().encode())
    for name in _PACKAGES:
        digest.update(f"{name} {tool_version(name)}\n".encode())
    for path in sorted(source for folder in _FOLDERS for source in (root / folder).rglob("*.py")):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest(length=8)


# --- the processes of one job on this worker ---


@dataclass(frozen=True, slots=True)
class _Cancel:
    task_id: TaskId
    attempt: int
    grace_s: float


@dataclass(frozen=True, slots=True)
class _Leave:
    grace_s: float


class _JobSupervisor(threading.Thread):
    """Owns the worker processes of one job; they die with this thread, and it dies with the Dask worker."""

    def __init__(self, gpus: int | None) -> None:
        super().__init__(name="job supervisor", daemon=True)
        self._gpus = gpus
        self._commands: SimpleQueue[Assignment | _Cancel | _Leave] = SimpleQueue()
        self._inboxes: dict[tuple[TaskId, int], SimpleQueue[TaskEvent]] = {}
        self._lock = threading.Lock()
        self._closed = False
        self._leaving = False

    def run_attempt(self, assignment: Assignment) -> SimpleQueue[TaskEvent] | None:
        """Begin an attempt; returns where its events appear, or None when this supervisor has left."""
        with self._lock:
            if self._closed:
                return None
            inbox = self._inboxes[assignment.task.id, assignment.attempt] = SimpleQueue()
            self._commands.put(assignment)
        return inbox

    def cancel(self, task_id: TaskId, attempt: int, grace_s: float) -> None:
        """See `Executor.cancel`; nothing happens if that attempt does not run here."""
        self._commands.put(_Cancel(task_id, attempt, grace_s))

    def leave(self, grace_s: float) -> None:
        """End everything; tasks get this long to stop by themselves [s]."""
        self._commands.put(_Leave(grace_s))

    def run(self) -> None:
        """The thread."""
        executor = ProcessExecutor(gpus=self._gpus)
        try:
            self._serve(executor)
        finally:
            with self._lock:
                self._closed = True
            executor.shutdown()
            self._deliver(executor.wait(0.0))
            for task_id, attempt in [*self._inboxes]:  # only if this very thread broke
                self._deliver([Failed(task_id, attempt, FailureKind.WORKER_LOST, "the supervisor of its worker broke")])

    def _serve(self, executor: ProcessExecutor) -> None:
        while self._inboxes or not self._leaving:
            command = self._next_command()
            if command is not None:
                self._obey(command, executor)
            elif self._inboxes:
                self._deliver(executor.wait(_TURN_S))
            elif self._close_if_unused():
                return

    def _next_command(self) -> Assignment | _Cancel | _Leave | None:
        """The next one; None when there is none and tasks run, or when there was none for long."""
        try:
            return self._commands.get_nowait() if self._inboxes else self._commands.get(timeout=_IDLE_S)
        except Empty:
            return None

    def _close_if_unused(self) -> bool:
        with self._lock:
            self._closed = self._commands.empty()
            return self._closed

    def _obey(self, command: Assignment | _Cancel | _Leave, executor: ProcessExecutor) -> None:
        match command:
            case Assignment():
                executor.submit(command)
                if self._leaving:  # it came in before, and is taken up after, the order to leave
                    executor.cancel(command.task.id, grace_s=0.0)
            case _Cancel(task_id, attempt, grace_s):
                if (task_id, attempt) in self._inboxes:
                    executor.cancel(task_id, grace_s=grace_s)
            case _Leave(grace_s):
                with self._lock:
                    self._closed = self._leaving = True
                for task_id, _ in [*self._inboxes]:
                    executor.cancel(task_id, grace_s=grace_s)

    def _deliver(self, events: Iterable[ExecutorEvent]) -> None:
        for event in events:
            if isinstance(event, CapacityChanged | GpuWithdrawn):  # the runner hears it from the failure
                continue
            key = event.task_id, event.attempt
            inbox = self._inboxes.pop(key, None) if isinstance(event, Finished | Failed) else self._inboxes.get(key)
            if inbox is not None:
                inbox.put(event)


class _Supervisors:
    """Those of this process, by the job's folder: ids of tasks are unique within a job only."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads: dict[Path, _JobSupervisor] = {}
        self._leaving = False

    def run_attempt(
        self, assignment: Assignment, gpus: int | None
    ) -> tuple[_JobSupervisor, SimpleQueue[TaskEvent]] | None:
        """Begin an attempt on this Dask worker, which offers so many GPUs; None when it is leaving."""
        with self._lock:
            while not self._leaving:
                supervisor = self._threads.get(assignment.root)
                if supervisor is None:
                    supervisor = self._threads[assignment.root] = _JobSupervisor(gpus)
                    supervisor.start()
                inbox = supervisor.run_attempt(assignment)
                if inbox is not None:
                    return supervisor, inbox
                del self._threads[assignment.root]
        return None

    def of(self, root: Path) -> _JobSupervisor | None:
        """That of a job, if there is one."""
        with self._lock:
            return self._threads.get(root)

    def leave(self, grace_s: float) -> None:
        """End everything, and wait for that."""
        with self._lock:
            self._leaving = True
            threads = [*self._threads.values()]
        for thread in threads:
            thread.leave(grace_s)
        for thread in threads:
            thread.join()


_supervisors = _Supervisors()


class LeavingPlugin(WorkerPlugin):
    """Ends the tasks of a Dask worker that leaves: on SIGTERM, and when its scheduler is gone.

    Where the worker belongs to the runner's own terminal (`of_runner`), Ctrl-C there is the runner's business.
    """

    name = "physics-pipeline"

    def __init__(self, *, of_runner: bool = False) -> None:
        self._of_runner = of_runner

    def setup(self, worker: Worker) -> None:  # noqa: ARG002 - the signature is Dask's
        """Called by Dask, in the main thread of the worker."""
        if self._of_runner:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    async def teardown(self, worker: Worker) -> None:  # noqa: ARG002
        """Called by Dask while the worker closes."""
        await asyncio.to_thread(_supervisors.leave, _LEAVING_GRACE_S)


# --- messages to a worker beside tasks ---


def stop(root: Path, task_id: TaskId, attempt: int, grace_s: float) -> None:
    """Cancel an attempt; nothing happens if it does not run here."""
    supervisor = _supervisors.of(root)
    if supervisor is not None:
        supervisor.cancel(task_id, attempt, grace_s)


def release(root: Path) -> None:
    """The run is over: end its processes here."""
    supervisor = _supervisors.of(root)
    if supervisor is not None:
        supervisor.leave(0.0)


# --- the driver ---


@dataclass(frozen=True, slots=True)
class DriverOrder:
    """What a driver has to know besides its assignment."""

    key: str  # Dask's name of its task
    topic: str  # under which Dask passes events on to the runner, each as a pickled `(run, event)`
    run: str  # which run of the job it is for
    # the incarnation of the worker that was chosen. Dask may start a task again that was lost with its worker; there it
    # ends at once, since the runner decides about further attempts
    identity: str


def drive(assignment: Assignment, order: DriverOrder) -> bytes:
    """Run one attempt on this Dask worker. Returns its end, a pickled `Finished` or `Failed`."""
    worker = get_worker()
    obstacle = ""
    if worker.id != order.identity:
        obstacle = "its Dask worker was replaced"
    elif not _is_wanted(worker, order.key):
        obstacle = "nobody waits for it any more"
    elif (begun := _supervisors.run_attempt(assignment, _gpus_of(worker))) is None:
        obstacle = "its Dask worker is leaving"
    if obstacle or begun is None:
        return pickle.dumps(Failed(assignment.task.id, assignment.attempt, FailureKind.WORKER_LOST, obstacle))
    supervisor, inbox = begun
    wanted, last_progress = True, 0.0
    while True:
        try:
            event = inbox.get(timeout=_LOOK_S)
        except Empty:
            event = None
        if wanted and not _is_wanted(worker, order.key):
            # The runner is gone, or has given this task to somebody else.
            wanted = False
            supervisor.cancel(assignment.task.id, assignment.attempt, 0.0)
        if isinstance(event, Progress):
            if event.done < event.total and time.monotonic() - last_progress < _PROGRESS_INTERVAL_S:
                continue
            last_progress = time.monotonic()
        if event is not None:
            worker.log_event(order.topic, pickle.dumps((order.run, event)))
            if isinstance(event, Finished | Failed):
                return pickle.dumps(event)


def _gpus_of(worker: Worker) -> int | None:
    """How many GPUs a Dask worker offers; None where it says nothing."""
    offered = worker.state.total_resources.get(GPU_TAG)
    return None if offered is None else int(offered)


def _is_wanted(worker: Worker, key: str) -> bool:
    """Whether Dask's scheduler still asks for a task that runs here."""
    state = worker.state.tasks.get(key)
    return state is not None and state.state == "executing"
