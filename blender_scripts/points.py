"""Drops, whitewater and embers: points from PLY files into Blender, drawn as spheres."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from blender_scripts.documents import content_of
from blender_scripts.errors import RenderInputError
from blender_scripts.geometry import DYE, EMBER_TEMPERATURE, new_object, set_attribute
from blender_scripts.ply import KINDS, drawn_radii
from blender_scripts.ply import read_points as read_rows
from blender_scripts.shading import NodeBuilder

ATTRIBUTES = {"dye": DYE, "temperature": EMBER_TEMPERATURE}
"""Attributes of the columns that some clouds have."""


@dataclass(frozen=True)
class Points:
    """Spheres in world space: positions [m] (n, 3), velocities [m/s] (n, 3) and radii [m] (n,), float32.

    Drops of a fluid with dye have its concentration [-], and embers their temperature [K], (n,), float32, by its name.
    """

    positions: np.ndarray
    velocities: np.ndarray
    radii: np.ndarray
    own: dict[str, np.ndarray]


def read_points(path: Path, kind: str) -> Points:
    """Read and check the points of one kind. A file without any point is legal: nothing is drawn.

    Raises:
        RenderInputError: the file is missing, truncated, of another layout, or holds values that are not finite.
    """
    try:
        rows = read_rows(content_of(path, "points"))
    except ValueError as error:
        raise RenderInputError(f"the points {path}: {error}") from error
    bad = sum(int(np.count_nonzero(~np.isfinite(rows[name]))) for name in rows.dtype.names or ())
    if bad:
        raise RenderInputError(f"the points {path} have {bad} values that are not finite")
    chosen = rows[rows["kind"] == KINDS.index(kind)]
    return Points(
        positions=np.stack([chosen[name] for name in ("x", "y", "z")], axis=1).astype(np.float32),
        velocities=np.stack([chosen[name] for name in ("vx", "vy", "vz")], axis=1).astype(np.float32),
        radii=drawn_radii(chosen["radius"], chosen["lifetime"]),
        own={name: np.ascontiguousarray(chosen[name], np.float32) for name in ATTRIBUTES if name in rows.dtype.names},
    )


def new_points_object(name: str, material: Any, smallest_angle: float | None = None) -> Any:
    """An object without points yet, linked into the scene.

    Its vertices become spheres in a geometry-nodes modifier: `radius` is their size, and `velocity` [m/s], which the
    modifier passes on, blurs them. Fewer and larger ones stand for what the camera sees at a smaller angle [rad].
    """
    blender_object = new_object(name, bpy.data.meshes.new(name))
    modifier = blender_object.modifiers.new("spheres", "NODES")
    modifier.node_group = _spheres(name, material, smallest_angle)
    return blender_object


def let_light_by(blender_object: Any) -> None:
    """Let only rays meet points that come from the camera, by mirrors or through what is clear.

    Drops turn light by little: what they light and shade is lit about as without them, and rays that look for lamps
    would meet dozens.
    """
    for kind in ("diffuse", "shadow", "volume_scatter"):
        setattr(blender_object, f"visible_{kind}", False)


def fill_points(mesh: Any, points: Points) -> None:
    """Replace the points of an object's mesh."""
    mesh.clear_geometry()
    mesh.vertices.add(len(points.positions))
    is_empty = not len(points.positions)
    if not is_empty:
        mesh.attributes["position"].data.foreach_set("vector", points.positions.ravel())
    set_attribute(mesh, "velocity", None if is_empty else points.velocities)
    set_attribute(mesh, "radius", None if is_empty else points.radii)
    for name, attribute in ATTRIBUTES.items():
        set_attribute(mesh, attribute, None if is_empty else points.own.get(name))
    mesh.update()


def _spheres(name: str, material: Any, smallest_angle: float | None) -> Any:
    """Geometry nodes that turn vertices into spheres of their radius and material."""
    group = bpy.data.node_groups.new(f"{name} spheres", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    builder = NodeBuilder(group, "NodeGroupOutput")
    named = builder.node("GeometryNodeInputNamedAttribute", Name="radius")
    named.data_type = "FLOAT"
    radius = named.outputs["Attribute"]
    to_points = builder.node("GeometryNodeMeshToPoints", Mesh=builder.node("NodeGroupInput").outputs[0])
    if smallest_angle is not None:
        radius, is_drawn = _seen(builder, radius, smallest_angle)
        builder.link(is_drawn, to_points.inputs["Selection"])
    builder.link(radius, to_points.inputs["Radius"])
    builder.geometry(builder.node("GeometryNodeSetMaterial", Geometry=to_points.outputs[0], Material=material))
    return group


def _seen(builder: NodeBuilder, radius: Any, smallest_angle: float) -> tuple[Any, Any]:
    """The output sockets of the radii that spheres are drawn in, and of which of them are.

    Those that the camera sees at a smaller angle [rad] are drawn at it, and as many fewer: their volume stays the same.
    A sphere's lot goes by its radius, so that it has the same one in every frame.
    """
    camera = builder.node("GeometryNodeObjectInfo", Object=builder.node("GeometryNodeInputActiveCamera").outputs[0])
    position = builder.node("GeometryNodeInputPosition").outputs[0]
    away = builder.vector_math("DISTANCE", position, camera.outputs["Location"])
    drawn = builder.math("MAXIMUM", radius, builder.math("MULTIPLY", away, smallest_angle))
    share = builder.math("POWER", builder.math("DIVIDE", radius, drawn), 3.0)
    hashed, lot = builder.node("FunctionNodeHashValue"), builder.node("FunctionNodeRandomValue")
    hashed.data_type = lot.data_type = "FLOAT"
    # Both have a socket of the same name for each type of data.
    builder.link(radius, next(socket for socket in hashed.inputs if socket.enabled))
    builder.link(hashed.outputs[0], lot.inputs["ID"])
    return drawn, builder.math("LESS_THAN", next(socket for socket in lot.outputs if socket.enabled), share)
