"""Sizes of bodies by the job alone: what their looks are scaled by, and the boxes that a camera shows."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from math import hypot, pi, prod
from typing import NamedTuple

import numpy as np

from pipeline.base.content import status_of
from pipeline.base.errors import MissingInputError
from pipeline.kinds.elements import sheet_of
from pipeline.model.boxes import Box
from pipeline.model.job import Job
from sim.cloth.parameters import ClothParameters
from sim.core.domain import DomainParameters
from sim.core.parameters import Vector3
from sim.fluid.parameters import FluidParameters
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import AnimationShape, BoxShape, FileShape, Placement, Shape
from sim.smoke.parameters import SmokeParameters

WINDOW_SHARE = 0.2
"""Of the cells of a smoke's box that a window is taken to have, on average over a film: a guess."""


class Measures(NamedTuple):
    """Measures of a shape as it is, neither scaled nor turned."""

    volume: float  # [m³]
    edges: Vector3  # of the box around it [m]


DUCK = Measures(0.17164, (1.0, 0.69968, 0.77904))  # 1 m long
BUNNY = Measures(0.089719, (0.75722, 0.48688, 1.0))  # 1 m high
"""To 1e-4, and a test that models them says so: that takes a second each."""


def measures_of(placement: Placement) -> Measures:
    """Volume and box of a shape, scaled but not turned; files of meshes are read once.

    Raises MissingInputError: a mesh file cannot be read, or its shape cannot be built.
    """
    shape = placement.shape
    if shape.type == "duck":
        return _scaled(DUCK, shape.length * placement.scale)
    if shape.type == "bunny":
        return _scaled(BUNNY, shape.height * placement.scale)
    if isinstance(shape, FileShape):
        status = status_of(shape.file, "mesh")
        return _scaled(_of_file(shape, status.st_size, status.st_mtime_ns), placement.scale)
    return _scaled(_built(shape), placement.scale)


def _scaled(measures: Measures, factor: float) -> Measures:
    x, y, z = measures.edges
    return Measures(measures.volume * factor**3, (x * factor, y * factor, z * factor))


@cache
def _of_file(shape: Shape, _size: int, _mtime_ns: int) -> Measures:
    return _built(shape)


@cache
def _built(shape: Shape) -> Measures:
    from sim.shapes.placement import build_rest_shape
    from sim.shapes.solid import ShapeError

    try:
        rest = build_rest_shape(shape)
    except ShapeError as error:
        raise MissingInputError(f"{error}; the job needs it") from error
    x, y, z = (float(rest.support(axis).item() + rest.support(-axis).item()) for axis in np.eye(3)[:, None])
    return Measures(rest.volume, (x, y, z))


def box_of(placement: Placement) -> Box:
    """The box around a shape in the world [m], (2, 3): that of its own box, turned. Raises as `measures_of`."""
    from sim.shapes.placement import build_solid

    box = BoxShape(type="box", size=measures_of(placement).edges)
    bounds: Box = build_solid(placement.model_copy(update={"shape": box, "scale": 1.0})).bounds
    return bounds


# --- sizes of looks ---


def size_of_solid(_job: Job, body: RigidBodyParameters) -> float:
    """Edge of the cube of a body's volume [m]. Raises as `measures_of`."""
    return float(measures_of(body).volume ** (1.0 / 3.0))


def expected_cells(smoke: SmokeParameters, domain: DomainParameters) -> float:
    """About how many cells of a smoke are computed at a time.

    Of a window nobody knows before; an open grid is taken to have as many as its box.
    """
    return prod(smoke.cell_counts(domain)) * (WINDOW_SHARE if smoke.grid == "window" else 1.0)


def size_of_liquid(job: Job, fluid: FluidParameters) -> float:
    """Edge of the cube of all of a fluid that there will be [m]. Raises as `measures_of`."""
    filled = sum(measures_of(block).volume for block in fluid.block)
    emitted = sum(emitter.emitted_volume(job.film_s) for emitter in fluid.emitter)
    room = prod(high - low for low, high in zip(job.domain.min, job.domain.max, strict=True))
    # What opens after the end of the film is never seen; of a fluid that is not there any size will do.
    volume = min(filled + emitted, room, fluid.most_volume) or fluid.lattice_volume
    return float(volume ** (1.0 / 3.0))


def size_of_smoke(job: Job, smoke: SmokeParameters) -> float:
    """Optical size of the strongest source [m]: the diameter of the ball of its volume, times its density.

    The soot that its fuel leaves counts as well. Sources that emit no smoke in the film count only if all are such.
    Raises as `measures_of`.
    """
    diameters = [(6.0 / pi * measures_of(source).volume) ** (1.0 / 3.0) for source in smoke.source]
    soot = 0.0 if smoke.fire is None else smoke.fire.soot
    strengths = [
        (source.density + soot * source.fuel) * source.largest_strength(0.0, job.film_s)
        if source.emits_during(0.0, job.film_s)
        else 0.0
        for source in smoke.source
    ]
    return max(map(prod, zip(diameters, strengths, strict=True))) or max(diameters)


def size_of_sheet(_job: Job, cloth: ClothParameters) -> float:
    """Diagonal of a cloth at rest [m]. Raises as `sheet_of`."""
    return hypot(*sheet_of(cloth).edges)


# --- boxes for a camera ---


def boxes_of_body(_job: Job, body: RigidBodyParameters) -> Iterator[Box]:
    """Where a body starts, and where its keyframes or its file lead it. Raises as `measures_of`."""
    if isinstance(body.shape, AnimationShape):
        measures_of(body)
        from sim.shapes.animation import boxes_of_animation

        yield from boxes_of_animation(body, body.shape)
        return
    yield box_of(body)
    for key in body.keyframe[1:]:
        yield box_of(body.model_copy(update={"position": key.position, "rotation_deg": key.rotation_deg}))


def boxes_of_sheet(_job: Job, cloth: ClothParameters) -> Iterator[Box]:
    """Where a cloth starts. Raises as `sheet_of`."""
    shape = BoxShape(type="box", size=sheet_of(cloth).edges)
    yield box_of(Placement(shape=shape, position=cloth.position, rotation_deg=cloth.rotation_deg))
