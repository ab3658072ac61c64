"""Triangle meshes: from PLY files into Blender, fast enough to do it for every frame."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from blender_scripts.documents import content_of
from blender_scripts.errors import RenderInputError
from blender_scripts.ply import SurfaceMesh, read_mesh, require_sound_mesh

REST_UV = "rest"
"""UV map of coordinates on the surface at rest [m]: what hangs on it does not swim as the surface moves."""
PICTURE_UV = "UVMap"  # UV map of coordinates on pictures, by Blender's usual name: the one that image textures follow
WET = "wet"  # attribute that tells where a fluid touches solids: 1 there, 0 where its surface is free (`wetting`)
DYE = "dye"  # attribute of a fluid's concentration of dye [-]
EMBER_TEMPERATURE = "ember_temperature"  # attribute [K]; "temperature" and "heat" are grids of volumes to Cycles
DYE_BEHIND = "dye_behind"  # attribute of how deep dye lies behind its surface [m]
COVERED = "covered"  # attribute of what light goes through: above 1/2 where a liquid covers it (`wetting`)
COVER_INDEX = "cover_index"  # and that liquid's refractive index, less 1

EMPTY_MESH = SurfaceMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))


def read_ply(path: Path) -> SurfaceMesh:
    """Read and check a mesh. A mesh without any vertex is legal: nothing is drawn.

    Raises:
        RenderInputError: the file is missing, truncated, of another layout, or holds NaN or bad indices.
    """
    try:
        mesh = read_mesh(content_of(path, "mesh"))
        require_sound_mesh(mesh)
    except ValueError as error:
        raise RenderInputError(f"the mesh {path}: {error}") from error
    return mesh


def vertex_normals(mesh: SurfaceMesh) -> np.ndarray:
    """Unit normals of a mesh's vertices by its triangles, weighed by their area, (n, 3)."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces].astype(np.float64), 1, 0)
    areas = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    count = len(mesh.vertices)
    sums = np.stack([np.bincount(mesh.faces.ravel(), areas[:, axis], minlength=count) for axis in range(3)], axis=1)
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)


def edges_of(mesh: SurfaceMesh) -> tuple[float, float, float] | None:
    """Edges of the box around a mesh, along the axes [m]; None without vertices."""
    if not len(mesh.vertices):
        return None
    x, y, z = (float(edge) for edge in np.ptp(mesh.vertices, axis=0))
    return x, y, z


def fill_mesh(mesh: Any, source: SurfaceMesh, wetness: np.ndarray | None = None) -> None:
    """Replace a Blender mesh's geometry by `source`.

    The attribute names are Blender's: Cycles blurs along a POINT attribute `velocity` [m/s], also when the topology
    changes from frame to frame, and shades with a POINT attribute `custom_normal`.

    Args:
        mesh: Blender's.
        source: the geometry; `foreach_set` copies its arrays as a whole.
        wetness: of a fluid, how far each vertex touches solids [-], (n,).
    """
    mesh.clear_geometry()
    mesh.vertices.add(len(source.vertices))
    mesh.loops.add(source.faces.size)
    mesh.polygons.add(len(source.faces))
    if len(source.vertices) and len(source.faces):
        mesh.attributes["position"].data.foreach_set("vector", source.vertices.ravel())
        mesh.loops.foreach_set("vertex_index", source.faces.ravel())
        mesh.polygons.foreach_set("loop_start", np.arange(0, source.faces.size, 3, dtype=np.int32))
        set_attribute(mesh, "velocity", source.velocities)
        set_attribute(mesh, "custom_normal", source.normals)
        set_attribute(mesh, WET, wetness)
        for name, values in ((DYE, source.dye), (DYE_BEHIND, source.dye_behind)):
            set_attribute(mesh, name, None if values is None else np.ascontiguousarray(values[:, 0]))
        _set_uv_map(mesh, REST_UV, None if source.uv is None else source.uv[source.faces])
        _set_uv_map(mesh, PICTURE_UV, source.corner_uv)
    mesh.update(calc_edges=True)


def set_attribute(mesh: Any, name: str, values: np.ndarray | None) -> None:
    """Replace an attribute of a mesh's vertices, numbers (n,) or vectors (n, 3); None: remove it."""
    existing = mesh.attributes.get(name)
    if existing is not None:
        mesh.attributes.remove(existing)
    if values is not None:
        kind, key = ("FLOAT", "value") if values.ndim == 1 else ("FLOAT_VECTOR", "vector")
        mesh.attributes.new(name, kind, "POINT").data.foreach_set(key, values.ravel())


def _set_uv_map(mesh: Any, name: str, corners: np.ndarray | None) -> None:
    existing = mesh.uv_layers.get(name)
    if existing is not None:
        mesh.uv_layers.remove(existing)
    if corners is not None:
        layer = mesh.uv_layers.new(name=name, do_init=False)
        layer.uv.foreach_set("vector", corners.ravel())


def new_object(name: str, data: Any) -> Any:
    """An object with this data, linked into the scene."""
    blender_object = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(blender_object)
    return blender_object


def new_mesh_object(name: str, source: SurfaceMesh) -> Any:
    """A mesh object with this geometry, linked into the scene."""
    mesh = bpy.data.meshes.new(name)
    fill_mesh(mesh, source)
    return new_object(name, mesh)


def keep_sharp_edges(mesh: Any, angle_deg: float) -> None:
    """Shade smoothly, except across edges that turn by more than this angle [degrees]."""
    mesh.shade_smooth()
    mesh.set_sharp_from_angle(angle=math.radians(angle_deg))
