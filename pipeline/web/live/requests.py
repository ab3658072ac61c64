"""Requests of browsers to a scene, which are met between its frames, and the message that they leave."""

from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any

from pipeline.base.errors import PipelineError

Request = Callable[..., object]


class CannotGoOnError(PipelineError):
    """A scene is gone, and cannot be built again, or cannot be shown: there is no memory for it, say."""


class Requests:
    """A queue of calls from any thread, met by the thread that owns the scene; `message` is the first one.

    `revision` grows with every request that is refused; those that are `silent` leave a refusal standing.
    """

    def __init__(self, message: str) -> None:
        self._queue: SimpleQueue[tuple[Request, tuple[Any, ...]]] = SimpleQueue()
        self._result, self._refusal = message, ""
        self.revision = 0
        self.silent: tuple[Request, ...] = ()

    @property
    def message(self) -> str:
        """The last refusal, until another request is met; else the last result."""
        return self._refusal or self._result

    @message.setter
    def message(self, result: str) -> None:
        self._result, self._refusal = result, ""

    def clear(self, result: str) -> None:
        """Take back a result, if it is still the last one."""
        if self._result == result:
            self._result = ""

    def ask(self, request: Request, *arguments: Any) -> None:
        """Have a method called between two frames; an error that is meant for people becomes the message."""
        self._queue.put((request, arguments))

    def meet_requests(self, wait_s: float = 0.0) -> None:
        """Do all that was asked for; wait for the first request for so long at most [s].

        Raises CannotGoOnError: a scene that had to begin anew has no memory.
        """
        try:
            request, arguments = self._queue.get(timeout=wait_s) if wait_s > 0.0 else self._queue.get_nowait()
            while True:
                try:
                    request(*arguments)
                except CannotGoOnError:
                    raise
                except (ValueError, PipelineError, OSError) as error:
                    self._refusal = str(error)
                    self.revision += 1
                else:
                    if request not in self.silent:
                        self._refusal = ""
                request, arguments = self._queue.get_nowait()
        except Empty:
            return
