"""The runner's line to a Dask scheduler: what it hears there goes into one queue, and nothing here blocks for long.

Dask carries names and paths only. A driver task starts an attempt, and what the attempt reports comes back as events of
a topic, in order, by way of the scheduler: the runner needs no way to the workers' machines.
"""

import asyncio
import gc
import logging
import pickle
import uuid
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from distributed import Client, Future

from pipeline.base.paused_gc import many_objects
from pipeline.base.task import TaskId
from pipeline.run.events import Failed, Finished, TaskEvent
from pipeline.run.executors import dask_driver
from pipeline.run.executors.base import Assignment
from pipeline.run.executors.dask_slots import Offer, offer_from
from pipeline.run.executors.failures import describe

_CONNECT_S = 2.0
"""How long one try to connect may take [s]; the run stops for it."""
_POLL_S = 0.5
"""How often the scheduler is asked for its workers [s]."""
_ANSWER_S = 10.0
"""A scheduler that takes twice as long to answer counts as gone; a worker that takes longer is reported [s]."""
_ASK_AGAIN_S = 10.0
"""A worker that did not answer, or could not, is asked again after this pause [s]."""


@dataclass(frozen=True, slots=True)
class Workers:
    """The workers of the cluster."""

    offers: Mapping[str, Offer]  # those that may get tasks, by address
    # addresses of all that the scheduler knows, those as well that are paused or on their way out
    present: frozenset[str]
    remarks: tuple[str, ...] = ()  # what is wrong with workers that get no tasks, a sentence each


@dataclass(frozen=True, slots=True)
class DriverEnded:
    """Dask is done with the task `key`: `end` is what its driver returned; None if Dask lost it, for a `reason`."""

    key: str
    end: Finished | Failed | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class SchedulerLost:
    """The scheduler does not answer any more; nothing further comes from this connection."""

    reason: str


Message = TaskEvent | Workers | DriverEnded | SchedulerLost


