"""Triangle meshes as binary PLY files, written and read with numpy alone; `blender_scripts.ply` has the layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from blender_scripts.ply import GROUPS, SurfaceMesh, read_mesh, require_sound_mesh, write_mesh
from render.errors import invalid_if_refused

__all__ = ["Float32Array", "SurfaceMesh", "read_ply", "validate_ply", "write_ply"]

Float32Array = NDArray[np.float32]


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
