"""Checks of shapes: files that are there, solids that can be built, walls that a grid of distances can show."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.model.amounts import count, gigabytes
from pipeline.model.boxes import Box
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, suggestion
from sim.shapes.parameters import CompoundShape, FileShape, PieceShape, Placement

OUT_OF_SCALE = 30.0
"""A mesh so many times larger than the scene is not meant: a cell of its grid of distances is a tenth of the scene."""

TRIANGLE_BYTES = 300.0
"""Memory of a triangle in Blender and Cycles, 294 as measured with a million."""

if TYPE_CHECKING:
    from pipeline.kinds.base import Solids
    from sim.rigid.parameters import RigidBodyParameters
    from sim.shapes.placement import PlacedSolid


def build_solids(
    placements: Iterable[tuple[KeyPath, Placement]], findings: Findings, *, room_bytes: float = math.inf
) -> Solids:
    """Every shape that can be built, by its path; notes what is wrong with the others.

    None is built any more once the meshes of files have more triangles than can be drawn in so much memory [bytes].
    """
    from sim.shapes.placement import SharedShapes, build_solid
    from sim.shapes.solid import ShapeError

    solids = {}
    shapes, triangles, meshes = SharedShapes(), 0, 0
    for path, placement in placements:
        if not mesh_exists(placement.shape, path, findings):
            continue
        try:
            solids[path] = build_solid(placement, shapes)
        except ShapeError as error:
            findings.error((*path, "shape"), str(error))
            continue
        if isinstance(placement.shape, FileShape) and getattr(placement, "is_own_model", True):
            triangles, meshes = triangles + len(solids[path].rest_mesh().faces), meshes + 1
            if triangles * TRIANGLE_BYTES > room_bytes:
                findings.error(
                    (*path, "shape"),
                    f"is more than can be drawn: the first {meshes:,} meshes have {count(triangles)} triangles, which "
                    f"need {gigabytes(triangles * TRIANGLE_BYTES)}, and {gigabytes(room_bytes)} are free; give them "
                    "fewer triangles, or make those of one file a group by count, which shares one mesh",
                )
                break
        for warning in solids[path].warnings:
            findings.warn((*path, "shape"), warning)
    return solids


def in_scale(solids: Solids, regions: Sequence[Box], findings: Findings) -> Solids:
    """The solids but for meshes far larger than the boxes that are simulated [m], (2, 3) each, which are noted.

    They are in another unit most likely, and their distances, on a grid, would be coarser than the scene.
    """
    from sim.shapes.mesh_solid import MeshSolid

    room = float(np.max(np.max(regions, axis=0)[1] - np.min(regions, axis=0)[0]))
    kept = {}
    for path, solid in solids.items():
        extent = float(np.max(solid.bounds[1] - solid.bounds[0]))
        if not isinstance(solid.shape, MeshSolid) or extent < OUT_OF_SCALE * room:
            kept[path] = solid
            continue
        unit, factor = ("millimetres", 0.001) if extent > 10.0 * OUT_OF_SCALE * room else ("centimetres", 0.01)
        findings.error(
            (*path, "shape"),
            f"is {extent:.3g} m long in a scene of {room:.3g} m; if its file is in {unit}, scale = {factor:g} makes it "
            f"{extent * factor:.3g} m, and shape.size gives its longest edge in metres",
        )
    return kept


def mesh_exists(shape: object, path: KeyPath, findings: Findings) -> bool:
    """Whether the shape of a table needs no file, or its file is there; notes what is wrong."""
    if isinstance(shape, PieceShape):
        return mesh_exists(shape.of, path, findings)
    if isinstance(shape, CompoundShape):
        there = [mesh_exists(part.shape, (*path, "shape", "part", n), findings) for n, part in enumerate(shape.part)]
        return all(there)
    return not isinstance(shape, FileShape) or file_exists(shape.file, "mesh", (*path, "shape", "file"), findings)


def file_exists(name: str, kind: str, key: KeyPath, findings: Findings) -> bool:
    """Whether a file, by its absolute path, is there; notes what is wrong with the key, and the name that may be meant.

    `kind` is what it is, for messages: "mesh".
    """
    file = Path(name)
    if file.is_file():
        return True
    if file.is_dir():
        findings.error(key, f"{file} is a folder, not a {kind}")
    elif not file.parent.is_dir():
        findings.error(key, f"no such file: {file}; there is no folder {file.parent}")
    else:
        neighbours = [each.name for each in file.parent.iterdir()]
        findings.error(key, f"no such file: {file}{suggestion(file.name, neighbours)}")
    return False


def warn_of_thin_walls(
    number: int,
    body: RigidBodyParameters,
    solid: PlacedSolid,
    findings: Findings,
    told: set[str],
    *,
    who: str,
    what: str,
) -> None:
    """Note a body, or the first of the pieces of one, whose walls are too thin for a grid; `told` are their names."""
    name = body.whole or body.name
    if name not in told and (problem := thin_wall_problem(body, solid, who=who, what=what)):
        told.add(name)
        findings.warn(("rigid", number, "shape"), problem)


def thin_wall_problem(body: RigidBodyParameters, solid: PlacedSolid, *, who: str, what: str) -> str | None:
    """Reason why walls of a body are too thin for the finest grid of its distances; None if they are not.

    `who` meets it by that grid, and `what` may pass through the walls then; primitives need no grid.
    """
    from sim.shapes.cutting import wall_and_cell
    from sim.shapes.distance_grids import CELLS_PER_WALL, THIN_SHARE

    unturned = replace(solid, rotation=np.eye(3), position=np.zeros(3))
    wall, cell = wall_and_cell(body.shape if isinstance(body.shape, PieceShape) else None, unturned)
    if wall >= CELLS_PER_WALL * cell:
        return None
    return (
        f"{THIN_SHARE:.0%} of its surface or more is on walls of {wall:.3g} m or thinner; the finest grid that {who} "
        f"may meet it by has cells of {cell:.3g} m and feels walls of {CELLS_PER_WALL:g}: {what} may pass through "
        "them; make them thicker, or build the body of several"
    )
