"""Temporary folders that go even where their process is killed: the next run or maker of one removes them."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from tempfile import gettempdir, mkdtemp

PREFIX = "pipeline-tmp-"
"""Of the names of all of them."""

VARIABLES = ("TMPDIR", "TMP")
"""That say where a process has its temporary files; Blender up to 4.5 asks the second first."""


@contextlib.contextmanager
def temporary_folder(purpose: str) -> Iterator[Path]:
    """A folder that goes at the end of the block, with those of processes that were killed in theirs.

    A process holds a lock on its folder, which ends with it. Where folders cannot be locked, as on some network file
    systems, those of dead processes stay.

    Raises:
        OSError: there is no place for it.
    """
    remove_folders_of_the_dead()
    folder, lock = _locked_folder(purpose)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # what cannot be removed is no reason to lose a run
        os.close(lock)


@contextlib.contextmanager
def environment_of_child(purpose: str) -> Iterator[dict[str, str]]:
    """The environment for a process whose temporary folder is its own, and goes at the end of the block.

    Blender makes a folder in it, and removes that only if it ends by itself.

    Raises:
        OSError: there is no place for it.
    """
    with temporary_folder(purpose) as folder:
        yield {**os.environ, **dict.fromkeys(VARIABLES, str(folder))}


def remove_folders_of_the_dead() -> None:
    """Remove the temporary folders whose processes have ended without doing so."""
    for folder in Path(gettempdir()).glob(f"{PREFIX}*"):
        with contextlib.suppress(OSError):  # somebody else's, or gone meanwhile, or no locks on folders here
            descriptor = _opened(folder)
            try:
                if _lock(descriptor):
                    shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(descriptor)


def _locked_folder(purpose: str) -> tuple[Path, int]:
    """A new folder, and the descriptor that locks it."""
    while True:
        folder = Path(mkdtemp(prefix=f"{PREFIX}{purpose}-"))
        try:
            descriptor = _opened(folder)
        except FileNotFoundError:
            continue  # another process took it for a dead one's before it was locked
        try:
            is_locked = _lock(descriptor)
        except OSError:  # no locks on folders here: nobody takes it for a dead one's, then
            is_locked = True
        if is_locked:
            return folder, descriptor
        os.close(descriptor)


def _opened(folder: Path) -> int:
    return os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)


def _lock(descriptor: int) -> bool:
    """Lock a folder; False if another process has, or has removed it. Raises OSError: it cannot be locked here."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return os.fstat(descriptor).st_nlink > 0
