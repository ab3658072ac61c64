"""Mesh files: OBJ, PLY, STL and GLB, as one solid about the origin."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.shapes.mesh_solid import MeshSolid, solid_from_triangles
from sim.shapes.obj_file import read_obj
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import Points, ShapeError

FORMATS = ("obj", "ply", "stl", "glb")
"""Formats whose geometry is all in one file, so that a copy of the file is a copy of the mesh. (A .gltf or .dae spreads
over several; the materials beside an .obj are not read.)"""

_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def load_mesh_solid(shape: MeshShape) -> MeshSolid:
    """The solid in a mesh file: upright, its bounding box centred on the origin, scaled to `size`.

    Raises:
        ShapeError: the file is missing or unreadable, or its mesh is no solid; see `solid_from_triangles`.
    """
    vertices, faces = read_upright_triangles(shape)
    return solid_from_triangles(vertices, faces, label=Path(shape.file).name)


def read_upright_triangles(shape: MeshShape) -> tuple[Points, NDArray[np.int64]]:
    """Vertices [m], (n, 3), and faces (m, 3) of a mesh: upright, its bounding box centred, scaled to `size`.

    Raises:
        ShapeError: the file is missing, of an unknown kind, or unreadable.
    """
    vertices, faces = read_triangles(Path(shape.file))
    if shape.up == "y":
        vertices = vertices @ _Y_UP_TO_Z_UP.T
    used = vertices[np.unique(faces)] if len(faces) else vertices
    if len(faces) and np.isfinite(used).all():
        lower, upper = used.min(axis=0), used.max(axis=0)
        extent = float((upper - lower).max())
        scale = shape.size / extent if shape.size is not None and extent > 0.0 else 1.0
        vertices = scale * (vertices - 0.5 * (lower + upper))
    return vertices, faces


def read_triangles(path: Path) -> tuple[Points, NDArray[np.int64]]:
    """Vertices (n, 3) and faces (m, 3) of a file, all of its objects in one mesh, as the file numbers them.

    Raises:
        ShapeError: the file is missing, of an unknown kind, or unreadable.
    """
    if not path.is_file():
        raise ShapeError(f'shape.file: must be a mesh file, "{path}" does not exist; check the path')
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise ShapeError(f'shape.file: must be an OBJ, PLY, STL or GLB file, got "{path.name}"; export it as GLB')
    try:
        vertices, faces = _read_kind(path.read_bytes(), kind)
    except Exception as error:  # a parser of foreign bytes raises anything: struct.error, IndexError, KeyError...
        raise ShapeError(
            f'shape.file: "{path}" is not a readable {kind.upper()} file '
            f"({type(error).__name__}: {error}); export it again, or convert it to PLY"
        ) from error
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ShapeError(f'shape.file: "{path}" has faces that name vertices it does not have; export it again')
    return vertices, faces


def _read_kind(content: bytes, kind: str) -> tuple[Points, NDArray[np.int64]]:
    if kind == "obj":
        return read_obj(content.decode("utf-8-sig", errors="replace"))
    import trimesh

    # Of the bytes alone: given the path, trimesh would follow references to files beside it.
    # Texture coordinates of a PLY would split its vertices.
    options = {"fix_texture": False} if kind == "ply" else {}
    mesh = trimesh.load_scene(BytesIO(content), file_type=kind, process=False, **options).to_mesh()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
