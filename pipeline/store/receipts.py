"""Receipts of artifacts: what was committed, made of what, and whether the file still is that.

An artifact counts only with its *receipt*, a small JSON file under `.receipts/` that names the task and attempt that
made it, the fingerprint it was made from, and the size, modification time and blake3 hash of the bytes. How the two get
there, so that no crash leaves a receipt that matches a wrong file, is in pipeline.store.artifacts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from blake3 import blake3

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.files import open_regular
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import digest_of
from pipeline.base.task import ArtifactPath, TaskId

_READ_BYTES = 4 << 20
_MAX_RECEIPT_BYTES = 256 * 2**20  # a film of a million frames names them all


@dataclass(frozen=True, slots=True)
class Receipt:
    """Receipt of a committed artifact."""

    artifact: ArtifactPath
    task: TaskId  # that made it
    stage: str
    attempt: int  # number of the attempt that made it; grows with every try of the task, for ever
    fingerprint: str  # of what its content was made from; see pipeline.base.task
    parameters: str  # digest of the task's parameter set, so that a change can be named
    size: int  # [bytes]
    mtime_ns: int  # modification time [ns since the epoch]; with the size it short-cuts to the hash
    hash: str  # blake3 of the bytes, in hexadecimal
    inputs: Mapping[ArtifactPath, str] = field(default_factory=dict)  # hashes, so that a change can be named
    job: str = ""  # digest of the job file, whose text is `JobLayout.job_text`; empty where there was none
    maker: str = ""  # program, Python and kind of machine that wrote it; see `provenance.maker`
    host: str = ""  # name of the machine that wrote it
    device: str = ""  # what computed it, as `CPU` or `OPTIX: NVIDIA RTX 4090`, where that decides its last bits
    started: float = 0.0  # wall time when the part file was opened [s since the epoch]
    finished: float = 0.0  # wall time when it was committed [s since the epoch]

    def to_json(self) -> str:
        """The receipt file's text; its seal is a digest of all the rest, so that no flipped bit goes unseen."""
        values = asdict(self)
        return json.dumps({**values, "seal": _seal(values)}, indent=1, sort_keys=True) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Receipt:
        """Read a receipt file's text. Raises InvalidArtifactError: it is not a receipt."""
        try:
            values: dict[str, Any] = dict(json.loads(text))
            if values.pop("seal") != _seal(values):
                raise InvalidArtifactError("not a receipt any more: its seal is broken")
            return cls(**values)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise InvalidArtifactError(f"not a receipt: {error}") from error


def _seal(values: Mapping[str, Any]) -> str:
    return digest_of(json.dumps(values, sort_keys=True, separators=(",", ":")))


def hash_file(path: Path) -> str:
    """blake3 of a file's bytes, in hexadecimal. Streams, so a file of any size takes little memory."""
    hasher = blake3()
    buffer = bytearray(_READ_BYTES)
    view = memoryview(buffer)
    with path.open("rb", buffering=0) as file:
        while count := file.readinto(buffer):
            hasher.update(view[:count])
    return hasher.hexdigest()


def read_receipt(layout: JobLayout, artifact: ArtifactPath) -> Receipt | None:
    """The artifact's receipt, or None if there is none or it is not readable as one (then it does not count)."""
    try:
        with open_regular(layout.receipt(artifact)) as file:
            content = file.read(_MAX_RECEIPT_BYTES + 1)
        receipt = Receipt.from_json(content.decode()) if len(content) <= _MAX_RECEIPT_BYTES else None
    except (FileNotFoundError, InvalidArtifactError, UnicodeDecodeError):
        return None
    # One that speaks of another file, as after a mix-up, says nothing about this one.
    return receipt if receipt is not None and receipt.artifact == artifact else None


class Described(Protocol):
    """What says which bytes an artifact has: its receipt, or its row of the manifest."""

    @property
    def artifact(self) -> ArtifactPath:
        """Its path relative to the job's folder."""

    @property
    def size(self) -> int:
        """Of the file [bytes]."""

    @property
    def mtime_ns(self) -> int:
        """Modification time [ns since the epoch]."""

    @property
    def hash(self) -> str:
        """blake3 of the bytes, in hexadecimal."""


FILE_IS_MISSING = "file is missing"


def verify_artifact(layout: JobLayout, receipt: Described, *, deep: bool = False) -> str | None:
    """Fault of a file by its receipt, a sentence; None if it is as it was committed.

    `deep`: hash the bytes even if size and modification time are the recorded ones.
    """
    path = layout.path(receipt.artifact)
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return FILE_IS_MISSING
    if status.st_size != receipt.size:
        return f"file was edited or truncated: size {status.st_size}, receipt says {receipt.size}"
    if not deep and status.st_mtime_ns == receipt.mtime_ns:
        return None
    if hash_file(path) != receipt.hash:
        return "file was edited: its hash differs from the receipt's"
    return None


def committed_receipt(layout: JobLayout, artifact: ArtifactPath, fingerprint: str) -> Receipt | None:
    """The artifact's receipt, if it is there, whole, and was made from this fingerprint. Needs no manifest."""
    receipt = read_receipt(layout, artifact)
    is_of_it = receipt is not None and receipt.fingerprint == fingerprint
    return receipt if receipt is not None and is_of_it and verify_artifact(layout, receipt) is None else None


def is_committed(layout: JobLayout, artifact: ArtifactPath, fingerprint: str) -> bool:
    """Whether there is such a receipt."""
    return committed_receipt(layout, artifact, fingerprint) is not None


def of_newest(receipts: Mapping[int, Receipt]) -> dict[int, Receipt]:
    """Those, by frame, with the fingerprint of the one that was committed last; others are of an earlier version."""
    newest = max(receipts.values(), key=lambda receipt: receipt.finished, default=None)
    return {
        frame: receipt
        for frame, receipt in receipts.items()
        if newest is not None and receipt.fingerprint == newest.fingerprint
    }
