"""Serving of pages from this machine: the dashboard by uvicorn, scenes by viser.

viser asks nobody where he comes from, so a page of another site, open in the same browser, could use the controls of
ours and see its scene: websockets are not bound to the site that they are opened from. And whoever is connected may ask
viser for a tunnel through which all the world reaches the page. So viser listens at addresses that only this machine
reaches; requests are refused whose Host is not this machine ("DNS rebinding") or whose Origin is another site than that
Host; tunnels are not opened. Programs that are no browsers send no Origin and are let in: they could do on this machine
what they like anyway.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import http
import io
import ipaddress
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from pipeline.base.errors import PipelineError
from pipeline.base.signals import signals_to
from pipeline.web.auth import Access, host_of, is_address, is_loopback

if TYPE_CHECKING:
    import viser
    from websockets.datastructures import Headers

LOCAL = "127.0.0.1"
GRACE_S = 2  # that an answer may still take once the end is asked for; a film that is played would take for ever
MOST_CONNECTIONS = 512
MOST_OF_ADDRESS = 64  # connections; browsers open six
REQUEST_S = 10.0  # in which a request must be in; ours are a few KB

_OPENING = threading.Lock()

Result = TypeVar("Result")


# --- addresses and the end ---


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens on an address; port 0: on any free one.

    Raises PipelineError: the port is taken, or the address is none of this machine; names what would do.
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
            raise _taken(host, port) from error
        if error.errno == errno.EACCES:
            raise PipelineError(f"port {port} may not be used by this user; use one from 1024 on") from error
        raise PipelineError(f"cannot listen on {host}: {error.strerror}") from error
    return listening


def _taken(host: str, port: int) -> PipelineError:
    with listen(host, 0) as free:
        number = free.getsockname()[1]
    return PipelineError(f"port {port} of {host} is taken; {number} is free: --port {number}, or --port 0")


def url(host: str, port: int) -> str:
    """The address of a page, as a browser takes it."""
    if is_address(host) and ipaddress.ip_address(host).is_unspecified:
        host = socket.gethostname()
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def remark_of(listening: socket.socket, host: str) -> str:
    """A remark where a name reaches less far than it seems to; else empty."""
    address = listening.getsockname()[0]
    if is_loopback(host) or not is_loopback(address):
        return ""
    return (
        f"{host} is {address} on this machine, as its /etc/hosts says, which only this machine reaches; "
        "for others, name its address in the network: --host ADDRESS"
    )


@contextmanager
def stop_event() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set inside the block."""
    stop = threading.Event()
    with signals_to(lambda *_: stop.set()):
        yield stop


# --- uvicorn ---


def serve(application: ASGIApp, listening: socket.socket, ready: Callable[[], None]) -> None:
    """Answer the requests that arrive at a socket until Ctrl-C or a signal TERM; calls `ready` when that begins."""
    with listening:
        Server(config_of(application), ready).run(sockets=[listening])


