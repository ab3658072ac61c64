"""Files that are replaced as a whole, and outlive a power cut."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


def replace_durably(path: Path, content: str | bytes) -> None:
    """Write a file aside, force it to the disk and rename it: others see the old one or the new one, never a part.

    Args:
        path: the file; its folder is there.
        content: what it is to hold; text is written as UTF-8.

    Raises:
        OSError: it cannot be written, as on a full disk; the old file stands then, and nothing is left beside it.
    """
    # Workers write the same text at once, and in containers they have the same process ids.
    part = path.with_name(f".{path.name}.part.{uuid4().int}")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        sync(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync(path.parent)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside this one, of the same suffix, to write to; takes its place at the end of a block without an error.

    Raises:
        OSError: the folder cannot be made, or the file cannot be moved.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Force a file's bytes, or a folder's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
