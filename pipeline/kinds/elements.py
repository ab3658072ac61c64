"""Numbers of elements that bodies will have, by the job alone: nodes of cloths, particles of fluids."""

from __future__ import annotations

from functools import cache
from math import inf, prod

from pipeline.base.content import status_of
from pipeline.base.errors import MissingInputError
from sim.cloth.parameters import ClothParameters, RectangleSheet
from sim.fluid.parameters import FluidParameters
from sim.scene import SceneParameters
from sim.shapes.parameters import BoxShape, MeshShape

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
    """Number of nodes; a mesh is read for it, once, as files of a size hold ten times as many or as few.

    Raises MissingInputError: a mesh file cannot be read, or holds no sheet.
    """
    shape = cloth.shape
    if isinstance(shape, RectangleSheet):
        return prod(shape.node_counts)
    status = status_of(shape.file, "mesh")
    return _nodes_of_mesh(shape, status.st_size, status.st_mtime_ns)


@cache
def _nodes_of_mesh(shape: MeshShape, _size: int, _mtime_ns: int) -> int:
    from sim.cloth.sheet import build_sheet
    from sim.shapes.solid import ShapeError

    try:
        return len(build_sheet(shape).vertices)
    except ShapeError as error:
        raise MissingInputError(f"{error}; the job needs it") from error
