"""Fingerprints: what decides an artifact's content, as a digest.

    fingerprint(task) = blake3(parameters of the task, (path, hash) of each input artifact)

A parameter set holds what the stage reads of the job, the stage's version, the versions of the tools that do the work
and the hashes of files from outside the job's folder. Comments, key order and keys that the stage does not read are
not in it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from blake3 import blake3
from pydantic import BaseModel


def digest_of(text: str) -> str:
    """blake3 of a text, in hexadecimal."""
    return blake3(text.encode()).hexdigest()


@dataclass(frozen=True)
class ParameterSet:
    """Canonical JSON of everything but the inputs that decides a task's outputs."""

    canonical: str

    @cached_property
    def digest(self) -> str:
        """Digest of the canonical text."""
        return digest_of(self.canonical)

    @classmethod
    def of(cls, *, stage: str, version: int, tools: Mapping[str, str], **values: Any) -> ParameterSet:
        """Collect parameters; models and plain JSON values alike, in any order."""
        document = {
            "stage": stage,
            "stage_version": version,
            "tools": dict(tools),
            **{name: _plain(value) for name, value in values.items()},
        }
        return cls(json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value
