"""JSON documents that the project writes for Blender: each says its version, and a reader takes one only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from blender_scripts.errors import RenderInputError


def read_document(path: Path, name: str, *, version: int) -> dict[str, Any]:
    """The document in a file.

    Args:
        path: the file.
        name: what it is, for error messages: "poses".
        version: the one that the caller can read.

    Raises:
        RenderInputError: the file cannot be read, holds no JSON object, or one of another version.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RenderInputError(f"cannot read the {name} {path}: {error.strerror}") from error
    except ValueError as error:
        raise RenderInputError(f"the {name} {path}: not JSON: {error}") from error
    found = document.get("version") if isinstance(document, dict) else None
    if found != version:
        raise RenderInputError(f"the {name} {path}: version {found}, and {version} is needed")
    return document
