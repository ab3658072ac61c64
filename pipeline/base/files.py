"""Files that are replaced as a whole, and outlive a power cut."""

import errno
import fcntl
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from pipeline.base.errors import FolderGoneError


def replace_durably(path: Path, content: str | bytes, *, mark: str = "part") -> None:
    """Write a file aside, force it to the disk and rename it: others see the old one or the new one, never a part.

    Text is written as UTF-8. Where it cannot be written, as on a full disk, the old file stands, and nothing is left
    beside it. `mark` is in the name aside: runners remove what others have left behind as "part".
    """
    # Workers write the same text at once, and in containers they have the same process ids.
    part = path.with_name(f".{path.name}.{mark}.{uuid4().int}")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        sync(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    sync(path.parent)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside this one, of the same suffix, to write to; takes its place when the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.stem}.part.{uuid4().int}{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def make_folder(path: Path, *, within: Path) -> None:
    """Make a folder, and those between it and `within`; each new name is forced to the disk.

    Raises FolderGoneError: `within` itself is not there, which somebody has renamed or removed who wants no new one.
    """
    if path.is_dir():
        return
    if path == within:
        raise FolderGoneError.of(within)
    make_folder(path.parent, within=within)
    path.mkdir(exist_ok=True)
    sync(path.parent)


def open_regular(path: Path) -> BinaryIO:
    """A file, open for reading; a pipe or a device, from which reading may never end, counts as none.

    Raises OSError: FileNotFoundError if it is not there.
    """
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise FileNotFoundError(errno.ENOENT, "is no file", str(path))


def holds(path: Path, text: str) -> bool:
    """Whether a file is there and holds just this text."""
    try:
        return path.read_bytes() == text.encode()
    except FileNotFoundError:
        return False


def sync(path: Path) -> None:
    """Force a file's bytes, or a folder's names, to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def stamp_of(path: Path) -> tuple[int, int, int] | None:
    """What changes with a file: inode, time of modification [ns] and size; None if there is none. Raises OSError."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Exclusive among all processes of all machines that use this lock file; held for a few milliseconds."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
