"""Binary PLY files of triangle meshes and of whitewater: their layout, and how they are read, with numpy alone.

docs/guide/formats.md describes the layout. Readers refuse every other one, by comparing with the header that would have
been written. Nothing to draw is legal: a mesh without vertices, a cloud without points.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FACE = np.dtype([("count", "u1"), ("indices", "<i4", (3,))])
TEXTURED_FACE = np.dtype([*FACE.descr, ("uv_count", "u1"), ("corner_uv", "<f4", (3, 2))])
_FACE_LINES = {
    FACE: ("property list uchar int vertex_indices",),
    TEXTURED_FACE: ("property list uchar int vertex_indices", "property list uchar float texcoord"),
}
GROUPS = {
    "vertices": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "velocities": ("vx", "vy", "vz"),
    "uv": ("s", "t"),
    "wet": ("wet",),
    "dye": ("dye",),
    "dye_behind": ("dye_behind",),
}
"""Columns of vertices by the names of their arrays, in the order that files have them."""
_LONGEST_HEADER = 4096
_HEADER_END = b"end_header\n"

FADE_S = 0.25
"""Over the end of its life a particle shrinks to nothing, instead of vanishing from one frame to the next [s]."""
KINDS = ("spray", "foam", "bubbles")  # names of the values of `kind` of whitewater, from 0
POINT = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "vx", "vy", "vz", "radius", "lifetime")), ("kind", "u1")])
OWN_COLUMNS = ("dye", "temperature")
"""Columns that some clouds have, one at most: of drops of a fluid with dye, and of embers."""
POINT_OF = {None: POINT, **{name: np.dtype([*POINT.descr, (name, "<f4")]) for name in OWN_COLUMNS}}
"""Records of points by their own column."""
_COMMENT = "comment not_made {not_made}\n"
_OWN_LINE = "property float {own}\n"
_POINTS_HEADER = (
    f"ply\nformat binary_little_endian 1.0\n{_COMMENT}element vertex {{count}}\n"
    + "".join(f"property {'uchar' if POINT[name].kind == 'u' else 'float'} {name}\n" for name in POINT.names or ())
    + f"{_OWN_LINE}end_header\n"
)
_POINTS_PATTERN = re.compile(
    re.escape(_POINTS_HEADER)
    .replace(re.escape(_COMMENT), f"(?:{re.escape(_COMMENT)})?")  # files of earlier versions lack it
    .replace(re.escape(_OWN_LINE), f"(?:property float (?P<own>{'|'.join(OWN_COLUMNS)})\n)?")
    .replace(re.escape("{count}"), r"(?P<count>0|[1-9]\d{0,9})")
    .replace(re.escape("{not_made}"), r"(?P<not_made>0|[1-9]\d{0,18})")
    .encode("ascii")
)


@dataclass(frozen=True)
class SurfaceMesh:
    """Triangles, counter-clockwise as seen from outside.

    Attributes:
        vertices: (n, 3) float32 [m].
        faces: (m, 3) int32 vertex indices.
        normals: (n, 3) float32 unit vectors that point out, or None.
        velocities: (n, 3) float32 [m/s], or None.
        uv: (n, 2) float32 coordinates on the surface at rest [m], or None.
        wet: (n, 1) float32, how far a fluid's vertices touch solids: 1 where they do, 0 where they are free; or None.
        dye: (n, 1) float32 concentration of a fluid's dye [-], or None.
        dye_behind: (n, 1) float32 depth of dye of concentration 1 that lies behind, along the normal [m], or None.
        corner_uv: (m, 3, 2) float32 coordinates on pictures, of the corners of faces, or None.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32] | None = None
    velocities: NDArray[np.float32] | None = None
    uv: NDArray[np.float32] | None = None
    wet: NDArray[np.float32] | None = None
    dye: NDArray[np.float32] | None = None
    dye_behind: NDArray[np.float32] | None = None
    corner_uv: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class MeshHeader:
    """The header of a mesh: the number of its vertices and faces, the columns of vertices, the record of a face."""

    vertex_count: int
    face_count: int
    properties: tuple[str, ...]
    face: np.dtype[np.void]

    @property
    def content(self) -> bytes:
        """As it is in the file."""
        lines = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {self.vertex_count}",
            *(f"property float {name}" for name in self.properties),
            f"element face {self.face_count}",
            *_FACE_LINES[self.face],
        ]
        return "\n".join(lines).encode("ascii") + b"\n" + _HEADER_END

    def groups(self) -> Iterator[tuple[str, slice]]:
        """Names of the arrays of vertices that there are, and their columns."""
        position = 0
        for group, names in GROUPS.items():
            if self.properties[position : position + len(names)] == names:
                yield group, slice(position, position + len(names))
                position += len(names)


