"""Making of a connection to a Dask scheduler."""

import gc
from pathlib import Path

import pytest

from pipeline.run.executors import dask_connection
from pipeline.run.executors.dask_connection import Connection


class FailedClient:
    """A client that could not connect: part of a cycle, as its error's traceback holds it."""

    def __init__(self, ended: list[str]) -> None:
        self.itself, self._ended = self, ended

    def __del__(self) -> None:
        self._ended.append("ended")


def test_no_client_ends_within_the_making_of_another(monkeypatch):
    """Dask's clients share a lock: ended within the making of another, a dead one waits for it for ever."""
    ended: list[str] = []
    gc.disable()
    try:
        FailedClient(ended)
        assert ended == []
    finally:
        gc.enable()

    def client(*_arguments: object, **_options: object) -> None:
        assert ended == ["ended"]
        FailedClient(ended)
        [[] for _ in range(10_000)]  # as many as start the collector
        assert ended == ["ended"]
        raise OSError("nobody there")

    monkeypatch.setattr(dask_connection, "Client", client)
    with pytest.raises(OSError, match="nobody there"):
        Connection("tcp://127.0.0.1:1", Path(), of_runner=False)
    assert gc.isenabled()
