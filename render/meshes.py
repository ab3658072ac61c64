"""Triangle meshes as binary PLY files, written and read with numpy alone.

Layout (docs/guide/formats.md): binary little endian; vertices `x y z [nx ny nz] [vx vy vz] [s t]`, all float32; faces
as a list of one uchar (always 3) and int32 indices, and where bodies have texture coordinates a list of one uchar
(always 6) and the float32 u, v of each corner. A mesh without vertices is legal: a frame without fluid.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import InvalidFileError

Float32Array = NDArray[np.float32]
Int32Array = NDArray[np.int32]

_FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])
_TEXTURED_FACE = np.dtype([*_FACE.descr, ("uv_count", "u1"), ("corner_uv", "<f4", (3, 2))])
_FACE_LINES = {
    _FACE: ("property list uchar int vertex_indices",),
    _TEXTURED_FACE: ("property list uchar int vertex_indices", "property list uchar float texcoord"),
}
_GROUPS = {
    "position": ("x", "y", "z"),
    "normal": ("nx", "ny", "nz"),
    "velocity": ("vx", "vy", "vz"),
    "uv": ("s", "t"),
}
_LONGEST_HEADER = 4096
_HEADER_END = b"end_header\n"


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles in world axes, counter-clockwise as seen from outside.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32 vertex indices.
        normals: (n, 3) float32 unit vectors that point out, or None.
        velocities: (n, 3) float32 [m/s], or None.
        uv: (n, 2) float32 coordinates on the surface at rest [m], or None.
        corner_uv: (m, 3, 2) float32 coordinates on pictures, of the corners of faces, or None.
    """

    vertices: Float32Array
    faces: Int32Array
    normals: Float32Array | None = None
    velocities: Float32Array | None = None
    uv: Float32Array | None = None
    corner_uv: Float32Array | None = None


@dataclass(frozen=True)
class _Header:
    vertex_count: int
    face_count: int
    properties: tuple[str, ...]
    face: np.dtype[np.void]
    size: int

    @property
    def text(self) -> bytes:
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {self.vertex_count}",
            *(f"property float {name}" for name in self.properties),
            f"element face {self.face_count}",
            *_FACE_LINES[self.face],
        ]
        return "\n".join(lines).encode("ascii") + b"\n" + _HEADER_END

    @property
    def vertex_bytes(self) -> int:
        return 4 * len(self.properties) * self.vertex_count

    @property
    def file_size(self) -> int:
        return self.size + self.vertex_bytes + self.face.itemsize * self.face_count


def write_ply(
    path: Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    velocities: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    corner_uv: ArrayLike | None = None,
) -> None:
    """Write a triangle mesh; the same arrays give the same bytes.

    Args:
        path: the file to write.
        vertices: (n, 3) [m], stored as float32.
        faces: (m, 3) vertex indices, stored as int32.
        normals: (n, 3) unit vectors, or None.
        velocities: (n, 3) [m/s], or None.
        uv: (n, 2) coordinates on the surface at rest [m], or None.
        corner_uv: (m, 3, 2) coordinates on pictures, of the corners of faces, or None.

    Raises:
        ValueError: the shapes do not fit together.
    """
    groups = {"position": vertices, "normal": normals, "velocity": velocities, "uv": uv}
    columns = {name: _as_rows(name, value, len(_GROUPS[name])) for name, value in groups.items() if value is not None}
    triangles = _as_rows("faces", faces, 3)
    counts = {name: len(column) for name, column in columns.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"a mesh needs as many of each per vertex, got {counts}")
    properties = tuple(name for group in columns for name in _GROUPS[group])
    face = _FACE if corner_uv is None else _TEXTURED_FACE
    header = _Header(counts["position"], len(triangles), properties, face, size=0)

    rows = np.empty((header.vertex_count, len(properties)), "<f4")
    for name, start in _group_starts(properties):
        rows[:, start : start + len(_GROUPS[name])] = columns[name]
    records = np.empty(len(triangles), face)
    records["count"] = 3
    records["indices"] = triangles
    if corner_uv is not None:
        coordinates = np.asarray(corner_uv)
        if coordinates.shape != (len(triangles), 3, 2):
            raise ValueError(f"corner_uv must have the shape ({len(triangles)}, 3, 2), got {coordinates.shape}")
        records["uv_count"] = 6
        records["corner_uv"] = coordinates
    with path.open("wb") as file:
        file.write(header.text)
        file.write(rows.data)
        file.write(records.data)


