"""What is in a .blend file, asked of Blender in a process of its own: it may be one that crashes its reader."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from render.blender import BlenderUnavailableError
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
    argv = build_argv(path, blender, tried)
    try:
        completed = subprocess.run(argv, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except OSError as error:
        raise BlenderUnavailableError(f"cannot start {argv[0]}: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise BlenderUnavailableError(f"Blender took more than {error.timeout:g} s to read {path}") from error
    for line in completed.stdout.splitlines():
        word, _, rest = line.partition(" ")
        if word == "MATERIALS":
            return [str(name) for name in json.loads(rest)]
        if word == "MATERIALS_FAILED":
            raise InvalidFileError(path, rest)
    last = (completed.stdout + completed.stderr).strip().rpartition("\n")[2]
    raise InvalidFileError(path, f"Blender ended with exit code {completed.returncode} while it read it: {last}")


def build_argv(path: Path, blender: str | None, tried: Sequence[str] = ()) -> list[str]:
    """Arguments that make Blender write the names of a file's materials, and try some. Pure.

    `--disable-autoexec`: nothing that the file holds is run.
    """
    package = find_spec("blender_scripts")
    if package is None or package.origin is None:
        raise BlenderUnavailableError("the folder blender_scripts of this project is not on Python's path")
    script = str(Path(package.origin).with_name("blend_materials.py"))
    if blender is None:
        return [sys.executable, script, str(path), *tried]
    return [
        blender,
        "--background",
        "--factory-startup",
        "--disable-autoexec",
        "--python",
        script,
        "--",
        str(path),
        *tried,
    ]
