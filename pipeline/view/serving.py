"""Pages in a browser, served by viser from this machine.

viser asks nobody where he comes from, so a page of somebody else, open in the same browser, could use the controls of
ours and see its scene: websockets are not bound to the site that they are opened from. And whoever is connected may ask
viser for a tunnel through which all the world reaches the page. So pages listen at addresses that only this machine
reaches; requests whose Origin is another site than the Host that they name are refused, and those that name another
Host than this machine ("DNS rebinding": a name of somebody else that was bent to its address); tunnels are not opened.
Programs that are no browsers send no Origin and are let in: they could do on this machine what they like anyway.
"""

from __future__ import annotations

import contextlib
import errno
import http
import importlib.util
import io
import socket
import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pipeline.dashboard.access import host_of, is_loopback
from pipeline.errors import PipelineError, StageUnavailableError

if TYPE_CHECKING:
    import viser
    from websockets.datastructures import Headers

LOCAL = "127.0.0.1"
"""A page lets anybody who reaches it use its controls, so only this machine reaches it."""

_OPENING = threading.Lock()


def require_viser() -> None:
    """See that the library for pages is there.

    Raises:
        StageUnavailableError: it is not.
    """
    if importlib.util.find_spec("viser") is None:
        raise StageUnavailableError(
            "pages in a browser need viser, which is not installed; ./run installs it, and so does: pip install viser"
        )


def open_server(host: str, port: int, *, label: str | None = None) -> viser.ViserServer:
    """A server that answers its own pages only, and only on this machine; the caller stops it.

    Args:
        host: address that it listens at.
        port: of it; 0 takes one that is free.
        label: of its panel.

    Raises:
        PipelineError: viser is missing or cannot be guarded, or the address cannot be had, or others reach it.
    """
    require_viser()
    _require_loopback(host, port)
    import viser
    from viser import _messages

    _require_free(host, port)
    with _asked_first(lambda headers: refusal(headers, host=host)) as guarded, _silence():
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        if not guarded:
            raise PipelineError(f"viser {viser.__version__} does not let requests be checked; install 1.1.1")
        if port not in (0, server.get_port()):  # somebody was faster, and viser went on to the next
            raise _taken(host, port)
        for message in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            server._websock_server.unregister_handler(message)
    except BaseException:
        close_server(server)
        raise
    return server


def close_server(server: viser.ViserServer) -> None:
    """Stop a server; it says nothing."""
    with _silence():
        server.stop()


@contextlib.contextmanager
def page_server(*, host: str = LOCAL, port: int, label: str) -> Iterator[viser.ViserServer]:
    """A server for the time of the block; see `open_server`."""
    server = open_server(host, port, label=label)
    try:
        yield server
    finally:
        close_server(server)


def address(server: viser.ViserServer) -> str:
    """Where a browser finds it."""
    host = server.get_host()
    if host == LOCAL:
        host = "localhost"
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def refusal(headers: Headers, *, host: str) -> str | None:
    """Why a request is not answered; None if it is.

    Args:
        headers: of the request.
        host: address that the server listens at.
    """
    named = headers.get_all("Host")
    if len(named) != 1:
        return "a request names one Host"
    name = host_of(named[0])
    if not is_loopback(name):
        return f"this page is at {host}, not at {name}"
    if any(origin.lower().partition("://")[2] != named[0].lower() for origin in headers.get_all("Origin")):
        return "another site may not use this page"
    return None


@contextlib.contextmanager
def _asked_first(refusal: Callable[[Headers], str | None]) -> Iterator[list[bool]]:
    """Have a server that viser opens in the block refuse requests; yields a list that is filled when it does.

    viser opens its server by `websockets.asyncio.server.serve` and leaves no way to hand it a check of its own, so that
    name means another function until the block ends: viser's thread has called it by then. All that stays is the check
    in the server that was opened.
    """
    import websockets.asyncio.server

    plain: Any = websockets.asyncio.server.serve
    guarded: list[bool] = []

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            reason = refusal(request.headers)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{reason}\n")
            return process_request(connection, request)

        guarded.append(True)
        return plain(*arguments, process_request=process, **options)

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
    """viser knows no passwords: whoever reaches its page may steer it, and a token in its address would be ours to keep
    out of every message that it sends. ssh asks who comes, and keeps what is said from others."""
    if is_loopback(host):
        return
    here = f"ssh -L {port or 'PORT'}:{LOCAL}:{port or 'PORT'} {socket.gethostname()}"
    raise PipelineError(
        f"--host {host}: others would reach the page, and it has no password. From another machine, go through ssh: "
        f"leave --host out, run `{here}` there, and open http://{LOCAL}:{port or 'PORT'} in its browser"
    )


def _require_free(host: str, port: int) -> None:
    """viser takes the next port where one is taken, which would show another job than the address that is known."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except socket.gaierror as error:
        raise PipelineError(f"--host {host}: no address of this machine ({error.strerror})") from error
    with socket.socket(family, kind, protocol) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(place)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise _taken(host, port) from error
            raise PipelineError(f"cannot listen at port {port} of {host}: {error.strerror}") from error


def _taken(host: str, port: int) -> PipelineError:
    return PipelineError(f"port {port} of {host} is taken; choose another with --port, or any free one with --port 0")
