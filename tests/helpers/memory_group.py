"""A real control group of memory, for processes that shall run out of it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.base.memory import _control_groups


@contextmanager
def memory_group(limit_bytes: int) -> Iterator[Path]:
    """A group whose processes may hold so much together; the test is skipped where none can be made."""
    for parent in _control_groups():
        folder = parent / f"test-{os.getpid()}"
        try:
            folder.mkdir()
        except OSError:
            continue
        for name in ("memory.max", "memory.limit_in_bytes"):
            if (folder / name).exists():
                (folder / name).write_text(str(limit_bytes))
                yield folder
                folder.rmdir()
                return
        folder.rmdir()
    pytest.skip("no control group of memory can be made here")
