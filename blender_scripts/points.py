"""Whitewater: points from PLY files into Blender, drawn as spheres.

The PLY files are binary little endian: per vertex float32 `x y z vx vy vz radius lifetime` (position [m], velocity
[m/s], radius [m], what is left of its life [s]) and uchar `kind` (0 spray, 1 foam, 2 bubbles).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from blender_scripts.errors import RenderInputError

KINDS = {"spray": 0, "foam": 1, "bubbles": 2}
"""Values of `kind` in the files."""

FADE_S = 0.25
"""Over the end of its life a particle shrinks to nothing, instead of vanishing from one frame to the next [s]."""

_FLOATS = ("x", "y", "z", "vx", "vy", "vz", "radius", "lifetime")
_ROW = np.dtype([*((name, "<f4") for name in _FLOATS), ("kind", "u1")])
_LONGEST_HEADER = 4096


@dataclass(frozen=True)
class Points:
    """Spheres in world space.

    Attributes:
        positions: [m], (n, 3), float32.
        velocities: [m/s], (n, 3), float32.
        radii: [m], (n,), float32.
    """

    positions: np.ndarray
    velocities: np.ndarray
    radii: np.ndarray


def read_points(path: Path, kind: str) -> Points:
    """Read and check the points of one kind. A file without any point is legal: nothing is drawn.

    Raises:
        RenderInputError: the file is missing, truncated, of another layout, or holds values that are not finite.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise RenderInputError(f"cannot read the points {path}: {error.strerror}") from error
    marker = b"end_header\n"
    end = content.find(marker, 0, _LONGEST_HEADER)
    lines = content[: max(end, 0)].decode("ascii", errors="replace").split("\n")[:-1]
    count = _count(lines)
    if count is None:
        raise RenderInputError(f"{path} is not a PLY of whitewater points (docs/guide/formats.md)")
    start = end + len(marker)
    if len(content) != start + count * _ROW.itemsize:
        raise RenderInputError(
            f"the points {path} have {len(content)} bytes; {count} points make {start + count * _ROW.itemsize}: "
            "the file is truncated"
        )
    rows = np.frombuffer(content, _ROW, count, start)
    bad = sum(int(np.count_nonzero(~np.isfinite(rows[name]))) for name in _FLOATS)
    if bad:
        raise RenderInputError(f"the points {path} have {bad} values that are not finite")
    chosen = rows[rows["kind"] == KINDS[kind]]
    return Points(
        positions=np.stack([chosen[name] for name in ("x", "y", "z")], axis=1).astype(np.float32),
        velocities=np.stack([chosen[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float32),
        radii=(chosen["radius"] * np.cbrt(np.clip(chosen["lifetime"] / FADE_S, 0.0, 1.0))).astype(np.float32),
    )


def new_points_object(name: str, material: Any) -> Any:
    """An object without points yet, linked into the scene.

    Its vertices become spheres in a geometry-nodes modifier: `radius` is their size, and `velocity` [m/s], which the
    modifier passes on, blurs them.
    """
    mesh = bpy.data.meshes.new(name)
    blender_object = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(blender_object)
    modifier = blender_object.modifiers.new("spheres", "NODES")
    modifier.node_group = _spheres(name, material)
    return blender_object


def fill_points(mesh: Any, points: Points) -> None:
    """Replace the points of an object's mesh."""
    mesh.clear_geometry()
    for name in ("velocity", "radius"):
        existing = mesh.attributes.get(name)
        if existing is not None:
            mesh.attributes.remove(existing)
    mesh.vertices.add(len(points.positions))
    if len(points.positions):
        mesh.attributes["position"].data.foreach_set("vector", points.positions.ravel())
        velocity = mesh.attributes.new("velocity", "FLOAT_VECTOR", "POINT")
        velocity.data.foreach_set("vector", points.velocities.ravel())
        radius = mesh.attributes.new("radius", "FLOAT", "POINT")
        radius.data.foreach_set("value", points.radii)
    mesh.update()


def _count(lines: list[str]) -> int | None:
    """The number of points, if these are the lines of the one header that is known; comments are passed over."""
    lines = [line for line in lines if not line.startswith("comment ")]
    words = lines[2].split() if len(lines) > 2 else []
    if len(words) != 3 or not words[2].isdecimal():
        return None
    expected = ["ply", "format binary_little_endian 1.0", f"element vertex {words[2]}"]
    expected += [f"property float {name}" for name in _FLOATS] + ["property uchar kind"]
    return int(words[2]) if lines == expected else None


def _spheres(name: str, material: Any) -> Any:
    """Geometry nodes that turn vertices into spheres of their radius and material."""
    group = bpy.data.node_groups.new(f"{name} spheres", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    nodes, links = group.nodes, group.links
    vertices, spheres = nodes.new("NodeGroupInput"), nodes.new("NodeGroupOutput")
    radius = nodes.new("GeometryNodeInputNamedAttribute")
    radius.data_type = "FLOAT"
    radius.inputs["Name"].default_value = "radius"
    to_points = nodes.new("GeometryNodeMeshToPoints")
    painted = nodes.new("GeometryNodeSetMaterial")
    painted.inputs["Material"].default_value = material
    links.new(vertices.outputs[0], to_points.inputs["Mesh"])
    links.new(radius.outputs["Attribute"], to_points.inputs["Radius"])
    links.new(to_points.outputs[0], painted.inputs["Geometry"])
    links.new(painted.outputs[0], spheres.inputs[0])
    return group
