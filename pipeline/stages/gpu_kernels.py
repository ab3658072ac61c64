"""Cycles' kernels for a GPU are compiled once: by one renderer, while those for the same kind of GPU wait.

Blender brings kernels for some GPUs; for others the driver compiles them at the first picture, for minutes and on one
core, and keeps them. Nothing tells beforehand whether it will, so a small file in the user's cache folder says that a
picture has been drawn on a GPU of that name, with that Blender and driver, on this machine. Where it is not there yet,
a lock lets one renderer of the machine draw its first picture alone. The kernel drops the lock with its holder.
"""

import fcntl
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pipeline.base.parameter_set import digest_of
from pipeline.model.gpus import driver_version
from sim.core.runtime import cache_folder


@contextmanager
def compiled_once(device: str, blender: str, tell: Callable[[str], None]) -> Iterator[None]:
    """The first picture of a renderer on a GPU: alone, where the kernels for that GPU may have to be compiled.

    `device` is what Cycles draws on, e.g. `OPTIX: NVIDIA RTX 4090`, and `blender` a version. `tell` is called with the
    reason of a long wait; "" where there is none.
    """
    marker = kernels_marker(device, blender)
    with _alone(marker, device, tell):
        tell("" if marker.exists() else f"compiling Cycles' kernels for {_name(device)}; minutes, once")
        yield
        # A cache folder that cannot be written costs the next renderer a moment alone, nothing else.
        with suppress(OSError):
            marker.parent.mkdir(parents=True, exist_ok=True)
            marker.touch()


def kernels_marker(device: str, blender: str) -> Path:
    """The file that says that the kernels for a GPU are compiled; arguments as of `compiled_once`."""
    kind = digest_of(f"{device}\n{blender}\n{driver_version()}\n{platform.node()}")
    return cache_folder() / "cycles-kernels" / kind[:32]


@contextmanager
def _alone(marker: Path, device: str, tell: Callable[[str], None]) -> Iterator[None]:
    """Exclude all others of this machine with that marker; do not wait where the marker exists."""
    descriptor = None if marker.exists() else _open_locked(marker.with_suffix(".lock"), device, tell)
    try:
        if descriptor is not None and marker.exists():  # the one before has compiled them
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        yield
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _open_locked(path: Path, device: str, tell: Callable[[str], None]) -> int | None:
    """A descriptor that holds a lock; None where none can be made: then each renderer compiles."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError:
        return None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            tell(f"another renderer is compiling Cycles' kernels for {_name(device)}; waiting for it")
            fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError:  # a file system without locks
        os.close(descriptor)
        return None
    return descriptor


def _name(device: str) -> str:
    """The GPU's own, without the back end."""
    return device.partition(": ")[2]
