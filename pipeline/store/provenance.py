"""Provenance of artifacts: the job files and parameter sets that receipts name, kept beside them, and the maker.

A receipt names its job file and its parameter set by their digests. Their texts lie in `.provenance/` under those
names, written before the first receipt that names them, so that an artifact's story is whole even where the manifest is
lost.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from blake3 import blake3

from pipeline import __version__
from pipeline.base.files import replace_durably, sync
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet, digest_of

MAX_TEXT_BYTES = 64 * 2**20  # no job file or parameter set is larger


@cache
def maker() -> str:
    """The program, the Python and the kind of machine that write receipts in this process."""
    system = f"{platform.system()} {platform.machine()}"
    return f"pipeline {__version__}, Python {platform.python_version()} ({sys.implementation.name}), {system}"


def keep_texts(layout: JobLayout, parameters: ParameterSet) -> str:
    """Make sure that the job file and a parameter set are kept, durably; returns the job file's digest, "" without one.

    Raises OSError: they cannot be written, as on a full disk.
    """
    _keep(layout.parameters_text(parameters.digest), parameters.canonical)
    try:
        text = layout.job_file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return ""
    digest = digest_of(text)
    _keep(layout.job_text(digest), text)
    return digest


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


def _keep(path: Path, text: str) -> None:
    if path.exists():
        return
    if not path.parent.is_dir():
        path.parent.mkdir(parents=True, exist_ok=True)
        sync(path.parent.parent)
        sync(path.parent.parent.parent)
    replace_durably(path, text)
