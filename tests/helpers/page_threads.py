"""Which threads talk to the pages of a viser server."""

import threading

import pytest
from viser.infra._async_message_buffer import AsyncMessageBuffer


def threads_that_push(monkeypatch: pytest.MonkeyPatch) -> set[int]:
    """Fills with the threads that put messages into buffers, from now on."""
    threads: set[int] = set()
    push = AsyncMessageBuffer.push

    def watched(buffer: AsyncMessageBuffer, message: object) -> None:
        threads.add(threading.get_ident())
        push(buffer, message)

    monkeypatch.setattr(AsyncMessageBuffer, "push", watched)
    return threads
