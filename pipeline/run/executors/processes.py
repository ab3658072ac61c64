"""The default executor: worker processes on this machine, under a supervisor of our own.

Each worker is a fresh interpreter (never a fork: Taichi and Blender survive none), runs one task at a time, and is
kept for the next task of the same stage: Blender stays imported and the scene stays built. A worker that dies takes
its own task with it and nothing else, and a supervisor that dies takes all of its workers with it.
"""

import os
import selectors
import time
from dataclasses import dataclass, replace
from math import inf

from pipeline.base.memory import machine_memory_bytes, resident_memory_bytes
from pipeline.base.resources import MEMORY_SHARE
from pipeline.base.task import FailureKind, TaskId
from pipeline.run.events import Failed, Finished, GpuWithdrawn, Progress
from pipeline.run.executors.base import Assignment, Executor
from pipeline.run.executors.channel import Channel
from pipeline.run.executors.failures import full_place, is_disk_full
from pipeline.run.executors.gpu_places import NoGpuLeftError, places_of_process
from pipeline.run.executors.worker import StopAttempt
from pipeline.run.executors.worker_process import WorkerProcess, log_tail

_STACK_DUMP_S = 1.0
"""Time a stalled worker gets to write its stacks before it is killed [s]."""
_RETIRE_GRACE_S = 20.0
"""Time a worker gets to leave by itself, writing its kernel cache for instance, before it is killed [s]."""
_DEATH_S = 10.0
"""Time a killed worker gets to be gone [s]; one in a call to a file system that does not answer may outlive it."""
FURTHER_WORKERS = 6
"""Idle workers beyond one a core: as many as there are stages, as a Blender for every frame would be slow."""
_MEMORY_WATCH_S = 0.5
"""How often the memory of busy workers is looked at [s]; a look takes a fraction of a millisecond."""
_POLL_S = 0.2
"""How often exits are looked for where the system has no pidfd [s]."""


@dataclass(frozen=True, slots=True)
class WorkerLimits:
    """When a worker is replaced."""

    tasks_per_worker: int = 50  # a worker is replaced after this many tasks
    # a worker larger than this after a task is replaced; None: a quarter of the machine's
    resident_memory_bytes: int | None = None
    # idle workers are ended when there would be more in all; None: one a core, and one for each further stage, so that
    # stages that take turns frame by frame all keep theirs warm
    workers: int | None = None


