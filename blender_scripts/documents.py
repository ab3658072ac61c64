"""Files that the project writes for Blender. JSON documents say their version, and a reader takes one only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from blender_scripts.errors import RenderInputError


def content_of(path: Path, name: str) -> bytes:
    """Content of a file; `name` says in messages what it is: "poses".

    Raises:
        RenderInputError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise RenderInputError(f"cannot read the {name} {path}: {error.strerror}") from error


def read_document(path: Path, name: str, *, version: int) -> dict[str, Any]:
    """The document in a file.

    Raises:
        RenderInputError: the file cannot be read, holds no JSON object, or one of another version.
    """
    try:
        document = json.loads(content_of(path, name).decode())
    except ValueError as error:
        raise RenderInputError(f"the {name} {path}: not JSON: {error}") from error
    found = document.get("version") if isinstance(document, dict) else None
    if found != version:
        raise RenderInputError(f"the {name} {path}: version {found}, and {version} is needed")
    return document


def numbers_of(values: dict[str, Any], lengths: dict[str, int], where: str, of: str = "") -> dict[str, np.ndarray]:
    """The vectors of these lengths in a part of a document.

    Raises:
        RenderInputError: one is missing, longer or shorter, or not finite.
    """
    arrays = {}
    for key, length in lengths.items():
        arrays[key] = np.atleast_1d(np.asarray(values.get(key, ()), dtype=np.float64))
        if arrays[key].shape != (length,) or not np.isfinite(arrays[key]).all():
            raise RenderInputError(f"{where}: {key}{of} must be {length} finite numbers")
    return arrays
