"""A Dask scheduler and Dask workers in processes of their own, to be killed and started again."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

HOST = "127.0.0.1"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def start_scheduler(port: int) -> subprocess.Popen[bytes]:
    return _start("dask_scheduler", f"--host={HOST}", f"--port={port}", "--no-dashboard")


def start_worker(port: int, tags: str = "CPU=1 MEM=4e9", *, cwd: Path | None = None) -> subprocess.Popen[bytes]:
    """Modules in `cwd` go before all others."""
    options = ("--no-nanny", "--nthreads=1", "--memory-limit=0", "--no-dashboard", f"--host={HOST}")
    return _start("dask_worker", f"tcp://{HOST}:{port}", *options, f"--resources={tags}", cwd=cwd)


@contextmanager
def running(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    """Killed at the end, if it still runs then."""
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            process.kill()
        process.wait()


def _start(module: str, *arguments: str, cwd: Path | None = None) -> subprocess.Popen[bytes]:
    here = str(Path(__file__).parent)
    return subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.{module}", *arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([here, *sys.path])},
        cwd=cwd,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
