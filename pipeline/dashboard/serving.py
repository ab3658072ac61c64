"""Listening, and serving until somebody ends it."""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipeline.dashboard.access import is_address, is_loopback
from pipeline.errors import PipelineError

GRACE_S = 2
"""So long an answer may still take once the end is asked for [s]; a film that is played would take for ever."""
MOST_CONNECTIONS = 512
REQUEST_S = 10.0
"""A connection whose request is not in after this time [s] is closed; ours are a few KB."""


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address; port 0: on any free one.

    Raises:
        PipelineError: the port is taken, or the address is none of this machine; names what would do.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except (socket.gaierror, UnicodeError) as error:
        raise PipelineError(f"--host {host}: no such address") from error
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.listen(128)
    except OSError as error:
        listening.close()
        if error.errno == errno.EADDRINUSE:
            free = listen(host, 0)
            with free:
                number = free.getsockname()[1]
            raise PipelineError(f"port {port} is taken; {number} is free: --port {number}, or --port 0") from error
        if error.errno == errno.EACCES:
            raise PipelineError(f"port {port} may not be used by this user; use one from 1024 on") from error
        raise PipelineError(f"cannot listen on {host}: {error.strerror}") from error
    return listening


def serve(application: ASGIApp, listening: socket.socket, ready: Callable[[], None]) -> None:
    """Answer requests until Ctrl-C or a signal TERM; returns then.

    Args:
        application: answers them.
        listening: where they arrive; closed at the end.
        ready: called when the first one would be answered.
    """
    with listening:
        Server(config_of(application), ready).run(sockets=[listening])


def config_of(application: ASGIApp) -> uvicorn.Config:
    """How requests are taken."""
    return uvicorn.Config(
        application,
        http=Connection,
        log_level="error",
        access_log=False,
        server_header=False,
        ws="none",
        lifespan="off",
        limit_concurrency=MOST_CONNECTIONS,
        timeout_graceful_shutdown=GRACE_S,
        proxy_headers=False,
    )


class Connection(H11Protocol):
    """A connection that is closed when a request does not come to its end, so that none is held open for nothing."""

    _patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._wait_or_not()

    def data_received(self, data: bytes) -> None:
        """Take a piece of a request; the time counts from its first piece, or from the connection's beginning."""
        super().data_received(data)
        self._wait_or_not()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        super().connection_lost(exc)
        self._stop_waiting()

    def _wait_or_not(self) -> None:
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._stop_waiting()
        elif self._patience is None:
            self._patience = self.loop.call_later(REQUEST_S, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None


class Server(uvicorn.Server):
    """A server that a signal ends as any other work: in order, and without being killed by that signal afterwards."""

    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to answer."""
        await super().startup(sockets)
        self._ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Take note of a signal. What is cut off now, such as a film that is played, is no error to be told of."""
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        super().handle_exit(sig, frame)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Take SIGINT and SIGTERM for the wish to end, inside the block."""
        before = {number: signal.signal(number, self.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def address_of(listening: socket.socket, host: str) -> str:
    """The address of the farm's page, as a browser takes it."""
    stands_for_all = is_address(host) and ipaddress.ip_address(host).is_unspecified
    shown = socket.gethostname() if stands_for_all else host
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{listening.getsockname()[1]}/"


def remark_of(listening: socket.socket, host: str) -> str:
    """What is to be said of where it listens: that a name reaches less far than it seems to; else nothing."""
    address = listening.getsockname()[0]
    if is_loopback(host) or not is_loopback(address):
        return ""
    return (
        f"{host} is {address} on this machine, as its /etc/hosts says, which only this machine reaches; "
        "for others, name its address in the network: --host ADDRESS"
    )
