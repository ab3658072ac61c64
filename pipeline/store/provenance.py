"""Provenance of artifacts: the job files and parameter sets that receipts name, kept beside them, and who made which.

A receipt names its job file and its parameter set by their digests. Their texts lie in `.provenance/` under those
names, written before the first receipt that names them, so that an artifact's story is whole even where the manifest is
lost.
"""

import json
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from blake3 import blake3

from pipeline import __version__
from pipeline.base import wording
from pipeline.base.files import make_folder, open_regular, replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet, digest_of
from pipeline.store.receipts import Receipt

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
    _keep(layout, layout.parameters_text(parameters.digest), parameters.canonical)
    try:
        text = layout.job_file.read_text(encoding="utf-8")
    except FileNotFoundError:
        return ""
    digest = digest_of(text)
    _keep(layout, layout.job_text(digest), text)
    return digest


def read_text(path: Path) -> str | None:
    """A kept text; None if it is not there, or not what its name says."""
    try:
        with open_regular(path) as file:
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


def _keep(layout: JobLayout, path: Path, text: str) -> None:
    if not path.exists():
        make_folder(path.parent, within=layout.root)
        replace_durably(path, text)


# --- in words ---


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of a group of a task's artifacts: the same job file, parameters, attempt and machine."""

    receipt: Receipt  # one of theirs
    artifacts: int  # how many they are
    job_file: str | None  # where the job file lies that they were made from; None if it was not kept
    tools: dict[str, str] | None  # versions of the stage and of its tools; None if the parameters were not kept

    def lines(self) -> Iterator[str]:
        """For people."""
        receipt = self.receipt
        count = wording.counted(self.artifacts, "file")
        yield f"origin  {count} by attempt {receipt.attempt} on {receipt.host}, {wording.moment(receipt.finished)}"
        if receipt.maker:
            yield f"        {receipt.maker}"
        if receipt.device:
            yield f"        drawn on {receipt.device}"
        if self.tools is not None:
            tools = ", ".join(f"{name} {version}" for name, version in self.tools.items())
            yield f"        versions: {tools}"
        yield f"        job file: {self.job_file or 'not kept'}"
        key, fingerprint = receipt.parameters[:16], receipt.fingerprint[:16]
        yield f"        parameters {key}, {len(receipt.inputs)} inputs, together the fingerprint {fingerprint}"

    def as_json(self) -> dict[str, Any]:
        """For machines."""
        return {
            "artifacts": self.artifacts,
            "attempt": self.receipt.attempt,
            "host": self.receipt.host,
            "device": self.receipt.device,
            "maker": self.receipt.maker,
            "finished": self.receipt.finished,
            "job": self.receipt.job,
            "job_file": self.job_file,
            "parameters": self.receipt.parameters,
            "versions": self.tools,
            "inputs": self.receipt.inputs,
        }


def origins_of(layout: JobLayout, receipts: Sequence[Receipt]) -> list[Origin]:
    """Origins of a task's artifacts, latest last; those that have it in common together."""
    in_common = attrgetter("attempt", "host", "maker", "device", "job", "parameters", "fingerprint")
    groups: dict[object, list[Receipt]] = {}
    for receipt in receipts:
        groups.setdefault(in_common(receipt), []).append(receipt)
    latest_last = sorted(groups.values(), key=lambda members: members[-1].finished)
    return [_origin(layout, members[-1], len(members)) for members in latest_last]


def _origin(layout: JobLayout, receipt: Receipt, artifacts: int) -> Origin:
    job_file = layout.job_text(receipt.job)
    kept = bool(receipt.job) and read_text(job_file) is not None
    canonical = read_text(layout.parameters_text(receipt.parameters))
    tools = None
    if canonical is not None:
        values = json.loads(canonical)
        tools = {f"stage {values['stage_name']}": str(values["stage_version"]), **values["tools"]}
    return Origin(
        receipt=receipt,
        artifacts=artifacts,
        job_file=job_file.relative_to(layout.root).as_posix() if kept else None,
        tools=tools,
    )