def read_mesh(content: bytes) -> SurfaceMesh:
    """The mesh in a file's content.

    Raises:
        ValueError: it is not of this layout, or its size is not the one that its header promises.
    """
    header, body = _mesh_header(content)
    width = len(header.properties)
    faces_start = body + 4 * width * header.vertex_count
    _require_size(content, faces_start + header.face.itemsize * header.face_count)
    rows = np.frombuffer(content, "<f4", header.vertex_count * width, body).reshape(-1, width)
    records = np.frombuffer(content, header.face, header.face_count, faces_start)
    if (records["count"] != 3).any():
        raise ValueError("has a face that is not a triangle")
    is_textured = header.face is TEXTURED_FACE
    if is_textured and (records["uv_count"] != 6).any():
        raise ValueError("has a face without two texture coordinates for each corner")
    return SurfaceMesh(
        faces=np.ascontiguousarray(records["indices"], np.int32),
        corner_uv=np.ascontiguousarray(records["corner_uv"], np.float32) if is_textured else None,
        **{group: np.ascontiguousarray(rows[:, columns], np.float32) for group, columns in header.groups()},
    )


def write_mesh(path: Path, mesh: SurfaceMesh) -> None:
    """Write a mesh; the same arrays give the same bytes."""
    columns = {name: getattr(mesh, name) for name in GROUPS if getattr(mesh, name) is not None}
    properties = tuple(name for group in columns for name in GROUPS[group])
    face = FACE if mesh.corner_uv is None else TEXTURED_FACE
    header = MeshHeader(len(mesh.vertices), len(mesh.faces), properties, face)
    rows = np.empty((header.vertex_count, len(properties)), "<f4")
    for name, places in header.groups():
        rows[:, places] = columns[name]
    records = np.empty(len(mesh.faces), face)
    records["count"] = 3
    records["indices"] = mesh.faces
    if mesh.corner_uv is not None:
        records["uv_count"] = 6
        records["corner_uv"] = mesh.corner_uv
    with path.open("wb") as file:
        file.write(header.content)
        file.write(rows.data)
        file.write(records.data)


def require_sound_mesh(mesh: SurfaceMesh) -> None:
    """Raise ValueError unless every number is finite and every index in range."""
    for name in GROUPS:
        column = getattr(mesh, name)
        if column is not None and not np.isfinite(column).all():
            row = int(np.flatnonzero(~np.isfinite(column).all(axis=1))[0])
            raise ValueError(f"{name} of vertex {row} are not finite: {column[row].tolist()}")
    if mesh.corner_uv is not None and not np.isfinite(mesh.corner_uv).all():
        face = int(np.flatnonzero(~np.isfinite(mesh.corner_uv).all(axis=(1, 2)))[0])
        raise ValueError(f"texture coordinates of face {face} are not finite")
    if mesh.faces.size and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        bad = mesh.faces[(mesh.faces < 0) | (mesh.faces >= len(mesh.vertices))][0]
        raise ValueError(f"a face names vertex {bad}, but there are {len(mesh.vertices)}")


def written_header(own: str | None, *, count: int, not_made: int) -> bytes:
    """The header of so many points with a column of their own or none, and how many had no room."""
    header = _POINTS_HEADER if own is not None else _POINTS_HEADER.replace(_OWN_LINE, "")
    return header.format(own=own, count=count, not_made=not_made).encode("ascii")


def points_header(content: bytes) -> re.Match[bytes]:
    """Match of the header of points with `count`, `own` column or None, and, but in earlier versions, `not_made`.

    Raises:
        ValueError: it is not of this layout.
    """
    header = _POINTS_PATTERN.match(content)
    if header is None:
        raise ValueError("is not a point cloud of the expected layout (docs/guide/formats.md)")
    return header


def read_points(content: bytes) -> NDArray[np.void]:
    """Rows of one of `POINT_OF` in a file's content.

    Raises:
        ValueError: it is not of this layout, or its size is not the one that its header promises.
    """
    header = points_header(content)
    count, record = int(header["count"]), POINT_OF[None if header["own"] is None else header["own"].decode()]
    _require_size(content, header.end() + count * record.itemsize)
    return np.frombuffer(content, record, count, header.end())


def drawn_radii(radius: NDArray[np.float32], lifetime: NDArray[np.float32]) -> NDArray[np.float32]:
    """Radii of whitewater as pictures show them [m], (n,): they shrink to nothing over the last `FADE_S`."""
    shown: NDArray[np.float32] = (radius * np.cbrt(np.clip(lifetime / FADE_S, 0.0, 1.0))).astype(np.float32)
    return shown


def _mesh_header(content: bytes) -> tuple[MeshHeader, int]:
    """The header of a mesh, and where its vertices begin."""
    end = content.find(_HEADER_END, 0, _LONGEST_HEADER)
    if end < 0:
        raise ValueError("has no PLY header")
    size = end + len(_HEADER_END)
    counts: dict[str, int] = {}
    properties: list[str] = []
    for line in content[:size].decode("ascii", "replace").splitlines():
        match line.split():
            case ["element", name, count] if count.isdecimal():
                counts[name] = int(count)
            case ["property", "float", name]:
                properties.append(name)
    face = TEXTURED_FACE if b"texcoord" in content[:size] else FACE
    header = MeshHeader(counts.get("vertex", 0), counts.get("face", 0), tuple(properties), face)
    if header.content != content[:size] or next(header.groups(), ("", None))[0] != "vertices":
        raise ValueError("is not a PLY of the expected layout (docs/guide/formats.md)")
    return header, size


def _require_size(content: bytes, size: int) -> None:
    if len(content) != size:
        raise ValueError(f"{len(content)} bytes, but its header promises {size}: it is truncated, or has more")