def read_ply(path: Path) -> SurfaceMesh:
    """Read a mesh that `write_ply` wrote.

    Raises:
        InvalidFileError: it is not of this layout, or its size is not the one that its header promises.
        OSError: it cannot be read.
    """
    content = path.read_bytes()
    header = _parse_header(path, content)
    if len(content) != header.file_size:
        raise InvalidFileError(path, f"{len(content)} bytes, but its header promises {header.file_size}")
    rows = np.frombuffer(content, "<f4", header.vertex_count * len(header.properties), offset=header.size)
    rows = rows.reshape(header.vertex_count, len(header.properties))
    records = np.frombuffer(content, header.face, header.face_count, offset=header.size + header.vertex_bytes)
    if (records["count"] != 3).any():
        raise InvalidFileError(path, "has a face that is not a triangle")
    is_textured = header.face is _TEXTURED_FACE
    if is_textured and (records["uv_count"] != 6).any():
        raise InvalidFileError(path, "has a face without two texture coordinates for each corner")
    columns = {
        group: np.ascontiguousarray(rows[:, start : start + len(_GROUPS[group])], np.float32)
        for group, start in _group_starts(header.properties)
    }
    return SurfaceMesh(
        vertices=columns["position"],
        faces=np.ascontiguousarray(records["indices"], np.int32),
        normals=columns.get("normal"),
        velocities=columns.get("velocity"),
        uv=columns.get("uv"),
        corner_uv=np.ascontiguousarray(records["corner_uv"], np.float32) if is_textured else None,
    )


def validate_ply(path: Path) -> None:
    """Decode a mesh fully: its size is exactly as promised, every number finite, every index in range.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
    """
    mesh = read_ply(path)
    columns = {"position": mesh.vertices, "normal": mesh.normals, "velocity": mesh.velocities, "uv": mesh.uv}
    for name, column in columns.items():
        if column is not None and not np.isfinite(column).all():
            row = int(np.flatnonzero(~np.isfinite(column).all(axis=1))[0])
            raise InvalidFileError(path, f"{name} of vertex {row} is not finite: {column[row].tolist()}")
    if mesh.corner_uv is not None and not np.isfinite(mesh.corner_uv).all():
        face = int(np.flatnonzero(~np.isfinite(mesh.corner_uv).all(axis=(1, 2)))[0])
        raise InvalidFileError(path, f"texture coordinates of face {face} are not finite")
    if mesh.faces.size and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        bad = mesh.faces[(mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))][0]
        raise InvalidFileError(path, f"a face names vertex {bad}, but there are {len(mesh.vertices)}")


def _as_rows(name: str, values: ArrayLike, width: int) -> NDArray[np.generic]:
    rows = np.asarray(values)
    if rows.size == 0:
        return rows.reshape(0, width)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name} must have the shape (n, {width}), got {rows.shape}")
    return rows


def _parse_header(path: Path, content: bytes) -> _Header:
    end = content.find(_HEADER_END, 0, _LONGEST_HEADER)
    if end < 0:
        raise InvalidFileError(path, "has no PLY header")
    size = end + len(_HEADER_END)
    elements: dict[str, int] = {}
    properties: list[str] = []
    for line in io.BytesIO(content[:size]):
        match line.split():
            case [b"element", name, count] if count.isdigit():
                elements[name.decode("ascii", "replace")] = int(count)
            case [b"property", b"float", name]:
                properties.append(name.decode("ascii", "replace"))
    face = _TEXTURED_FACE if b"texcoord" in content[:size] else _FACE
    header = _Header(elements.get("vertex", 0), elements.get("face", 0), tuple(properties), face, size)
    # Comparing with the header that we would have written refuses every other layout in one place.
    if header.text != content[:size] or [group for group, _ in _group_starts(header.properties)][:1] != ["position"]:
        raise InvalidFileError(path, "is not a PLY of the expected layout (docs/guide/formats.md)")
    return header


def _group_starts(properties: tuple[str, ...]) -> Iterator[tuple[str, int]]:
    position = 0
    for group, names in _GROUPS.items():
        if properties[position : position + len(names)] == names:
            yield group, position
            position += len(names)
