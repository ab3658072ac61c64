"""The executor for several machines: worker processes under the workers of a Dask cluster.

Dask carries driver tasks, which start attempts and pass paths. It tries nothing again and chooses no worker: attempts
are the runner's business, and a task is only given to a worker that has room for it now, so that none waits behind
another.

A worker that is lost costs the tasks on it, as a lost process does. A scheduler that is lost costs all tasks under way;
when it is back within the executor's patience the run goes on, else it ends and can be resumed.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from queue import Empty

from distributed import Future

from pipeline.base.errors import PipelineError
from pipeline.base.task import FailureKind, Resources, TaskId
from pipeline.run.events import CapacityChanged, Failed, Finished, TaskEvent
from pipeline.run.executors.base import Assignment, Executor
from pipeline.run.executors.dask_connection import Connection, DriverEnded, Message, SchedulerLost, Workers
from pipeline.run.executors.dask_slots import Offer, Slots
from pipeline.run.executors.worker_process import log_tail

PATIENCE_S = 300.0
"""How long a run waits for a scheduler or for workers [s]: a restart, or a queue that gives out machines."""
GATHER_S = 3.0
"""How long a run waits for further workers once there is one [s], as the largest settles what a task can be given."""
_RECONNECT_PAUSE_S = 2.0
_KILL_MARGIN_S = 15.0
"""A task that is not reported as ended so long after its grace is given up, wherever it runs [s]."""


class ClusterError(PipelineError):
    """No Dask scheduler, or none with workers that can be used; the job can be resumed."""

    exit_code = 3


@dataclass(slots=True)
class _Attempt:
    assignment: Assignment
    need: Resources
    offer: Offer
    future: Future[bytes]
    began: float
    started: bool = False
    given_up_at: float | None = None


class DaskExecutor(Executor):
    """Runs assignments on a Dask cluster; see `Executor` for what it promises.

    Args:
        scheduler: its address, e.g. `tcp://farm:8786`.
        folder: the job's folder, absolute, which all workers see under the same path.
        of_runner: whether the Dask workers belong to the runner's own terminal.
        patience_s: how long to wait for a scheduler and for workers [s].
        say: called with what a person should know.

    Raises ClusterError: there was no scheduler, or no worker that can be used, within `patience_s`.
    """

    def __init__(
        self,
        scheduler: str,
        folder: Path,
        *,
        of_runner: bool = False,
        patience_s: float = PATIENCE_S,
        say: Callable[[str], None] = print,
    ) -> None:
        super().__init__()
        self._scheduler = scheduler
        self._folder = folder
        self._of_runner = of_runner
        self.patience_s = patience_s
        self._say = say
        self._said: set[str] = set()
        self._obstacle = ""
        self._slots = Slots()
        self._all_offer = False
        self._waiting: dict[TaskId, tuple[Assignment, float]] = {}
        self._running: dict[TaskId, _Attempt] = {}
        self._connection: Connection | None = None
        self._alone_since = time.monotonic()
        self._next_try = 0.0
        self._shut_down = False
        self.capacity = Resources(0, 0, 0)
        """The resources of all workers together; every change is reported as an event."""
        try:
            gathered_at = inf
            while not self._slots.offers or time.monotonic() < gathered_at:
                self._turn(0.5)
                if self._slots.offers:
                    gathered_at = min(gathered_at, time.monotonic() + GATHER_S)
                    if of_runner and self._all_offer:
                        break
        except BaseException:
            self.shutdown()
            raise
        self.machine = self._slots.largest
        """The most that a task can be given, of each; a task gets no more than one worker has of all."""
        self.capacity = self._slots.total
        self._events.clear()

    def submit(self, assignment: Assignment) -> None:
        """Give the attempt to a worker that has room for it, now or when there is one."""
        self._waiting[assignment.task.id] = (assignment, time.monotonic())
        self._place()

    def cancel(self, task_id: TaskId, *, grace_s: float) -> None:
        """Ask the task to stop; its processes are killed where they run after `grace_s` [s]."""
        if task_id in self._waiting:
            assignment, _ = self._waiting.pop(task_id)
            self._fail(assignment, FailureKind.CANCELLED, "cancelled before it began")
        elif (attempt := self._running.get(task_id)) is not None and self._connection is not None:
            if not attempt.started:  # its worker may not know it yet; it will find that nobody wants it
                self._end(task_id, FailureKind.CANCELLED, "cancelled before it began")
                return
            self._connection.cancel(attempt.offer, task_id, attempt.assignment.attempt, grace_s)
            attempt.given_up_at = time.monotonic() + grace_s + _KILL_MARGIN_S

    def shutdown(self) -> None:
        """End all tasks, and the job's processes on all workers; the workers stay."""
        for assignment, _ in self._waiting.values():
            self._fail(assignment, FailureKind.CANCELLED, "the executor was shut down")
        self._waiting.clear()
        for task_id in [*self._running]:
            self.cancel(task_id, grace_s=0.0)
        until = time.monotonic() + _KILL_MARGIN_S
        while self._running and self._connection is not None and time.monotonic() < until:
            self._turn(0.5)
        for task_id in [*self._running]:
            self._end(task_id, FailureKind.CANCELLED, "the executor was shut down")
        if self._connection is not None:
            self._connection.close(release=True)
            self._connection = None
        self._shut_down = True

    # --- one turn of the loop ---

    def _turn(self, timeout_s: float) -> None:
        """Wait for a message for `timeout_s` [s] at most, and take in all that came.

        Raises ClusterError: the scheduler or all workers have been gone for longer than the executor's patience.
        """
        if self._shut_down:
            time.sleep(max(0.0, timeout_s))
            return
        if self._connection is None:
            self._try_to_connect(timeout_s)
        else:
            messages = self._connection.messages
            try:
                self._take(messages.get(timeout=max(0.0, min(timeout_s, 0.5))))
                while self._connection is not None:
                    self._take(messages.get_nowait())
            except Empty:
                pass
        self._enforce_deadlines(time.monotonic())
        self._place()

    def _take(self, message: Message) -> None:
        match message:
            case Workers():
                self._take_workers(message)
            case DriverEnded(key, end, reason):
                attempt = next((each for each in self._running.values() if each.future.key == key), None)
                if attempt is not None and end is not None:
                    if not attempt.started:  # it was refused
                        self._distrust(attempt.offer)
                    self._take_event(end)
                elif attempt is not None:
                    self._distrust(attempt.offer)
                    self._end(attempt.assignment.task.id, FailureKind.WORKER_LOST, reason)
            case SchedulerLost(reason):
                self._lose_scheduler(reason)
            case _:
                self._take_event(message)

    def _take_event(self, event: TaskEvent) -> None:
        attempt = self._running.get(event.task_id)
        if attempt is None or attempt.assignment.attempt != event.attempt:
            return  # of an attempt that was given up
        attempt.started = True
        if isinstance(event, Failed) and event.kind is FailureKind.GPU_ERROR and attempt.need.gpus:
            self._slots.withdraw_gpu(attempt.offer)
            self._say(f"a GPU of {attempt.offer.host} failed in {event.task_id} and gets no task any more in this run")
            self._note_capacity()
        self._events.append(event)
        if isinstance(event, Finished | Failed):
            self._forget(event.task_id)

    def _take_workers(self, workers: Workers) -> None:
        for task_id, attempt in [*self._running.items()]:
            address = attempt.offer.address
            known = workers.offers.get(address)
            if address not in workers.present or (known is not None and known.identity != attempt.offer.identity):
                self._end(
                    task_id, FailureKind.WORKER_LOST, f"the Dask worker {address} on {attempt.offer.host} is gone"
                )
        self._slots.update(workers.offers, workers.present)
        self._all_offer = workers.present <= workers.offers.keys()
        self._obstacle = "; ".join(workers.remarks)
        for remark in workers.remarks:
            self._say_once(remark)
        if workers.offers:
            self._alone_since = time.monotonic()
        elif not workers.present:
            self._say_once(f"the Dask scheduler {self._scheduler} has no workers yet; waiting for some")
        self._note_capacity()

    def _note_capacity(self) -> None:
        if self._slots.total != self.capacity and self._slots.offers:
            self.capacity = self._slots.total
            self._events.append(CapacityChanged(self.capacity))

    def _distrust(self, offer: Offer) -> None:
        """Give a worker nothing more until the scheduler has listed it again, and it has said anew who it is."""
        self._slots.remove(offer.address)
        if self._connection is not None:
            self._connection.forget(offer.address)

    def _enforce_deadlines(self, now: float) -> None:
        for task_id, attempt in [*self._running.items()]:
            if attempt.given_up_at is not None and now >= attempt.given_up_at:
                self._end(task_id, FailureKind.CANCELLED, "cancelled; its worker did not answer")
        if now - self._alone_since > self.patience_s:
            wanting = "scheduler" if self._connection is None else "worker that can be used"
            reason = f": {self._obstacle}" if self._obstacle else ""
            raise ClusterError(f"no Dask {wanting} at {self._scheduler} for {self.patience_s:g} s{reason}")

    # --- placing ---

    def _place(self) -> None:
        """Give waiting tasks to workers, in order; what fits nowhere yet keeps the worker that it will fit on first."""
        reserved: set[str] = set()
        for task_id, (assignment, since) in [*self._waiting.items()]:
            if self._connection is None:
                return
            need = self._slots.clamp(assignment.need)
            offer = self._slots.take(need, stage=assignment.task.stage, reserved=reserved)
            if offer is not None:
                del self._waiting[task_id]
                if need != assignment.need:
                    assignment = replace(assignment, need=need, threads=max(1, min(assignment.threads, need.cores)))  # noqa: PLW2901
                future = self._connection.start(assignment, offer, offer.demand(need))
                self._running[task_id] = _Attempt(assignment, need, offer, future, time.monotonic())
            elif (address := self._slots.emptiest(need, reserved=reserved)) is not None:
                reserved.add(address)
            elif not any(need.fits(each.resources) for each in self._slots.offers):
                wants = f"{need.cores} cores, {need.memory_bytes / 1e9:.1f} GB and {need.gpus} GPUs"
                if time.monotonic() - since > self.patience_s:
                    del self._waiting[task_id]
                    sentence = f"no worker of the cluster has offered {wants} for {self.patience_s:g} s"
                    self._fail(assignment, FailureKind.WORKER_LOST, sentence)
                elif self._slots.offers:
                    self._say_once(f"{assignment.task.stage} waits for a worker with {wants}")

    # --- the scheduler goes and comes ---

    def _try_to_connect(self, timeout_s: float) -> None:
        now = time.monotonic()
        if now < self._next_try:
            time.sleep(min(max(0.0, timeout_s), self._next_try - now))
            return
        try:
            self._connection = Connection(self._scheduler, self._folder, of_runner=self._of_runner)
        except OSError as error:
            self._next_try = time.monotonic() + _RECONNECT_PAUSE_S
            self._obstacle = str(error)
            self._say_once(f"no Dask scheduler at {self._scheduler} yet ({error}); trying again")
        except (TypeError, ValueError, RuntimeError) as error:  # no certificate, no such address, encryption demanded
            raise ClusterError(f"cannot connect to {self._scheduler}: {error}; see docs/guide/cluster.md") from error
        else:
            self._said.clear()
            self._obstacle = ""

    def _lose_scheduler(self, reason: str) -> None:
        assert self._connection is not None
        self._connection.close(release=False)
        self._connection = None
        self._alone_since = time.monotonic()
        self._slots.update({})
        self._obstacle = reason
        for task_id in [*self._running]:
            self._end(task_id, FailureKind.WORKER_LOST, f"the Dask scheduler {self._scheduler} was lost: {reason}")
        self._say_once(f"the Dask scheduler {self._scheduler} was lost ({reason}); waiting for it to come back")

    # --- ends ---

    def _end(self, task_id: TaskId, kind: FailureKind, sentence: str) -> None:
        """Report a running attempt as failed, and drop it."""
        attempt = self._running[task_id]
        self._fail(attempt.assignment, kind, sentence, seconds=time.monotonic() - attempt.began)
        self._forget(task_id)

    def _fail(self, assignment: Assignment, kind: FailureKind, sentence: str, *, seconds: float = 0.0) -> None:
        details = log_tail(assignment.log) if seconds else ""
        self._events.append(Failed(assignment.task.id, assignment.attempt, kind, sentence, details, seconds))

    def _forget(self, task_id: TaskId) -> None:
        attempt = self._running.pop(task_id)
        self._slots.give_back(attempt.offer, attempt.need)
        attempt.future.release()  # Dask forgets the task; a driver that still runs notices, and ends its processes

    def _say_once(self, sentence: str) -> None:
        if sentence not in self._said:
            self._said.add(sentence)
            self._say(sentence)
