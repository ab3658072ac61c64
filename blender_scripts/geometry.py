"""Triangle meshes: from PLY files into Blender, fast enough to do it for every frame.

The PLY files are binary little endian: per vertex float32 `x y z`, optionally `nx ny nz` (unit normals), `vx vy vz`
(velocity [m/s]) and `s t` (coordinates on the surface at rest [m]); per face `list uchar int vertex_indices` with three
indices, optionally `list uchar float texcoord` with u and v of each corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from blender_scripts.errors import RenderInputError

REST_UV = "rest"
"""UV map of coordinates on the surface at rest [m]: what hangs on it does not swim as the surface moves."""

PICTURE_UV = "UVMap"
"""UV map of coordinates on pictures, by Blender's usual name: the one that image textures follow."""

WET = "wet"
"""Attribute that tells where a fluid touches solids: 1 there, 0 where its surface is free (`wetting`)."""

_MAX_HEADER_BYTES = 65536
_FACE_RECORD = np.dtype([("corner_count", "u1"), ("vertex_indices", "<i4", (3,))])
_TEXTURED_FACE_RECORD = np.dtype([*_FACE_RECORD.descr, ("uv_count", "u1"), ("corner_uv", "<f4", (3, 2))])
_SCALAR_TYPES = {"float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "int": "<i4", "int32": "<i4"}


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh in object space.

    Attributes:
        positions: [m], (n, 3), float32.
        triangles: vertex indices, (m, 3), int32.
        normals: unit vectors, (n, 3), float32, or None.
        velocities: [m/s], (n, 3), float32, or None.
        uv: coordinates on the surface at rest [m], (n, 2), float32, or None.
        corner_uv: coordinates on pictures, of the corners of triangles, (m, 3, 2), float32, or None.
        wetness: of a fluid, how far it touches solids [-], (n,), float32, or None.
    """

    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    velocities: np.ndarray | None = None
    uv: np.ndarray | None = None
    corner_uv: np.ndarray | None = None
    wetness: np.ndarray | None = None

    def edges(self) -> tuple[float, float, float] | None:
        """Edges of the box around it, along the axes [m]; None without vertices."""
        if not len(self.positions):
            return None
        x, y, z = (float(edge) for edge in np.ptp(self.positions, axis=0))
        return x, y, z


def read_ply(path: Path) -> TriangleMesh:
    """Read and check a mesh. A mesh without any vertex is legal: nothing is drawn.

    Raises:
        RenderInputError: the file is missing, truncated, of another layout, or holds NaN or bad indices.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RenderInputError(f"cannot read the mesh {path}: {error.strerror}") from error
    vertex_dtype, face_record, vertex_count, face_count, body_start = _parse_header(content, path)
    faces_start = body_start + vertex_count * vertex_dtype.itemsize
    expected_bytes = faces_start + face_count * face_record.itemsize
    if len(content) != expected_bytes:
        raise RenderInputError(
            f"the mesh {path} has {len(content)} bytes; {vertex_count} vertices and {face_count} triangles "
            f"make {expected_bytes}: it is truncated, or not all of its faces are triangles"
        )
    vertices = np.frombuffer(content, vertex_dtype, vertex_count, body_start)
    faces = np.frombuffer(content, face_record, face_count, faces_start)
    if np.any(faces["corner_count"] != 3):
        raise RenderInputError(f"the mesh {path} has faces that are not triangles")
    is_textured = face_record is _TEXTURED_FACE_RECORD
    if is_textured and np.any(faces["uv_count"] != 6):
        raise RenderInputError(f"the mesh {path} has faces without two texture coordinates for each corner")
    mesh = TriangleMesh(
        positions=_columns(vertices, ("x", "y", "z")),
        triangles=np.ascontiguousarray(faces["vertex_indices"]),
        normals=_columns(vertices, ("nx", "ny", "nz")) if "nx" in vertices.dtype.names else None,
        velocities=_columns(vertices, ("vx", "vy", "vz")) if "vx" in vertices.dtype.names else None,
        uv=_columns(vertices, ("s", "t")) if "s" in vertices.dtype.names else None,
        corner_uv=np.ascontiguousarray(faces["corner_uv"]) if is_textured else None,
    )
    _check(mesh, path)
    return mesh


def fill_mesh(mesh: Any, source: TriangleMesh) -> None:
    """Replace a Blender mesh's geometry by `source`.

    `foreach_set` copies whole arrays; a million triangles take 0.3 s where `from_pydata` needs 1.1 s. The attribute
    names are Blender's: Cycles blurs along a POINT attribute `velocity` [m/s], also when the topology changes from
    frame to frame, and shades with a POINT attribute `custom_normal`. Coordinates at rest become the UV map `REST_UV`,
    those on pictures `PICTURE_UV`, the wetness becomes the attribute `WET`.
    """
    mesh.clear_geometry()
    vertex_count, triangle_count = len(source.positions), len(source.triangles)
    mesh.vertices.add(vertex_count)
    mesh.loops.add(3 * triangle_count)
    mesh.polygons.add(triangle_count)
    if vertex_count and triangle_count:
        mesh.attributes["position"].data.foreach_set("vector", source.positions.ravel())
        mesh.loops.foreach_set("vertex_index", source.triangles.ravel())
        mesh.polygons.foreach_set("loop_start", np.arange(0, 3 * triangle_count, 3, dtype=np.int32))
        _set_vector_attribute(mesh, "velocity", source.velocities)
        _set_vector_attribute(mesh, "custom_normal", source.normals)
        _set_uv_map(mesh, REST_UV, None if source.uv is None else source.uv[source.triangles])
        _set_uv_map(mesh, PICTURE_UV, source.corner_uv)
        _set_wetness(mesh, source.wetness)
    mesh.update(calc_edges=True)


def new_mesh_object(name: str, source: TriangleMesh) -> Any:
    """A mesh object with this geometry, linked into the scene."""
    mesh = bpy.data.meshes.new(name)
    fill_mesh(mesh, source)
    blender_object = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(blender_object)
    return blender_object


def _parse_header(content: bytes, path: Path) -> tuple[np.dtype, np.dtype, int, int, int]:
    """Records of a vertex and of a face, the number of each, and where the first begins [bytes]."""
    marker = b"end_header\n"
    end = content.find(marker, 0, _MAX_HEADER_BYTES)
    if not content.startswith(b"ply") or end < 0:
        raise RenderInputError(f"{path} is not a PLY mesh (no header)")
    counts: dict[str, int] = {}
    vertex_fields: list[tuple[str, str]] = []
    face_record, element = _FACE_RECORD, ""
    for line in content[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        match words:
            case ["format", kind, *_] if kind != "binary_little_endian":
                raise RenderInputError(f"the mesh {path} is {kind}; binary_little_endian is needed")
            case ["element", element, count]:
                counts[element] = int(count)
            case ["property", scalar_type, name] if element == "vertex":
                if scalar_type not in _SCALAR_TYPES:
                    raise RenderInputError(f"the mesh {path} has a vertex property of unknown type {scalar_type}")
                vertex_fields.append((name, _SCALAR_TYPES[scalar_type]))
            case ["property", "list", "uchar", "float", "texcoord"] if element == "face":
                face_record = _TEXTURED_FACE_RECORD
            case ["property", "list", count_type, index_type, _] if element == "face":
                if (count_type, index_type) not in {("uchar", "int"), ("uint8", "int32")}:
                    raise RenderInputError(
                        f"the mesh {path} has faces of {count_type} {index_type}; uchar int is needed"
                    )
    if not {"x", "y", "z"} <= {name for name, _ in vertex_fields} or set(counts) != {"vertex", "face"}:
        raise RenderInputError(f"the mesh {path} needs exactly the elements vertex (with x, y, z) and face")
    return np.dtype(vertex_fields), face_record, counts["vertex"], counts["face"], end + len(marker)


def _columns(vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([vertices[name] for name in names], axis=1).astype(np.float32, copy=False)


def _check(mesh: TriangleMesh, path: Path) -> None:
    for quantity in ("positions", "normals", "velocities", "uv"):
        values = getattr(mesh, quantity)
        if values is not None and not np.isfinite(values).all():
            bad = int((~np.isfinite(values).all(axis=1)).sum())
            raise RenderInputError(f"the mesh {path} has {bad} vertices whose {quantity} are not finite")
    if mesh.corner_uv is not None and not np.isfinite(mesh.corner_uv).all():
        raise RenderInputError(f"the mesh {path} has texture coordinates that are not finite")
    if mesh.triangles.size and (mesh.triangles.min() < 0 or mesh.triangles.max() >= len(mesh.positions)):
        raise RenderInputError(f"the mesh {path} refers to vertices that it does not have")


def _set_vector_attribute(mesh: Any, name: str, values: np.ndarray | None) -> None:
    existing = mesh.attributes.get(name)
    if existing is not None:
        mesh.attributes.remove(existing)
    if values is not None:
        attribute = mesh.attributes.new(name, "FLOAT_VECTOR", "POINT")
        attribute.data.foreach_set("vector", values.ravel())


def _set_wetness(mesh: Any, values: np.ndarray | None) -> None:
    existing = mesh.attributes.get(WET)
    if existing is not None:
        mesh.attributes.remove(existing)
    if values is not None:
        mesh.attributes.new(WET, "FLOAT", "POINT").data.foreach_set("value", values)


def _set_uv_map(mesh: Any, name: str, corners: np.ndarray | None) -> None:
    existing = mesh.uv_layers.get(name)
    if existing is not None:
        mesh.uv_layers.remove(existing)
    if corners is not None:
        layer = mesh.uv_layers.new(name=name, do_init=False)
        layer.uv.foreach_set("vector", corners.ravel())


def keep_sharp_edges(mesh: Any, angle_deg: float) -> None:
    """Shade smoothly, except across edges that turn by more than this angle [degrees]."""
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(angle_deg))


EMPTY_MESH = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
