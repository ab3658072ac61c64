"""The server of a page in a browser."""

from __future__ import annotations

import contextlib
import io
import os
import socket
from typing import TYPE_CHECKING

from pipeline.errors import PipelineError, StageUnavailableError

if TYPE_CHECKING:
    import viser


def require_viser() -> None:
    """See that the library for pages is there.

    Raises:
        StageUnavailableError: it is not.
    """
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise StageUnavailableError(
            f"pages in a browser need viser, which is not installed ({error}); install the extra: "
            'pip install "physics-pipeline[view]", or use ./run, which installs it'
        ) from error


def open_server(host: str, port: int) -> viser.ViserServer:
    """A server at an address and port; any free port for 0.

    Raises:
        PipelineError: the port is taken, or the address is not this machine's.
    """
    import viser

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        if os.name == "posix":
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do, after a restart
        try:
            probe.bind((host, port))
        except OSError as error:
            raise _cannot_listen(host, port, error.strerror or str(error)) from error
    with contextlib.redirect_stdout(io.StringIO()):  # it draws a box around its address
        server = viser.ViserServer(host=host, port=port, verbose=False)
    if port not in (0, server.get_port()):  # taken in between: viser takes the next one
        server.stop()
        raise _cannot_listen(host, port, "somebody has just taken it")
    return server


def _cannot_listen(host: str, port: int, reason: str) -> PipelineError:
    return PipelineError(f"cannot listen at {host}:{port}: {reason}; choose another with --port, 0 for a free one")
