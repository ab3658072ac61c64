"""Mesh files: OBJ, PLY, STL and GLB, as one solid about the origin, with the texture coordinates of its corners."""

from __future__ import annotations

from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.shapes.mesh_solid import MeshSolid, solid_from_triangles
from sim.shapes.parameters import MeshShape
from sim.shapes.solid import Points, ShapeError, TriangleMesh

FORMATS = ("obj", "ply", "stl", "glb")  # whose geometry is all in one file: a copy of it is a copy of the mesh
SAME_PLACE = 1.0e-5  # repairs move vertices by less than this many bounding-box diagonals
_Y_UP_TO_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

ROUND_OFF = 1.0e-2  # part of a polygon's area by which its triangles may overlap: files of few digits
LARGEST_TEXTURE = float(np.finfo(np.float32).max)  # beyond it coordinates are infinite in float32


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
        found = "is no file" if path.exists() else "does not exist; check the path"
        raise ShapeError(f'shape.file: must be a mesh file, "{path}" {found}')
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
    if kind == "ply" and len(mesh.faces) < (announced := _ply_header(content)[1].get("face", 0)):
        raise ValueError(f"{announced} faces are announced, {len(mesh.faces)} are there")
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)


def _obj_text(content: bytes) -> str:
    return content.decode("utf-8-sig", errors="replace")


def _load(content: bytes, kind: str, **options: Any) -> Any:
    """The scene in the bytes alone: given the path, trimesh would follow references to files beside it."""
    import trimesh

    if kind == "ply":
        header, counts = _ply_header(content)
        body = content[len(header) :]
        if sum(counts.values()) > len(body):
            told = ", ".join(f"{count} of {name}" for name, count in counts.items())
            raise ValueError(f"its header announces {told}, in {len(body)} bytes")
        # A comment may name a picture, which is not read here.
        comments = (b"comment", b"obj_info")
        content = b"".join(line for line in header.splitlines(keepends=True) if not line.startswith(comments)) + body
    return trimesh.load_scene(BytesIO(content), file_type=kind, process=False, **options)


def _ply_header(content: bytes) -> tuple[bytes, dict[str, int]]:
    """The header of a PLY up to its last line, and how many of each element it announces.

    Raises ValueError: it has no end, or a number that is none.
    """
    header = content[: content.index(b"end_header")]
    words = (line.split() for line in header.splitlines())
    counts = {each[1].decode(errors="replace"): int(each[2]) for each in words if each[:1] == [b"element"]}
    if any(count < 0 for count in counts.values()):
        raise ValueError("its header announces less than nothing")
    return header, counts


def read_obj(text: str) -> tuple[Points, NDArray[np.int64], NDArray[np.float64] | None]:
    """Vertices (n, 3) in the order of the file, triangles (m, 3), and texture coordinates of their corners (m, 3, 2).

    Only `v`, `vt` and `f` lines are read. Texture coordinates belong to the corners of triangles: a reader that gives
    them to vertices splits these at seams, and their numbers are no longer those of the file, by which pins name them.
    Polygons become fans about their first corner. Coordinates are 0 where a corner names none that is there and can be
    used, and None for a file without any.

    Raises:
        ValueError: a `v` or `f` line cannot be read, or has a polygon that such a fan does not fill; named by line.
    """
    vertices: list[tuple[float, float, float]] = []
    triangles: list[tuple[int, int, int]] = []
    texture: list[tuple[float, float]] = [(0.0, 0.0)]  # numbered from 1, as in the file
    textured: list[tuple[int, int, int]] = []
    lines: list[int] = []  # of each triangle
    begun = ""
    for number, line in enumerate([*text.splitlines(), ""], start=1):  # the empty one ends what the last one began
        content = line.partition("#")[0].rstrip()  # comments do not go on in the next line
        if content.endswith("\\"):
            begun += content[:-1] + " "
            continue
        whole, begun = begun + content, ""
        key, *values = whole.split() or [""]
        try:
            if key == "v":
                x, y, z = (float(value) for value in values[:3])
                vertices.append((x, y, z))
            elif key == "vt":
                texture.append(_texture_place(values))
            elif key == "f":
                corners = [_vertex_number(value, len(vertices)) for value in values]
                if len(corners) < 3:
                    raise ValueError(f"a face needs three corners or more, got {len(corners)}")
                triangles.extend((corners[0], after, last) for after, last in pairwise(corners[1:]))
                places = [_texture_number(value, len(texture)) for value in values]
                textured.extend((places[0], after, last) for after, last in pairwise(places[1:]))
                lines.extend([number] * (len(corners) - 2))
        except ValueError as error:
            raise ValueError(f'line {number}, "{whole.strip()[:60]}": {error}') from error
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.array(triangles, dtype=np.int64).reshape(-1, 3)
    _refuse_overlaps(points, faces, np.array(lines, dtype=np.int64))
    if len(texture) == 1:
        return points, faces, None
    return points, faces, np.array(texture)[np.array(textured, dtype=np.int64).reshape(-1, 3)]


def _refuse_overlaps(vertices: Points, triangles: NDArray[np.int64], lines: NDArray[np.int64]) -> None:
    """Refuse polygons, by the line of each triangle, (m,), whose fan has triangles that face the other way.

    Vertices that are not there, or not finite, are left to who knows the file.
    """
    known = (triangles < len(vertices)).all(axis=1)
    first, second, third = np.moveaxis(vertices[triangles[known]], 1, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        normal = np.cross(second - first, third - first)
        own, polygon = np.unique(lines[known], return_inverse=True)
        total = np.stack([np.bincount(polygon, normal[:, axis], len(own)) for axis in range(3)], axis=1)
        along = (normal * total[polygon]).sum(axis=1)
        opposes = along < -ROUND_OFF * np.square(total[polygon]).sum(axis=1)
    if opposes.any():
        raise ValueError(
            f"line {lines[known][opposes.argmax()]}: a concave polygon, which triangles about its first corner do not "
            "fill; divide polygons into triangles on export"
        )


def _vertex_number(corner: str, count: int) -> int:
    """From 0, of the vertex in v, v/vt, v//vn or v/vt/vn; negative numbers count back from the latest of `count`."""
    number = int(corner.partition("/")[0])
    if number == 0 or number < -count:
        raise ValueError(f"a face names vertex {number}; {count} are there, numbered from 1")
    return number - 1 if number > 0 else count + number


def _texture_place(values: list[str]) -> tuple[float, float]:
    """Texture coordinates in a `vt` line; 0 if they cannot be read or are not finite in the float32 of meshes."""
    try:
        u, v, *_ = (*(float(value) for value in values[:2]), 0.0)  # one alone is a place on a strip
    except ValueError:
        return 0.0, 0.0
    return (u, v) if abs(u) <= LARGEST_TEXTURE and abs(v) <= LARGEST_TEXTURE else (0.0, 0.0)


def _texture_number(corner: str, count: int) -> int:
    """From 1, of the texture coordinates in v/vt or v/vt/vn, of fewer than `count`; 0 where there are none."""
    _, _, rest = corner.partition("/")
    word = rest.partition("/")[0]
    number = int(word) if word else 0
    number = count + number if number < 0 else number
    return number if 0 < number < count else 0
