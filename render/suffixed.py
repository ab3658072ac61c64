"""Files under names that libraries accept, which go by a file's ending; what is being committed has none of these."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from render.temporary_folder import temporary_folder


@contextmanager
def written_as(path: Path, suffix: str) -> Iterator[Path]:
    """A path with an ending to write to; what is there at the end of the block becomes `path`."""
    with temporary_folder("export") as folder:
        named = folder / f"file{suffix}"
        yield named
        shutil.copyfile(named, path)


@contextmanager
def read_as(path: Path, suffix: str) -> Iterator[Path]:
    """The same file by a name with an ending."""
    with temporary_folder("export") as folder:
        named = folder / f"file{suffix}"
        named.symlink_to(path.resolve())
        yield named
