"""Checks of the files that a job names."""

from __future__ import annotations

from pathlib import Path

from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, suggestion
from sim.shapes.parameters import MeshShape


def mesh_exists(shape: object, path: KeyPath, findings: Findings) -> bool:
    """Whether a shape needs no file, or its file is there; notes what is wrong, and the name that may be meant.

    Args:
        shape: of a body or a cloth.
        path: of the table that the shape is in.
        findings: where errors go.
    """
    if not isinstance(shape, MeshShape):
        return True
    return file_exists(shape.file, "mesh", (*path, "shape", "file"), findings)


def file_exists(name: str, kind: str, key: KeyPath, findings: Findings) -> bool:
    """Whether a file is there; notes what is wrong, and the name that may be meant.

    Args:
        name: its absolute path.
        kind: what it is, for messages: "mesh".
        key: that names it.
        findings: where errors go.
    """
    file = Path(name)
    if file.is_file():
        return True
    if file.is_dir():
        findings.error(key, f"{file} is a folder, not a {kind}")
    elif not file.parent.is_dir():
        findings.error(key, f"no such file: {file}; there is no folder {file.parent}")
    else:
        neighbours = [each.name for each in file.parent.iterdir()]
        findings.error(key, f"no such file: {file}{suggestion(file.name, neighbours)}")
    return False
