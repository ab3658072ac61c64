"""Pages in a browser, served by viser from this machine."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import io
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING

from pipeline.errors import PipelineError

if TYPE_CHECKING:
    import viser

LOCAL = "127.0.0.1"
"""A page lets anybody who reaches it use its controls, so by default only this machine reaches it."""


def require_viser() -> None:
    """Raise PipelineError if viser is not installed."""
    if importlib.util.find_spec("viser") is None:
        raise PipelineError("pages in a browser need viser; install it with: pip install viser")


@contextlib.contextmanager
def page_server(*, host: str = LOCAL, port: int, label: str) -> Iterator[viser.ViserServer]:
    """A server for the time of the block.

    Args:
        host: address that it listens at.
        port: of it; 0 takes one that is free.
        label: of its panel.

    Raises:
        PipelineError: viser is missing, or the address cannot be had.
    """
    require_viser()
    import viser

    _require_free(host, port)
    with contextlib.redirect_stdout(io.StringIO()):  # it draws a box around its address
        server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    try:
        if port not in (0, server.get_port()):  # somebody was faster, and viser went on to the next
            raise _taken(host, port)
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: viser.ViserServer) -> str:
    """Where a browser finds it."""
    host = server.get_host()
    return f"http://{'localhost' if host == LOCAL else host}:{server.get_port()}"


def _require_free(host: str, port: int) -> None:
    """viser takes the next port where one is taken, which would show another job than the address that is known."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except socket.gaierror as error:
        raise PipelineError(f"{host}: no address of this machine ({error.strerror})") from error
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