def config_of(application: ASGIApp) -> uvicorn.Config:
    """Uvicorn's configuration."""
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
    """A connection that is closed when a request does not come to its end, so that none is held open for nothing.

    Nor do many that wait keep others out: where there are too many of an address, or of all, the oldest that waits for
    a request is closed for the newest.
    """

    _patience: asyncio.TimerHandle | None = None
    _made_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for the first request."""
        super().connection_made(transport)
        self._made_s = self.loop.time()
        self._wait_or_not()
        there = [each for each in self.connections if isinstance(each, Connection) and not each.transport.is_closing()]
        for crowd, most in ((self._of_same_address(there), MOST_OF_ADDRESS), (there, MOST_CONNECTIONS - 1)):
            waiting = [each for each in crowd if each._waits]
            if len(crowd) > most and waiting:
                min(waiting, key=attrgetter("_made_s")).transport.abort()

    def data_received(self, data: bytes) -> None:
        """Take a piece of a request; the time counts from its first piece, or from the connection's beginning."""
        super().data_received(data)
        self._wait_or_not()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        super().connection_lost(exc)
        self._stop_waiting()

    def _of_same_address(self, others: Sequence[Connection]) -> list[Connection]:
        """Those of the same machine; of IPv6 those of its network."""
        return [each for each in others if _network_of(each.client) == _network_of(self.client)]

    @property
    def _waits(self) -> bool:
        """Whether no request has come yet, or not to its end."""
        return self.conn.their_state in (h11.IDLE, h11.SEND_BODY)

    def _wait_or_not(self) -> None:
        if not self._waits:
            self._stop_waiting()
        elif self._patience is None:
            self._patience = self.loop.call_later(REQUEST_S, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None


def _network_of(client: tuple[str, int] | None) -> str:
    """The IPv4 address of a client, or the /64 of its IPv6 address, of which any machine has all."""
    if client is None or ":" not in client[0]:
        return client[0] if client else ""
    address = ipaddress.IPv6Address(client[0].partition("%")[0])
    return str(address.ipv4_mapped or ipaddress.IPv6Network((address, 64), strict=False))


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
        """Take note of a signal. An answer that is cut off now, such as a film that is played, is not logged."""
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        super().handle_exit(sig, frame)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Take SIGINT and SIGTERM for the wish to end, inside the block."""
        with signals_to(self.handle_exit):
            yield


# --- viser ---


@contextmanager
def page_server(*, host: str = LOCAL, port: int = 0, label: str | None = None) -> Iterator[viser.ViserServer]:
    """A viser server that answers its own pages only, and only on this machine, for the time of the block.

    Port 0 takes one that is free; `label` is that of its panel.

    Raises PipelineError: viser cannot be guarded, or the address cannot be had, or others reach it.
    """
    _require_loopback(host, port)
    import viser
    from viser import _messages

    listen(host, port).close()  # viser takes the next port where one is taken, which would show another job
    with _guarded(Access(host, port, None)) as guarded, _silence():
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        if not guarded:
            raise PipelineError(f"viser {viser.__version__} does not let requests be checked; install 1.1.1")
        if port not in (0, server.get_port()):  # another program was faster
            raise _taken(host, port)
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            server._websock_server.unregister_handler(message)
        server.get_event_loop().call_soon_threadsafe(_tell_in_a_line, server.get_event_loop())
        yield server
    finally:
        with _silence():
            server.stop()


def in_its_loop(server: viser.ViserServer, act: Callable[..., Result], *arguments: object) -> Result:
    """What `act` returns, done in the event loop of a viser server: nothing else may talk to its pages.

    viser wakes what waits for messages by an `asyncio.Event`, which is for one thread: set in another while a page
    comes or goes, it raises RuntimeError. Not to be called in that loop itself.
    """

    async def done() -> Result:
        return act(*arguments)

    return asyncio.run_coroutine_threadsafe(done(), server.get_event_loop()).result()


def address(server: viser.ViserServer) -> str:
    """Where a browser finds a viser server."""
    host = server.get_host()
    return url("localhost" if host == LOCAL else host, server.get_port())


def refusal(headers: Headers, access: Access) -> str | None:
    """Reason why a request to a viser server is refused; None if it is answered."""
    named = headers.get_all("Host")
    if len(named) != 1:
        return "a request names one Host"
    if not access.knows_host(named[0]):
        return f"this page is at {access.host}, not at {host_of(named[0])}"
    if any(origin.lower().partition("://")[2] != named[0].lower() for origin in headers.get_all("Origin")):
        return "another site may not use this page"
    return None


class _OneLine(logging.Filter):
    """Errors of connections without their tracebacks; nothing of what was no request, as of a scan of ports."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Put what a message has raised in place of the traceback."""
        if record.getMessage() == "opening handshake failed":
            return False
        if record.exc_info and record.exc_info[1] and record.getMessage() == "connection handler failed":
            record.msg, record.args = _not_understood(record.exc_info[1]), ()
            record.exc_info = record.exc_text = None
        return True


def _log_of_connections() -> logging.Logger:
    log = logging.getLogger(f"{__name__}.connections")
    if not log.filters:
        log.addFilter(_OneLine())
    return log


def _tell_in_a_line(loop: asyncio.AbstractEventLoop) -> None:
    """Have errors that messages of a page raise cost a line each: anybody here may send what viser cannot read."""

    def tell(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        logging.getLogger(__name__).error(context["message"] if error is None else _not_understood(error))

    loop.set_exception_handler(tell)


def _not_understood(error: BaseException) -> str:
    return f"a message of a page was not understood: {type(error).__name__}: {' '.join(str(error).split())[:200]}"


@contextmanager
def _guarded(access: Access) -> Iterator[list[bool]]:
    """Have a server that viser opens in the block refuse requests; yields a list that is filled when it does.

    viser opens its server by `websockets.asyncio.server.serve` and takes no check, so that name means another function
    until the block ends: viser's thread has called it by then.
    """
    import websockets.asyncio.server

    plain: Any = websockets.asyncio.server.serve
    guarded: list[bool] = []

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            reason = refusal(request.headers, access)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, request)

        guarded.append(True)
        return plain(*arguments, process_request=process, logger=_log_of_connections(), **options)

    module: Any = websockets.asyncio.server
    with _OPENING:
        module.serve = serve
        try:
            yield guarded
        finally:
            module.serve = plain


def _silence() -> contextlib.redirect_stdout[io.StringIO]:
    """viser draws a box around its address, and says that it has stopped."""
    return contextlib.redirect_stdout(io.StringIO())


def _require_loopback(host: str, port: int) -> None:
    """viser knows no passwords: whoever reaches its page may steer it. ssh asks who comes, and hides what is said."""
    if is_loopback(host):
        return
    here = f"ssh -L {port or 'PORT'}:{LOCAL}:{port or 'PORT'} {socket.gethostname()}"
    raise PipelineError(
        f"--host {host}: others would reach the page, and it has no password. From another machine, go through ssh: "
        f"leave --host out, run `{here}` there, and open http://{LOCAL}:{port or 'PORT'} in its browser"
    )
