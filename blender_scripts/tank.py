"""The domain's walls as a glass tank, open at the top and where the domain is open at a side."""

from __future__ import annotations

from typing import Any

import numpy as np

from blender_scripts.camera import pixel_angle
from blender_scripts.geometry import new_mesh_object
from blender_scripts.looks import new_material
from blender_scripts.ply import SurfaceMesh
from blender_scripts.shading import LookContext

_WALL_THICKNESS = 0.008  # in domain diagonals
_GAP = 0.002  # between water and glass, in domain diagonals: coinciding surfaces would shade each other at random


def add_tank(spec: dict[str, Any]) -> Any | None:
    """Put a pane on each closed side of the domain; their rims and corners are solid, so that the tank can be seen.

    Returns:
        The object of the panes; None where all sides are open.
    """
    low, high = np.array(spec["domain_min"], dtype=np.float64), np.array(spec["domain_max"], dtype=np.float64)
    size = float(np.linalg.norm(high - low))
    inner_low, inner_high = low - _GAP * size, high + _GAP * size
    inner_low[2] = low[2]
    inner_high[2] = high[2]
    thickness = _WALL_THICKNESS * size
    sideways = np.array((thickness, thickness, 0.0))
    outer_low, outer_high = inner_low - sideways, inner_high + sideways

    closed = {side for side in ("x-", "x+", "y-", "y+") if side not in spec["open_faces"]}
    if not closed:
        return None
    panes, edges = [], []
    for side, x_low, x_high, y_low, y_high in (
        ("y-", inner_low[0], inner_high[0], outer_low[1], inner_low[1]),
        ("y+", inner_low[0], inner_high[0], inner_high[1], outer_high[1]),
        ("x-", outer_low[0], inner_low[0], inner_low[1], inner_high[1]),
        ("x+", inner_high[0], outer_high[0], inner_low[1], inner_high[1]),
    ):
        if side in closed:
            panes.append(((x_low, y_low, inner_low[2]), (x_high, y_high, inner_high[2] - thickness / 2)))
            edges.append(((x_low, y_low, inner_high[2] - thickness / 2), (x_high, y_high, inner_high[2])))
    for x_side, x_low, x_high in (("x-", outer_low[0], inner_low[0]), ("x+", inner_high[0], outer_high[0])):
        for y_side, y_low, y_high in (("y-", outer_low[1], inner_low[1]), ("y+", inner_high[1], outer_high[1])):
            if {x_side, y_side} & closed:  # the end of a single pane, too
                edges.append(((x_low, y_low, inner_low[2]), (x_high, y_high, inner_high[2])))
    made = []
    # What panes stand on shows through them. A lower side would be seen from inside of the glass: a mirror.
    for name, boxes in (("tank_glass", _boxes(panes, open_below=True)), ("tank_edge", _boxes(edges))):
        tank = new_mesh_object(name, boxes)
        context = LookContext.of({}, domain_size=size, pixel_angle=pixel_angle(spec))
        tank.data.materials.append(new_material(name, name, context))
        tank.data.shade_flat()
        made.append(tank)
    return made[0]


def _boxes(extents: list[tuple[tuple[float, ...], tuple[float, ...]]], *, open_below: bool = False) -> SurfaceMesh:
    """Axis-aligned boxes as one mesh, faces outwards; without their lower sides if they are open below."""
    unit = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=np.float64)
    quads = np.array([(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)])
    quads = quads[1:] if open_below else quads
    triangles = np.concatenate([quads[:, (0, 1, 2)], quads[:, (0, 2, 3)]])
    positions = [np.array(low) + unit * (np.array(high) - np.array(low)) for low, high in extents]
    indices = [triangles + 8 * number for number in range(len(extents))]
    return SurfaceMesh(np.concatenate(positions).astype(np.float32), np.concatenate(indices).astype(np.int32))
