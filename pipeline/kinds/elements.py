"""Numbers of elements that bodies will have, by the job alone: nodes of cloths, particles of fluids."""

from __future__ import annotations

from functools import cache
from math import inf, prod
from typing import NamedTuple

from pipeline.base.content import status_of
from pipeline.base.errors import MissingInputError
from sim.cloth.parameters import ClothParameters, RectangleSheet
from sim.core.parameters import Vector3
from sim.fluid.parameters import FluidParameters
from sim.scene import SceneParameters
from sim.shapes.parameters import BoxShape, MeshShape

THINNEST = 1.0e-6
"""Edge of the box around a flat sheet [m]."""

MOST_IN_A_VOLUME = 1.5
"""Particles of a thin block or a narrow opening, over what its volume holds: the last ones reach beyond it."""


def most_particles(scene: SceneParameters) -> float:
    """About the most particles of all fluids."""
    return sum(most_particles_of(fluid, scene) for fluid in scene.fluid)


def most_particles_of(fluid: FluidParameters, scene: SceneParameters, *, until_s: float = inf) -> float:
    """About the most particles of a fluid: what blocks, and emitters until a time [s], give, at most a domain full."""
    filled = sum(
        prod(block.shape.size) * block.scale**3 if isinstance(block.shape, BoxShape) else inf for block in fluid.block
    )
    emitted = sum(emitter.emitted_volume(until_s) for emitter in fluid.emitter)
    room = prod(high - low for low, high in zip(scene.domain.min, scene.domain.max, strict=True))
    volume = min(MOST_IN_A_VOLUME * (filled + emitted), room)
    return min(volume, fluid.most_volume) / fluid.lattice_volume


def count_cloth_nodes(scene: SceneParameters) -> int:
    """Number of nodes of all cloths; raises as `count_nodes`."""
    return sum(count_nodes(cloth) for cloth in scene.cloth)


def count_nodes(cloth: ClothParameters) -> int:
    """Number of nodes; raises as `sheet_of`."""
    return sheet_of(cloth).nodes


class SheetMeasures(NamedTuple):
    """Measures of a cloth at rest."""

    nodes: int
    edges: Vector3  # of the box around it [m]


def sheet_of(cloth: ClothParameters) -> SheetMeasures:
    """Measures of a cloth; a mesh is read for them, once, as files of a size hold ten times as many nodes or as few.

    Raises MissingInputError: a mesh file cannot be read, or holds no sheet.
    """
    shape = cloth.shape
    if isinstance(shape, RectangleSheet):
        return SheetMeasures(prod(shape.node_counts), (*shape.size, THINNEST))
    status = status_of(shape.file, "mesh")
    return _sheet_of_mesh(shape, status.st_size, status.st_mtime_ns)


@cache
def _sheet_of_mesh(shape: MeshShape, _size: int, _mtime_ns: int) -> SheetMeasures:
    from sim.cloth.sheet import build_sheet
    from sim.shapes.solid import ShapeError

    try:
        vertices = build_sheet(shape).vertices
    except ShapeError as error:
        raise MissingInputError(f"{error}; the job needs it") from error
    x, y, z = (vertices.max(axis=0) - vertices.min(axis=0)).clip(min=THINNEST).tolist()
    return SheetMeasures(len(vertices), (x, y, z))
