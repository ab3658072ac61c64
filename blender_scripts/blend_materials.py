"""Materials of .blend files: their names, and one of them for a scene, without anything in the file being run.

    blender --background --factory-startup --disable-autoexec --python blend_materials.py -- FILE [NAME ...]

writes the names to standard output as a line `MATERIALS ["...", ...]`, among the lines that Blender itself writes, or a
line `MATERIALS_FAILED reason`; so does `python blend_materials.py FILE` with the bpy module. Those that are named are
also tried, if they are there, and before that line comes one of the pictures in them, each once, as
`TEXTURES [{"width": 4096, "height": 4096, "float": false}, ...]`.
"""

from __future__ import annotations

import difflib
import json
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

if __package__ in (None, ""):
    # Run as a script: the package is not on the path.
    # Last: where the program is installed, that folder holds packages of another Python than Blender's as well.
    sys.path.append(str(Path(__file__).resolve().parents[1]))

import bpy

from blender_scripts.errors import RenderInputError

SUFFIX = ".blend"


def split_reference(reference: str) -> tuple[str, str]:
    """File and name of `file.blend:Name`."""
    file, _, name = reference.partition(f"{SUFFIX}:")
    return file + SUFFIX, name


def material_names(path: Path) -> list[str]:
    """Names of the materials in a .blend file.

    Raises:
        RenderInputError: it cannot be read.
    """
    try:
        with bpy.data.libraries.load(str(path), link=False) as (there, _):
            return list(there.materials)
    except OSError as error:
        raise RenderInputError(f"cannot read the materials of {path}: {error}") from error


def append_material(path: Path, name: str) -> Any:
    """A copy of a material in this scene.

    Drivers and key frames are taken off it: a driver may hold a program, and none of a file's is run.

    Raises:
        RenderInputError: the file cannot be read, has no such material, or one that needs further files.
    """
    names = material_names(path)
    if name not in names:
        close = difflib.get_close_matches(name.lower(), [each.lower() for each in names], n=1)
        hint = next((f'; did you mean "{each}"?' for each in names if [each.lower()] == close), "")
        known = f"there are {', '.join(sorted(names))}" if names else "it has none"
        raise RenderInputError(f'{path} has no material "{name}"{hint}; {known}')
    with bpy.data.libraries.load(str(path), link=False) as (_, wanted):
        wanted.materials = [name]
    material = wanted.materials[0]
    for owner in (material, *_trees(material.node_tree)):
        owner.animation_data_clear()
    for tree in _trees(material.node_tree):
        if tree.library is not None:
            raise RenderInputError(f'the material "{name}" of {path} uses "{tree.name}" of another file; make it local')
        for node in tree.nodes:
            _require_nothing_else(path, name, node)
            if hasattr(node, "uv_map"):
                node.uv_map = ""  # a mesh has one map at most, by a name that the file does not know
    return material


def textures(materials: Iterable[Any]) -> list[dict[str, Any]]:
    """Sizes of the pictures in materials [pixels], each once, and whether their pixels are floats."""
    nodes = [node for material in materials for tree in _trees(material.node_tree) for node in tree.nodes]
    images = {image.name: image for node in nodes if (image := getattr(node, "image", None)) is not None}
    return [{"width": each.size[0], "height": each.size[1], "float": each.is_float} for each in images.values()]


def has_pictures_by_uv(material: Any) -> bool:
    """Whether a picture in it lies by a UV map of its mesh, as one does that nothing else is linked to."""
    nodes = [node for tree in _trees(material.node_tree) for node in tree.nodes]
    asks = any(
        node.bl_idname == "ShaderNodeUVMap" or (node.bl_idname == "ShaderNodeTexCoord" and node.outputs["UV"].is_linked)
        for node in nodes
    )
    pictures = [node for node in nodes if node.bl_idname == "ShaderNodeTexImage" and node.image is not None]
    return any(asks or not node.inputs["Vector"].is_linked for node in pictures)


def _trees(tree: Any) -> Iterator[Any]:
    """A node tree, and those of the groups in it."""
    if tree is None:
        return
    yield tree
    for node in tree.nodes:
        yield from _trees(getattr(node, "node_tree", None))


def _require_nothing_else(path: Path, name: str, node: Any) -> None:
    """Refuse what a node needs beside the material: files, and objects, with whom drivers and key frames would come."""
    if getattr(node, "object", None) is not None:
        raise RenderInputError(
            f'the material "{name}" of {path} depends on the object "{node.object.name}", which a job has none of'
        )
    if node.bl_idname in ("ShaderNodeTexIES", "ShaderNodeScript") and node.mode == "EXTERNAL":
        raise RenderInputError(f'the material "{name}" of {path} needs the file {node.filepath}; make it internal')
    image = getattr(node, "image", None)
    if image is not None and image.source != "GENERATED" and not image.packed_files:
        raise RenderInputError(
            f'the material "{name}" of {path} needs the picture {image.filepath}, which is not in the file; '
            "pack it there (File > External Data > Pack Resources)"
        )


def main(arguments: list[str]) -> int:
    """Write the names of a file's materials, and try some."""
    path, wanted = Path(arguments[0]), arguments[1:]
    try:
        names = material_names(path)
        tried = [append_material(path, name) for name in wanted if name in names]
        sys.stdout.write(f"TEXTURES {json.dumps(textures(tried))}\n")
        sys.stdout.write(f"MATERIALS {json.dumps(names)}\n")
    except RenderInputError as error:
        sys.stdout.write(f"MATERIALS_FAILED {str(error).replace(chr(10), ' ')}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]))
