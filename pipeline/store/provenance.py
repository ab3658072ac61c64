"""Provenance of artifacts: the job files and parameter sets that receipts name, kept beside them, and the maker.

A receipt names its job file and its parameter set by their digests. Their texts lie in `.provenance/` under those
names, written before the first receipt that names them, so that an artifact's story is whole even where the manifest is
lost.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from pathlib import Path

from blake3 import blake3

from pipeline import __version__
from pipeline.base.files import replace_durably, sync
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet, digest_of

MAX_TEXT_BYTES = 64 * 2**20
"""No job file or parameter set is larger."""


@cache
def maker() -> str:
    """The program, the Python and the kind of machine that write receipts in this process."""
    system = f"{platform.system()} {platform.machine()}"
    return f"pipeline {__version__}, Python {platform.python_version()} ({sys.implementation.name}), {system}"


def keep_texts(layout: JobLayout, parameters: ParameterSet) -> str:
    """Make sure that the job file and a parameter set are kept, durably; returns the job file's digest, "" without one.

    Raises:
        OSError: they cannot be written, as on a full disk.
    """
    _keep(layout.parameters_text(parameters.digest), lambda: parameters.canonical)
    try:
        status = layout.job_file.stat()
    except FileNotFoundError:
        return ""
    digest = _digest_of_job_file(layout.job_file, status.st_mtime_ns, status.st_size)
    _keep(layout.job_text(digest), lambda: layout.job_file.read_text(encoding="utf-8"))
    return digest


@lru_cache(maxsize=1)
def _digest_of_job_file(path: Path, _mtime_ns: int, _size: int) -> str:
    return digest_of(path.read_text(encoding="utf-8"))


def read_text(path: Path) -> str | None:
    """A kept text; None if it is not there, or not what its name says."""
    try:
        with path.open("rb") as file:
            content = file.read(MAX_TEXT_BYTES + 1)
    except (FileNotFoundError, NotADirectoryError):
        return None
    if len(content) > MAX_TEXT_BYTES or blake3(content).hexdigest() != path.stem:
        return None
    return content.decode()


def damaged_texts(layout: JobLayout) -> Iterator[Path]:
    """The kept texts that are not what their names say."""
    for path in sorted(layout.provenance.glob("*/[!.]*")):
        if read_text(path) is None:
            yield path


def restore(layout: JobLayout, path: Path, parameters: ParameterSet | None) -> bool:
    """Write a damaged text anew from what else knows it; removes it otherwise. Returns whether it could be restored.

    Args:
        layout: the job's folder.
        path: one of `damaged_texts`.
        parameters: the parameter set of that digest, if the manifest knows it.
    """
    text = None if parameters is None else parameters.canonical
    if text is None and layout.job_file.exists():
        text = layout.job_file.read_text(encoding="utf-8")
    path.unlink()
    if text is None or digest_of(text) != path.stem:
        return False
    replace_durably(path, text)
    return True


def _keep(path: Path, text: Callable[[], str]) -> None:
    if path.exists():
        return
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        sync(path.parent.parent)
        sync(path.parent.parent.parent)
    replace_durably(path, text())
