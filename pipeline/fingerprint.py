"""Fingerprints: what decides an artifact's content, as a digest.

fingerprint(task) = blake3(parameters of the task, (path, hash) of each input artifact)
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from pipeline.parameter_set import digest_of
from pipeline.task import ArtifactPath, Task


def task_fingerprint(task: Task, hashes: Mapping[ArtifactPath, str]) -> str:
    """Digest of everything that decides what a task's outputs hold.

    Args:
        task: the task.
        hashes: content hash of each of its inputs; more may be in it.

    Raises:
        KeyError: an input has no hash yet.
    """
    document = [task.parameters.digest, [[path, hashes[path]] for path in task.inputs]]
    return digest_of(json.dumps(document, separators=(",", ":")))