class Connection:
    """A connection to a Dask scheduler, for one run of one job.

    The address is such as `tcp://farm:8786` or `tls://farm:8786`; certificates come from Dask's settings.

    Raises OSError: there is no scheduler, or this machine is too busy to ask for one.
    """

    def __init__(self, address: str, folder: Path, *, of_runner: bool) -> None:
        self.messages: SimpleQueue[Message] = SimpleQueue()
        self._folder = folder
        self._of_runner = of_runner
        self._run = uuid.uuid4().hex
        self._topic = f"physics-pipeline {folder}"
        self._greetings: dict[str, dask_driver.Greeting] = {}
        self._asked: dict[str, asyncio.Task[None]] = {}
        self._unanswered: dict[str, str] = {}
        self._closing = False
        for name in ("distributed", "distributed.client"):  # what matters of it is said here, in our own words
            logging.getLogger(name).setLevel(logging.CRITICAL)
        # A client that could not connect ends when it is collected; within the making of another it would take a lock
        # that this holds, and wait for ever.
        gc.collect()
        try:
            with many_objects():
                self._client = Client(address, timeout=_CONNECT_S, set_as_default=False, name="pipeline")
        except AssertionError as error:  # Dask's way to say that its thread did not start within ten seconds
            raise OSError("Dask did not start in time: this machine is very busy, or was asleep") from error
        try:
            self._client.subscribe_topic(self._topic, self._hear)
        except BaseException:
            self._client.close(timeout=2.0)
            raise
        self._soon(self._watch)

    def start(self, assignment: Assignment, offer: Offer, demand: Mapping[str, float]) -> Future[bytes]:
        """Start an attempt on a worker, and on no other."""
        # Dask keeps statistics for each name before the first hyphen: one a stage, not one a task.
        key = f"{assignment.task.stage}-{assignment.task.id}:{assignment.attempt}/{self._run}"
        memory_bytes = assignment.memory_bytes or offer.resources.memory_bytes or None
        order = dask_driver.DriverOrder(key, self._topic, self._run, offer.identity)
        future = self._client.submit(
            dask_driver.drive,
            replace(assignment, memory_bytes=memory_bytes),
            order,
            key=key,
            workers=[offer.address],
            allow_other_workers=False,
            resources=dict(demand),
            retries=0,
            pure=False,
        )
        future.add_done_callback(self._end)
        return future

    def cancel(self, offer: Offer, task_id: TaskId, attempt: int, grace_s: float) -> None:
        """Ask the worker that runs an attempt to stop it; see `Executor.cancel`."""
        self._soon(partial(self._tell, dask_driver.stop, self._folder, task_id, attempt, grace_s, to=[offer.address]))

    def close(self, *, release: bool) -> None:
        """End the connection; `release`: and the job's idle processes on the workers."""
        self._closing = True
        self._soon(self._ask_no_more)
        if release and self._client.status == "running":
            self._client.sync(self._tell, dask_driver.release, self._folder, to=None)
        self._client.close(timeout=2.0)

    # --- in the client's own thread ---

    def _soon(self, call: Callable[[], Awaitable[None]]) -> None:
        assert self._client.loop is not None
        self._client.loop.add_callback(call)

    async def _tell(self, function: Callable[..., None], *arguments: Any, to: list[str] | None) -> None:
        """Call a function in workers. Those that do not answer are given up by who waits for them."""
        call = self._client._run(function, *arguments, workers=to, on_error="ignore")
        with suppress(OSError, TimeoutError):
            await asyncio.wait_for(call, _ANSWER_S)

    async def _watch(self) -> None:
        try:
            while not self._closing:
                if self._client.status != "running":
                    raise ConnectionError("the connection broke")
                self.messages.put(await asyncio.wait_for(self._look(), 2 * _ANSWER_S))
                await asyncio.sleep(_POLL_S)
        except Exception as error:  # whatever it is, the runner must hear of it, or it waits for ever
            if not self._closing:
                self.messages.put(SchedulerLost(describe(error)))

    async def _look(self) -> Workers:
        assert self._client.scheduler is not None
        workers = (await self._client.scheduler.identity(n_workers=-1))["workers"]
        self._greetings = {address: each for address, each in self._greetings.items() if address in workers}
        self._unanswered = {address: each for address, each in self._unanswered.items() if address in workers}
        new = [address for address in workers if address not in self._greetings and address not in self._asked]
        if new:
            # Each by itself: one that hangs keeps no other waiting, and those that answer at once are in this look.
            self._asked |= {each: asyncio.create_task(self._greet(each, workers[each]["host"])) for each in new}
            await asyncio.wait([self._asked[each] for each in new], timeout=_POLL_S)
        offers, remarks = {}, [*self._unanswered.values()]
        for address, greeting in self._greetings.items():
            info = workers.get(address)
            if info is None:  # it was asked in an earlier look, answered in this one, and is gone
                continue
            if remark := self._objection(greeting):
                remarks.append(remark)
            elif info["status"] == "running":
                offers[address] = offer_from(address, info, identity=greeting.identity)
        return Workers(offers, frozenset(workers), tuple(remarks))

    async def _greet(self, address: str, host: str) -> None:
        """Ask a worker who it is. One that does not answer, or cannot, is reported, and asked again later."""
        call = self._client._run(dask_driver.greet, self._folder, self._of_runner, workers=[address], on_error="return")
        try:
            answer = (await asyncio.wait_for(call, _ANSWER_S)).get(address)
        except TimeoutError:
            remark = "it does not answer"
        except Exception as error:  # whatever it is, it is told; the watch finds out whether the scheduler is there
            remark = describe(error)
        else:
            if isinstance(answer, dask_driver.Greeting):
                self._greetings[address] = answer
                self._unanswered.pop(address, None)
                self._asked.pop(address, None)
                return
            remark = f"it cannot say who it is: {describe(answer)}"
        self._unanswered[address] = f"the Dask worker {address} on {host} gets no task: {remark}"
        await asyncio.sleep(_ASK_AGAIN_S)
        self._asked.pop(address, None)

    async def _ask_no_more(self) -> None:
        for asking in self._asked.values():
            asking.cancel()

    def _objection(self, greeting: dask_driver.Greeting) -> str:
        if not greeting.sees_folder:
            return f"{greeting.host} does not see {self._folder}: the folder must be shared, under the same path"
        # A worker of the runner's own terminal is started from the very same files.
        if not self._of_runner and greeting.software != dask_driver.software():
            return f"{greeting.host} runs another version of the program or its packages: its results might differ"
        return ""

    def forget(self, address: str) -> None:
        """Ask the worker at this address again who it is."""
        assert self._client.loop is not None
        self._client.loop.add_callback(self._greetings.pop, address, None)

    def _hear(self, event: tuple[float, bytes]) -> None:
        run, message = pickle.loads(event[1])  # noqa: S301 - who may speak here may run code on the cluster anyway
        if run == self._run:
            self.messages.put(message)

    def _end(self, future: Future[bytes]) -> None:
        """In Dask's thread for callbacks."""
        if self._closing:
            return
        if self._client.status != "running":
            self.messages.put(SchedulerLost("the connection broke"))
            return
        if future.status != "finished":
            self.messages.put(DriverEnded(str(future.key), None, f"Dask reports it as {future.status}"))
            return
        try:
            end = pickle.loads(future.result(timeout=_ANSWER_S))  # noqa: S301 - as above
        except Exception as error:  # it may be any, from the network up; the attempt is lost with it
            self.messages.put(DriverEnded(str(future.key), None, describe(error)))
        else:
            self.messages.put(DriverEnded(str(future.key), end))
