"""Contents of a .blend file, read by Blender in a child process, as a damaged file may crash its reader."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from render.blender import early_end, run_script, script_argv
from render.errors import InvalidFileError
from render.suffixed import read_as, written_as

_TIMEOUT_S = 120.0
_OGAWA = struct.Struct("<5sBHQ")  # name, 255 once it is closed, version, where the root group is
_SCENE_S, _SCENE_S_PER_FRAME = 300.0, 5.0  # lamps of fires take a look at each frame's volume


class Texture(NamedTuple):
    """A picture in a material: its size [pixels], and whether its pixels are floats or bytes."""

    width: int
    height: int
    floats: bool


def read_textures(path: Path, name: str, blender: str | None) -> list[Texture]:
    """The pictures in a material of a .blend file, each once; empty if it is not there. See `read_material_names`."""
    told = json.loads(_ask(path, blender, [name], "TEXTURES"))
    return [Texture(int(each["width"]), int(each["height"]), bool(each["float"])) for each in told]


def read_material_names(path: Path, blender: str | None, *, tried: Sequence[str] = ()) -> list[str]:
    """Names of the materials in a .blend file, by a Blender executable, or the bpy module if None.

    Those that are tried are appended as for a picture, if they are there.

    Raises:
        BlenderUnavailableError: Blender does not answer.
        InvalidFileError: the file cannot be read, or a material that is tried needs more than is in the file.
    """
    return [str(name) for name in json.loads(_ask(path, blender, tried, "MATERIALS"))]


def write_scene_file(path: Path, spec: Path, frames: Sequence[int], blender: str | None, *, suffix: str) -> None:
    """Write the scene of a RenderSpec document, of these frames: .blend with all of it, or .abc with its meshes.

    Raises:
        BlenderUnavailableError: Blender does not answer.
        InvalidFileError: a file of a frame is missing or unfit.
    """
    with written_as(path, suffix) as named:
        argv = script_argv(blender, "scene_file.py", [str(spec.resolve()), json.dumps(list(frames)), str(named)])
        purpose = "write the scene"
        completed = run_script(argv, timeout_s=_SCENE_S + _SCENE_S_PER_FRAME * len(frames), purpose=purpose)
        if "\nSCENE_SAVED" in f"\n{completed.stdout}":
            return
        refused = [line for line in completed.stdout.splitlines() if line.startswith("SCENE_FAILED ")]
        raise InvalidFileError(
            spec, refused[0].partition(" ")[2] if refused else early_end(completed, "wrote the scene")
        )


def validate_scene_file(path: Path, blender: str | None) -> None:
    """Let Blender read a .blend file. Raises InvalidFileError: it cannot, or there is no material in it."""
    with read_as(path, ".blend") as named:
        if not read_material_names(named, blender):
            raise InvalidFileError(path, "has no material, as any scene has")


def validate_alembic(path: Path) -> None:
    """Look whether an Alembic file of the Ogawa kind was closed, and begins where it says.

    Raises:
        InvalidFileError: it is damaged.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(_OGAWA.size)
    if len(head) < _OGAWA.size or not head.startswith(b"Ogawa"):
        raise InvalidFileError(path, "is not an Alembic file")
    _, closed, _, root = _OGAWA.unpack(head)
    if closed != 0xFF or root >= path.stat().st_size:
        raise InvalidFileError(path, "was truncated")


def _ask(path: Path, blender: str | None, tried: Sequence[str], wanted: str) -> str:
    """The rest of the script's line that begins with a word."""
    argv = script_argv(blender, "blend_materials.py", [str(path), *tried])
    completed = run_script(argv, timeout_s=_TIMEOUT_S, purpose=f"read {path}")
    for line in completed.stdout.splitlines():
        word, _, rest = line.partition(" ")
        if word == wanted:
            return rest
        if word == "MATERIALS_FAILED":
            raise InvalidFileError(path, rest)
    raise InvalidFileError(path, early_end(completed, "read it"))
