"""A temporary folder for a process that may end without removing what it has there."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from tempfile import mkdtemp

VARIABLES = ("TMPDIR", "TMP")
"""That say where a process has its temporary files; Blender up to 4.5 asks the second first."""


@contextlib.contextmanager
def environment_of_child(prefix: str) -> Iterator[dict[str, str]]:
    """The environment for a process whose temporary folder is its own, and goes at the end of the block.

    Blender makes a folder in it, and removes that only if it ends by itself.

    Raises:
        OSError: there is no place for it.
    """
    folder = mkdtemp(prefix=prefix)
    try:
        yield {**os.environ, **dict.fromkeys(VARIABLES, folder)}
    finally:
        shutil.rmtree(folder, ignore_errors=True)  # what cannot be removed is no reason to lose a run
