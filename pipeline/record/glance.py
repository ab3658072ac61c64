"""Glancing at a manifest again and again, as a page does that is left open: without a trace, and without waiting.

SQLite makes an index file beside a write-ahead-log database that it opens, even for reading, and a reader cannot remove
it. A manifest that nobody has open is therefore read as one that does not change, and if it did change, once more.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, TypeVar

from pipeline.base.errors import ManifestError
from pipeline.base.files import stamp_of
from pipeline.record.reader import ManifestReader

TIMEOUT_S = 0.5  # how long a glance waits for a lock, which only a manifest on a network file system has
TRIES = 5

T = TypeVar("T")


class Version(NamedTuple):
    """Stamp of a manifest: inode, time of modification [ns] and size of the file and of its log."""

    file: tuple[int, int, int] | None
    log: tuple[int, int, int] | None

    @property
    def changed_ns(self) -> int:
        """Time of the last change [ns since the epoch]; 0 if there is none."""
        return max((each[1] for each in self if each is not None), default=0)


def version_of(path: Path) -> Version:
    """A manifest's version now; `Version(None, None)` if there is none. Raises OSError."""
    return Version(stamp_of(path), stamp_of(path.with_name(f"{path.name}-wal")))


def glance(path: Path, query: Callable[[ManifestReader], T]) -> T:
    """Result of a query on a manifest, of one moment or of moments right after each other; it may be called again.

    Raises:
        ManifestError: see `ManifestReader.open_readonly`.
        OSError: the folder does not answer.
    """
    for last in (False,) * (TRIES - 1) + (True,):
        before = version_of(path)
        try:
            with ManifestReader.open_readonly(path, leave_no_trace=True, timeout_s=TIMEOUT_S) as manifest:
                found = query(manifest)
        except ManifestError:
            if last or version_of(path) == before:  # else it was changed beneath us, which looks like damage
                raise
            continue
        # With a log SQLite itself sees to it that what is read fits together.
        if last or before.log is not None or version_of(path) == before:
            return found
    raise AssertionError("the last try returns or raises")
