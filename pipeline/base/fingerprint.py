"""Fingerprints: what decides an artifact's content, as a digest.

fingerprint(task) = blake3(parameters of the task, (path, hash) of each input artifact)
"""

from __future__ import annotations

from collections.abc import Mapping
from json.encoder import encode_basestring_ascii

from pipeline.base.parameter_set import digest_of
from pipeline.base.task import ArtifactPath, Task

_quoted = encode_basestring_ascii


def task_fingerprint(task: Task, hashes: Mapping[ArtifactPath, str]) -> str:
    """Digest of everything that decides what a task's outputs hold.

    `hashes` are those of its inputs' contents, and maybe of more files. Raises KeyError if an input has none.
    """
    # As json.dumps(..., separators=(",", ":")) writes [digest, [[path, hash], ...]], in a third of its time.
    inputs = ",".join([f"[{_quoted(path)},{_quoted(hashes[path])}]" for path in task.inputs])
    return digest_of(f"[{_quoted(task.parameters.digest)},[{inputs}]]")
