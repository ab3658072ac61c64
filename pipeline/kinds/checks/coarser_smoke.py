"""Coarser cells of smoke for previews, as far as no source and no body is lost between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.kinds.checks.smoke_bodies import LEAST_LAYERS, bodies_beside, has_grid, leaks
from pipeline.model.boxes import Box, smoke_box, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.smoke.parameters import SmokeParameters

if TYPE_CHECKING:
    from sim.shapes import PlacedSolid
    from sim.smoke.thin_walls import ThinWalls

STEPS = 4
"""Factors that are tried between 1 and the largest."""


def coarser_cell_sizes(job: Job, largest_factor: float) -> list[float]:
    """Cell sizes [m] of the smokes, grown by this factor at most, that lose no source and no body.

    Where the job's own cells do so they are kept: what is told of them is then told of what was written. So it is of
    walls that these are too large for already. Bodies that close a gap that wind needs do not count.

    Args:
        job: with absolute mesh paths; its shapes are built as far as they can be.
        largest_factor: above 1.
    """
    from pipeline.kinds.solids import build_solids

    unheard = Findings()  # all of it is told when the changed job is checked
    if not job.smoke:
        return []
    solids = build_solids(job, unheard)
    factors = np.linspace(largest_factor, 1.0, STEPS, endpoint=False).tolist()
    return [
        next(
            (smoke.cell_size * factor for factor in factors if _carries(job, index, smoke.cell_size * factor, solids)),
            smoke.cell_size,
        )
        for index, smoke in enumerate(job.smoke)
    ]


def _carries(job: Job, index: int, cell_size: float, solids: Mapping[KeyPath, PlacedSolid]) -> bool:
    """Whether cells of this size [m] show a smoke's box, its sources and the bodies in it."""
    smoke = job.smoke[index].model_copy(update={"cell_size": cell_size})
    box = smoke_box(smoke, job.domain)
    if np.any(box[1] - box[0] < LEAST_LAYERS * cell_size):
        return False
    if not has_grid(smoke, job.domain):
        return True  # refused for its many cells
    sources = {path[3]: solid for path, solid in solids.items() if path[:3] == ("smoke", index, "source")}
    bodies = [int(path[1]) for path in solids if path[0] == "rigid"]
    return all(
        _has_cells(job, solid, box, cell_size, solids, moves=smoke.source[int(number)].moves)
        for number, solid in sources.items()
    ) and not any(_is_lost(job, number, solids, job.smoke[index], smoke) for number in bodies)


def _has_cells(
    job: Job, source: PlacedSolid, box: Box, cell_size: float, solids: Mapping[KeyPath, PlacedSolid], *, moves: bool
) -> bool:
    """Whether a source is as thick as a cell if it moves, or else has the centre of one in free air."""
    from pipeline.kinds.checks.smoke import are_free, centres_inside

    if moves:
        return bool(np.ptp(source.bounds, axis=0).min() >= cell_size)
    centres = centres_inside(source, box, cell_size)
    return centres is None or bool(are_free(job, centres, source, solids).any())


def _is_lost(
    job: Job,
    number: int,
    solids: Mapping[KeyPath, PlacedSolid],
    as_written: SmokeParameters,
    smoke: SmokeParameters,
) -> bool:
    """Whether a body falls between the cells of a smoke, now or, if it moves, in some place that it can come to.

    So does one with walls that air passes through, unless it passes through them in the job's own cells.
    """
    from sim.coupling.smoke_reach import can_come
    from sim.shapes import PlacedSolid, ShapeError
    from sim.shapes.body_geometry import BodyGeometry
    from sim.smoke.grid import SmokeGrid
    from sim.smoke.thin_walls import thin_walls, thin_walls_on_the_way

    body, solid = job.rigid[number], solids["rigid", number]
    if body.kind == "static":
        is_thin = np.ptp(solid.bounds, axis=0).min() < smoke.cell_size
        if is_thin and SmokeGrid.of_box(smoke, job.domain).misses(solid):
            return True
        return touch(solid.bounds, smoke_box(smoke, job.domain), margin=0.0) and _leaks_more(
            as_written,
            smoke,
            lambda each: thin_walls(solid, each, job.domain, bodies_beside(job, each, number, solids)),
        )
    at_rest = PlacedSolid(solid.shape, solid.scale, np.eye(3), np.zeros(3))
    is_thin = np.ptp(at_rest.bounds, axis=0).min() < smoke.cell_size
    if not (is_thin or _leaks_more(as_written, smoke, lambda each: thin_walls_on_the_way(solid, each))):
        return False
    try:
        geometry = BodyGeometry(body)
    except ShapeError:
        return False  # refused for that
    return can_come(body, geometry, smoke, job.domain)


def _leaks_more(
    as_written: SmokeParameters, smoke: SmokeParameters, walls_in: Callable[[SmokeParameters], ThinWalls]
) -> bool:
    """Whether air passes through a body in the cells of a smoke, but not in those as written."""
    return leaks(walls_in(smoke)) and not leaks(walls_in(as_written))
