"""Writing beside computing: a bounded queue of writes, done one after the other by a thread."""

import threading
from collections.abc import Callable
from queue import Full, Queue
from types import TracebackType
from typing import Self

WAITING = 1
"""Writes that may wait behind the one that is being done: with one, a write may take as long as a frame is computed
without holding anything up; more would only take memory, as what is slower on average stays slower."""

LOOK_AGAIN_S = 1.0  # how often a waiting `submit` makes sure that the thread still lives


class WriterLostError(RuntimeError):
    """The writing thread has ended before its time, and what it had to write is lost."""


class OrderedWriter:
    """Writer of frames and checkpoints: a context manager that does writes in order, in a thread of its own.

    What was handed in before is done before, so a checkpoint that is handed in after its frames never gets ahead of
    them. The first write that fails is the last one tried; its error is raised, as it is, by the next call from the
    computing thread, and no later than on leaving the block. Leaving the block waits for all writes, after an error in
    the block, too: what had been computed by then is good. Should the thread itself end, by whatever, nobody waits for
    it: the next call raises WriterLostError.
    """

    def __init__(self) -> None:
        self._queue: Queue[Callable[[], None] | None] = Queue(maxsize=WAITING)
        self._error: BaseException | None = None
        self._did_all = False
        self._thread = threading.Thread(target=self._work, name="writer", daemon=True)

    def submit(self, write: Callable[[], None]) -> None:
        """Hand in a write; waits while another one waits. Raises what an earlier write raised."""
        self._raise_error()
        if not self._hand_over(write):
            raise self._lost()
        self._raise_error()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._hand_over(None)
        self._thread.join()
        if self._error is None and not self._did_all:
            self._error = self._lost()
        if error is None:
            self._raise_error()
        elif self._error is not None and self._error is not error:
            error.add_note(f"besides, writing failed: {type(self._error).__name__}: {self._error}")

    def _hand_over(self, write: Callable[[], None] | None) -> bool:
        """Put a write, or the end, into the queue; whether there is anybody to take it out."""
        while self._thread.is_alive():
            try:
                self._queue.put(write, timeout=LOOK_AGAIN_S)
            except Full:
                continue
            return True
        return False

    def _lost(self) -> WriterLostError:
        return WriterLostError("the thread that writes frames has ended unexpectedly; frames since then are not kept")

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        """Take writes to the end, also after a failure: nobody is to wait for a place in the queue for ever."""
        while (write := self._queue.get()) is not None:
            if self._error is None:
                try:
                    write()
                except BaseException as error:
                    self._error = error
        self._did_all = True
