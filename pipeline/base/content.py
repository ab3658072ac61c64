"""Content of what a job is made from beside its text: files of the user's, packages that do the work."""

import errno
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from blake3 import blake3

from pipeline.base.errors import MissingInputError

ABSENT = "absent"  # version of a package that is not installed


@cache
def tool_version(package: str) -> str:
    """Installed version of a package, or ABSENT; reads metadata, imports nothing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ABSENT


def content_name(file: str, kind: str) -> str:
    """Hash and suffix of a file of the user's, for the suffix decides how the file is read.

    `kind` is what it is, for messages: "mesh". Raises MissingInputError if it cannot be read.
    """
    status = status_of(file, kind)
    return _hash(file, kind, status.st_size, status.st_mtime_ns) + Path(file).suffix.lower()


def status_of(file: str, kind: str) -> os.stat_result:
    """Size and times of a file. Raises MissingInputError where there is none."""
    try:
        return Path(file).stat()
    except OSError as error:
        raise _missing(file, kind, error) from error


def _missing(file: str, kind: str, error: OSError) -> MissingInputError:
    return MissingInputError(f"cannot read the {kind} {file}: {error.strerror}; the job needs it")


@cache
def _hash(file: str, kind: str, _size: int, _mtime_ns: int) -> str:
    try:
        if not Path(file).is_file():
            raise OSError(errno.EINVAL, "it is no file", file)  # a device or a pipe may never end
        return blake3(Path(file).read_bytes()).hexdigest()
    except OSError as error:
        raise _missing(file, kind, error) from error
