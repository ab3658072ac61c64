"""What is in a .blend file, asked of Blender in a process of its own: it may be one that crashes its reader."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from render.blender import run_script, script_argv
from render.errors import InvalidFileError

_TIMEOUT_S = 120.0


def read_material_names(path: Path, blender: str | None, *, tried: Sequence[str] = ()) -> list[str]:
    """Names of the materials in a .blend file, in any order.

    Args:
        path: the file.
        blender: a Blender executable; the bpy module if None.
        tried: materials that are appended as for a picture, if they are there.

    Raises:
        BlenderUnavailableError: Blender does not answer.
        InvalidFileError: the file cannot be read, or a material that is tried needs more than is in the file.
    """
    argv = script_argv(blender, "blend_materials.py", [str(path), *tried])
    completed = run_script(argv, timeout_s=_TIMEOUT_S, purpose=f"read {path}")
    for line in completed.stdout.splitlines():
        word, _, rest = line.partition(" ")
        if word == "MATERIALS":
            return [str(name) for name in json.loads(rest)]
        if word == "MATERIALS_FAILED":
            raise InvalidFileError(path, rest)
    last = (completed.stdout + completed.stderr).strip().rpartition("\n")[2]
    raise InvalidFileError(path, f"Blender ended with exit code {completed.returncode} while it read it: {last}")
