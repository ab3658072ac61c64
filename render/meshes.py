"""Triangle meshes as binary PLY files, written and read with numpy alone; `blender_scripts.ply` has the layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blender_scripts.ply import GROUPS, SurfaceMesh, read_mesh, require_sound_mesh, write_mesh
from render.errors import invalid_if_refused

__all__ = ["Float32Array", "SurfaceMesh", "read_ply", "validate_ply", "with_sharp_edges", "write_ply"]

Float32Array = NDArray[np.float32]

SAME_NORMAL = 1.0e-4
"""Components of normals that differ by less are those of one side."""


def write_ply(
    path: Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    normals: ArrayLike | None = None,
    velocities: ArrayLike | None = None,
    uv: ArrayLike | None = None,
    dye: ArrayLike | None = None,
    dye_behind: ArrayLike | None = None,
    corner_uv: ArrayLike | None = None,
) -> None:
    """Write a triangle mesh; the same arrays give the same bytes. They are those of `SurfaceMesh`, of any type.

    Raises:
        ValueError: the shapes do not fit together.
    """
    groups = {"vertices": vertices, "normals": normals, "velocities": velocities, "uv": uv}
    groups |= {"dye": dye, "dye_behind": dye_behind}
    columns: dict[str, Any] = {
        name: _as_rows(name, value, len(GROUPS[name])) for name, value in groups.items() if value is not None
    }
    triangles = _as_rows("faces", faces, 3)
    counts = {name: len(column) for name, column in columns.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"a mesh needs as many of each per vertex, got {counts}")
    if corner_uv is not None and np.shape(corner_uv) != (len(triangles), 3, 2):
        raise ValueError(f"corner_uv must have the shape ({len(triangles)}, 3, 2), got {np.shape(corner_uv)}")
    coordinates = None if corner_uv is None else np.asarray(corner_uv)
    write_mesh(path, SurfaceMesh(**columns, faces=triangles, corner_uv=coordinates))


def read_ply(path: Path) -> SurfaceMesh:
    """Read a mesh that `write_ply` wrote.

    Raises:
        InvalidFileError: it is not of this layout, or its size is not the one that its header promises.
        OSError: it cannot be read.
    """
    with invalid_if_refused(path):
        return read_mesh(path.read_bytes())


def validate_ply(path: Path) -> None:
    """Decode a mesh fully: its size is exactly as promised, every number finite, every index in range.

    Raises:
        InvalidFileError: it is not.
        OSError: it cannot be read.
    """
    mesh = read_ply(path)
    with invalid_if_refused(path):
        require_sound_mesh(mesh)


def _as_rows(name: str, values: ArrayLike, width: int) -> NDArray[Any]:
    rows = np.asarray(values)
    if rows.size == 0:
        return rows.reshape(0, width)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{name} must have the shape (n, {width}), got {rows.shape}")
    return rows


def with_sharp_edges(
    vertices: ArrayLike, velocities: ArrayLike, faces: ArrayLike, *, angle_deg: float
) -> tuple[Float32Array, Float32Array, NDArray[np.int32], Float32Array]:
    """A mesh whose vertices are one for each side of edges sharper than an angle, with its normals.

    Vertices [m] and velocities [m/s] are (n, 3), faces (m, 3). A corner's normal is the mean of those of the faces at
    its vertex, weighted by area, that its own face makes no larger angle with.

    Returns vertices and velocities (k, 3), faces (m, 3) and normals (k, 3).
    """
    places, triangles = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    a, b, c = np.moveaxis(places[triangles], 1, 0)
    areas = np.cross(b - a, c - a)
    lengths = np.linalg.norm(areas, axis=1, keepdims=True)
    units = np.divide(areas, lengths, out=np.zeros_like(areas), where=lengths > 0.0)
    corner_face = np.repeat(np.arange(len(triangles)), 3)
    order = np.argsort(triangles.ravel(), kind="stable")
    sizes = np.bincount(triangles.ravel(), minlength=len(places))
    # All pairs of corners at one vertex.
    of_corner = sizes[triangles.ravel()[order]]
    first = np.repeat(np.arange(len(order)), of_corner)
    begins = np.repeat((np.cumsum(sizes) - sizes)[triangles.ravel()[order]], of_corner)
    second = begins + np.arange(len(first)) - np.repeat(np.cumsum(of_corner) - of_corner, of_corner)
    one, two = corner_face[order[first]], corner_face[order[second]]
    smooth = np.einsum("ij,ij->i", units[one], units[two]) >= np.cos(np.radians(angle_deg))
    corner = order[first[smooth]]
    normals = np.stack(
        [np.bincount(corner, areas[two[smooth], axis], minlength=triangles.size) for axis in range(3)], axis=1
    )
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=units[corner_face].copy(), where=lengths > 0.0)
    # Corners of one vertex with one normal stay one.
    keys = np.column_stack([triangles.ravel(), np.round(normals / SAME_NORMAL).astype(np.int64)])
    _, chosen, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    vertex = triangles.ravel()[chosen]
    moving = np.asarray(velocities, np.float64)[vertex]
    return (
        places[vertex].astype(np.float32),
        moving.astype(np.float32),
        numbers.reshape(triangles.shape).astype(np.int32),
        normals[chosen].astype(np.float32),
    )