class ProcessExecutor(Executor):
    """Runs assignments in worker processes of this machine; see `Executor` for what it promises.

    Workers die with the thread that submits to this executor, so use it from one that lives as long as the run.
    """

    def __init__(self, limits: WorkerLimits | None = None, *, gpus: int | None = None) -> None:
        """`gpus` is how many there are for tasks, where that is known."""
        super().__init__()
        self._limits = limits or WorkerLimits()
        self._gpus = gpus
        memory_bytes = machine_memory_bytes()
        self._memory_limit = self._limits.resident_memory_bytes or memory_bytes // 4
        self._task_memory_limit = int(memory_bytes * MEMORY_SHARE)
        self._memory_watched_at = 0.0
        self._worker_limit = self._limits.workers or (os.cpu_count() or 1) + FURTHER_WORKERS
        self._places = places_of_process()
        self._failed_gpus: set[int] = set()
        self._workers: list[WorkerProcess] = []
        self._selector = selectors.DefaultSelector()

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of all workers, idle ones too."""
        return [worker.pid for worker in self._workers]

    @property
    def worker_gpus(self) -> dict[int, int]:
        """Places of the GPUs that workers have, by process id."""
        return {worker.pid: worker.key[2] for worker in self._workers if worker.key[2] is not None}

    def submit(self, assignment: Assignment) -> None:
        """Give the attempt to a warm worker of its stage, or to a new one."""
        if assignment.need.gpus:
            lowest, warm, failed = assignment.task.lowest_gpu, self._warm_places(assignment), self._failed_gpus
            try:
                place = self._places.take(warm, lowest=lowest, there=self._gpus, failed=failed)
            except NoGpuLeftError as error:  # of a cluster's worker, whose offer another runner believes
                task_id, attempt = assignment.task.id, assignment.attempt
                self._events.append(Failed(task_id, attempt, FailureKind.GPU_ERROR, str(error)))
                return
            assignment = replace(assignment, gpu=place)
        key = (assignment.task.stage, assignment.threads, assignment.gpu)
        worker = next((worker for worker in self._workers if worker.idle and worker.key == key), None)
        if worker is None:
            self._make_room(assignment)
            try:
                worker = WorkerProcess(key, assignment)
            except OSError as error:  # too many processes or files, no memory, a full disk: the task may try again
                kind = FailureKind.DISK_FULL if is_disk_full(error) else FailureKind.WORKER_LOST
                sentence = f"no worker could be started: {error}"
                task_id, attempt, full = assignment.task.id, assignment.attempt, full_place(error)
                self._events.append(Failed(task_id, attempt, kind, sentence, full_place=full))
                self._give_place_back(assignment)
                return
            self._workers.append(worker)
            self._selector.register(worker.channel, selectors.EVENT_READ, worker)
            if worker.exit_descriptor is not None:
                self._selector.register(worker.exit_descriptor, selectors.EVENT_READ, worker)
        worker.assign(assignment)

    def cancel(self, task_id: TaskId, *, grace_s: float) -> None:
        """Ask the task to stop; its worker's whole process group is killed after `grace_s` [s]."""
        for worker in self._workers:
            if worker.assignment is not None and worker.assignment.task.id == task_id:
                sentence = "cancelled"
                if grace_s > 0:
                    worker.channel.send(StopAttempt(task_id, worker.assignment.attempt))
                    sentence = f"cancelled; it did not stop by itself within {grace_s:g} s"
                worker.end_by(time.monotonic() + grace_s, FailureKind.CANCELLED, sentence)

    def shutdown(self) -> None:
        """Let idle workers go, kill busy ones, and wait until every process is gone that can go."""
        for worker in self._workers:
            if worker.assignment is None:
                self._retire(worker)
            else:
                worker.end_by(time.monotonic(), FailureKind.CANCELLED, "the executor was shut down")
        until = time.monotonic() + _RETIRE_GRACE_S + _DEATH_S
        while self._workers and time.monotonic() < until:
            self._turn(_POLL_S)
        for worker in [*self._workers]:  # they were killed, and end as soon as their file system answers
            self._bury(worker)

    # --- places on GPUs ---

    def _warm_places(self, assignment: Assignment) -> list[int]:
        """GPUs on which an idle worker of the assignment's stage waits."""
        wanted = (assignment.task.stage, assignment.threads)
        keys = [worker.key for worker in self._workers if worker.idle and worker.key[:2] == wanted]
        return [gpu for _, _, gpu in keys if gpu is not None]

    def _give_place_back(self, assignment: Assignment) -> None:
        if assignment.gpu is not None:
            self._places.give_back(assignment.gpu)

    def _withdraw_gpu(self, assignment: Assignment, failed: Failed) -> None:
        """Give the GPU that failed an attempt to no other; idle workers that hold on to it go."""
        if failed.kind is not FailureKind.GPU_ERROR or assignment.gpu is None or assignment.gpu in self._failed_gpus:
            return
        self._failed_gpus.add(assignment.gpu)
        for worker in self._workers:
            if worker.idle and worker.key[2] == assignment.gpu:
                self._retire(worker)
        if self._gpus is not None:
            left = self._gpus - len(self._failed_gpus)
            sentence = f"GPU {assignment.gpu} failed in {failed.task_id} and gets no task any more in this run"
            rest = f"{left} left" if left else "none is left: the job pauses; submit it again when the GPU works"
            self._events.append(GpuWithdrawn(left, f"{sentence}; {rest} ({failed.message.splitlines()[0]})"))

    # --- the life of a worker ---

    def _make_room(self, assignment: Assignment) -> None:
        """Let the longest idle worker go when a new one would be one too many.

        All of them go, with the memory that they hold, before a task that is to have all of it.
        """
        if assignment.need.memory_bytes >= self._task_memory_limit:
            for worker in [worker for worker in self._workers if worker.idle]:
                self._retire(worker)
            until = time.monotonic() + _RETIRE_GRACE_S + _DEATH_S
            while any(worker.assignment is None for worker in self._workers) and time.monotonic() < until:
                self._turn(_POLL_S)
        staying = [worker for worker in self._workers if worker.idle or worker.assignment is not None]
        idle = [worker for worker in staying if worker.idle]
        if idle and len(staying) >= self._worker_limit:
            self._retire(min(idle, key=lambda worker: worker.last_sign))

    def _retire(self, worker: WorkerProcess) -> None:
        """Close its channel: it leaves by itself, and is killed if it does not."""
        worker.idle = False
        if worker.kill_at is None:
            worker.kill_at = time.monotonic() + _RETIRE_GRACE_S
        self._close_channel(worker)

    def _close_channel(self, worker: WorkerProcess) -> None:
        if not worker.channel.closed:
            self._selector.unregister(worker.channel)
            worker.channel.close()

    def _bury(self, worker: WorkerProcess) -> None:
        """The process is gone: read its last words, and report its task if they did not."""
        self._read(worker)
        assignment = worker.assignment
        if assignment is not None:
            kind, sentence = worker.explain_exit()
            seconds, details = time.monotonic() - worker.began, log_tail(assignment.log)
            peak = worker.peak_memory_bytes
            failed = Failed(assignment.task.id, assignment.attempt, kind, sentence, details, seconds, peak)
            self._withdraw_gpu(assignment, failed)
            self._events.append(failed)
            self._give_place_back(assignment)
        self._workers.remove(worker)
        self._close_channel(worker)
        if worker.exit_descriptor is not None:
            self._selector.unregister(worker.exit_descriptor)
        worker.close()

    # --- one turn of the loop ---

    def _turn(self, timeout_s: float) -> None:
        """Wait for a message, an exit or a deadline, for `timeout_s` [s] at most, and act on it."""
        for worker in self._workers:
            if not worker.channel.closed:
                events = selectors.EVENT_READ | (selectors.EVENT_WRITE if worker.channel.has_unsent else 0)
                if self._selector.get_key(worker.channel).events != events:
                    self._selector.modify(worker.channel, events, worker)
        for key, events in self._selector.select(max(0.0, min(timeout_s, self._seconds_to_next_deadline()))):
            if isinstance(key.fileobj, Channel):
                if events & selectors.EVENT_WRITE:
                    key.fileobj.flush()
                if events & selectors.EVENT_READ:
                    self._read(key.data)
        for worker in [worker for worker in self._workers if worker.has_exited()]:
            self._bury(worker)
        now = time.monotonic()
        if now - self._memory_watched_at >= _MEMORY_WATCH_S:
            self._memory_watched_at = now
            for worker in self._workers:
                self._watch_memory(worker, now)
        for worker in self._workers:
            self._enforce_deadlines(worker, now)

    def _read(self, worker: WorkerProcess) -> None:
        if worker.channel.closed:
            return
        for message in worker.channel.receive():
            worker.last_sign = time.monotonic()
            if isinstance(message, Failed):
                assert worker.assignment is not None
                message = worker.explain_failure(message)  # noqa: PLW2901
                self._withdraw_gpu(worker.assignment, message)
            self._events.append(message)
            if isinstance(message, Progress):
                worker.note_progress(message)
            if isinstance(message, Finished | Failed):
                assert worker.assignment is not None
                self._give_place_back(worker.assignment)
                worker.end_assignment(failed=isinstance(message, Failed))
                if self._is_worn_out(worker):
                    self._retire(worker)
                    return
                worker.idle = True
        if worker.channel.at_end:
            self._retire(worker)

    def _is_worn_out(self, worker: WorkerProcess) -> bool:
        return (
            worker.single_use
            or worker.tasks_done >= self._limits.tasks_per_worker
            or resident_memory_bytes(worker.pid) > self._memory_limit
        )

    def _seconds_to_next_deadline(self) -> float:
        now = time.monotonic()
        deadlines = [now + _POLL_S for worker in self._workers if worker.exit_descriptor is None]
        if any(worker.assignment is not None for worker in self._workers):
            deadlines.append(self._memory_watched_at + _MEMORY_WATCH_S)
        for worker in self._workers:
            if worker.kill_at is not None:
                deadlines.append(worker.kill_at)
            elif worker.assignment is not None:
                deadlines.append(worker.last_sign + worker.stall_s)
                deadlines.append(worker.limited_since + (worker.assignment.timeout_s or inf))
        return min(deadlines, default=inf) - now

    def _enforce_deadlines(self, worker: WorkerProcess, now: float) -> None:
        if worker.kill_at is not None:
            if worker.kill_at <= now:
                worker.kill()
                worker.kill_at = inf  # once is enough; its exit comes through the selector
            return
        if worker.assignment is None:
            return
        stall_s, timeout_s = worker.stall_s, worker.assignment.timeout_s or inf
        limits = f"limits.{worker.assignment.task.stage}"
        if now - worker.last_sign >= stall_s:
            kind = FailureKind.STALLED
            sentence = f"no sign of life for {stall_s:g} s, which is {limits}.stall_s; the log shows where it hung"
        elif now - worker.limited_since >= timeout_s:
            kind = FailureKind.TIMED_OUT
            sentence = f"not done after {timeout_s:g} s, which is {limits}.timeout_s; the log shows where it was"
        else:
            return
        worker.end_by(now + _STACK_DUMP_S, kind, sentence)
        worker.leave_evidence(sentence)

    def _watch_memory(self, worker: WorkerProcess, now: float) -> None:
        """End a task whose processes hold too much together, before the kernel ends somebody for it."""
        if worker.assignment is None or worker.kill_at is not None:
            return
        limit, size = worker.assignment.memory_bytes or self._task_memory_limit, worker.look_at_memory()
        if size > limit:
            sentence = (
                f"its processes held {size / 1e9:.3g} GB together, and may hold {limit / 1e9:.3g} GB "
                f"(limits.{worker.assignment.task.stage}.memory_gb)"
            )
            worker.leave_evidence(sentence)
            worker.end_by(now, FailureKind.OUT_OF_MEMORY, sentence)
