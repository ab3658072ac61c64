"""Mesh files: OBJ, PLY, STL and GLB, as one solid about the origin."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.shapes.mesh_solid import MeshSolid, solid_from_triangles
from sim.shapes.obj_file import LARGEST_TEXTURE, read_obj
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import Points, ShapeError, TriangleMesh

FORMATS = ("obj", "ply", "stl", "glb")
"""Formats whose geometry is all in one file, so that a copy of the file is a copy of the mesh."""

SAME_PLACE = 1.0e-5  # repairs move vertices by less than this many bounding-box diagonals
_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def load_mesh_solid(shape: MeshShape) -> MeshSolid:
    """The solid in a mesh file: upright, its bounding box centred on the origin, scaled to `size`.

    Raises:
        ShapeError: the file is missing or unreadable, or its mesh is no solid; see `solid_from_triangles`.
    """
    vertices, faces = read_upright_triangles(shape)
    return solid_from_triangles(vertices, faces, label=Path(shape.file).name)


def read_upright_triangles(shape: MeshShape) -> tuple[Points, NDArray[np.int64]]:
    """As `read_triangles`, in metres: upright, the bounding box centred, scaled to `size`."""
    vertices, faces = read_triangles(Path(shape.file))
    return _upright(vertices, faces, shape), faces


def texture_coordinates(mesh: TriangleMesh, shape: MeshShape) -> NDArray[np.float32] | None:
    """Texture coordinates (m, 3, 2) of every corner of the unscaled rest mesh of a file's solid; None if it has none.

    From a picture's lower left corner (0, 0) to its upper right (1, 1). Caps over holes go on with what their nearest
    corners have. Raises ShapeError where the file cannot be read.
    """
    from scipy.spatial import cKDTree

    found = read_texture_coordinates(shape)
    if found is None:
        return None
    corners, uv = found
    own = mesh.corners
    # Both faces at a corner of a seam are there; the triangle says which of them counts, and then the corner's place.
    away, triangle = cKDTree(corners.mean(axis=1)).query(own.mean(axis=1))
    offsets = np.linalg.norm(own[:, :, None] - corners[triangle][:, None], axis=3)
    coordinates = np.take_along_axis(uv[triangle], offsets.argmin(axis=2)[:, :, None], axis=1)
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    of_cap = (away > SAME_PLACE * diagonal) | (offsets.min(axis=2).max(axis=1) > SAME_PLACE * diagonal)
    if of_cap.any():
        _, nearest = cKDTree(corners.reshape(-1, 3)).query(own[of_cap].reshape(-1, 3))
        coordinates[of_cap] = uv.reshape(-1, 2)[nearest].reshape(-1, 3, 2)
    return coordinates.astype(np.float32)


def read_texture_coordinates(shape: MeshShape) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Corners of a file's triangles [m], (m, 3, 3), upright and centred, and their texture coordinates, (m, 3, 2).

    None if the file has none; parts of it without them have 0. Raises ShapeError as `read_triangles` does.
    """
    from trimesh import Trimesh

    path = Path(shape.file)
    vertices, faces = read_triangles(path)
    if not len(faces):
        return None
    content = path.read_bytes()
    if path.suffix.lower() == ".obj":
        uv = read_obj(_obj_text(content))[2]
        corners = _upright(vertices, faces, shape)[faces]
        return None if uv is None else (corners, uv)
    scene = _load(content, path.suffix.lower().removeprefix("."))
    pieces = [piece for piece in scene.dump() if isinstance(piece, Trimesh)]  # points and lines have no triangles
    uvs = [_uv_of(piece) for piece in pieces]
    if all(uv is None for uv in uvs):
        return None
    corners = np.concatenate([np.asarray(piece.triangles, dtype=np.float64) for piece in pieces])
    corners = _upright(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), shape).reshape(-1, 3, 3)
    filled = [
        np.zeros((len(piece.faces), 3, 2)) if uv is None else uv[piece.faces]
        for piece, uv in zip(pieces, uvs, strict=True)
    ]
    return corners, np.concatenate(filled)


def _uv_of(piece: Any) -> NDArray[np.float64] | None:
    """Texture coordinates of a mesh's vertices (n, 2), or None if one of them is not finite in float32."""
    uv = getattr(piece.visual, "uv", None)
    fits = uv is not None and np.shape(uv) == (len(piece.vertices), 2) and (np.abs(uv) <= LARGEST_TEXTURE).all()
    return np.asarray(uv, dtype=np.float64) if fits else None


def _upright(vertices: Points, faces: NDArray[np.int64], shape: MeshShape) -> Points:
    """The vertices upright, the bounding box of those that faces use centred, scaled to `size` [m]."""
    if shape.up == "y":
        vertices = vertices @ _Y_UP_TO_Z_UP.T
    used = vertices[np.unique(faces)] if len(faces) else vertices
    if len(faces) and np.isfinite(used).all():
        lower, upper = used.min(axis=0), used.max(axis=0)
        extent = float((upper - lower).max())
        scale = shape.size / extent if shape.size is not None and extent > 0.0 else 1.0
        vertices = scale * (vertices - 0.5 * (lower + upper))
    return vertices


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
        return read_obj(_obj_text(content))[:2]
    # Texture coordinates of a PLY would split its vertices.
    mesh = _load(content, kind, **({"fix_texture": False} if kind == "ply" else {})).to_mesh()
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _obj_text(content: bytes) -> str:
    return content.decode("utf-8-sig", errors="replace")


def _load(content: bytes, kind: str, **options: Any) -> Any:
    """The scene in the bytes alone: given the path, trimesh would follow references to files beside it."""
    import trimesh

    return trimesh.load_scene(BytesIO(content), file_type=kind, process=False, **options)
