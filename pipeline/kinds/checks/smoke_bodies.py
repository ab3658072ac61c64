"""Checks of smoke cells against the bodies in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.kinds.checks.mesh_grids import problem_of_mesh_grid
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import smoke_box, touch
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.smoke.parameters import MOST_CELLS, SmokeParameters

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.core.domain import DomainParameters
    from sim.shapes import PlacedSolid
    from sim.smoke.thin_walls import ThinWalls

LEAST_LAYERS = 4.0
"""Cells along each edge of a smoke's box, at least."""

MISSED = 0.05
"""Share of a body's surface that cells may miss without a word: what is beside sharp edges they always do."""


def check_bodies_in_smoke(job: Job, solids: Mapping[KeyPath, PlacedSolid], findings: Findings) -> set[int]:
    """Note bodies that are too thin for the cells of a smoke.

    Returns:
        The static bodies that no smoke can be simulated with, by number.
    """
    refused = set()
    _check_moving_bodies(job, solids, findings)
    for smoke in job.smoke:
        box = smoke_box(smoke, job.domain)
        if not has_grid(smoke, job.domain):
            continue
        for index, solid in static_bodies(job, solids).items():
            if touch(solid.bounds, box, margin=0.0) and not _check_static_body(job, smoke, index, solids, findings):
                refused.add(index)
    return refused


def has_grid(smoke: SmokeParameters, domain: DomainParameters) -> bool:
    """Whether a smoke's box has as many cells as it may; if not, that is told where its size is looked at."""
    box = smoke_box(smoke, domain)
    is_large_enough = np.all(box[1] - box[0] >= LEAST_LAYERS * smoke.cell_size)
    return bool(is_large_enough and math.prod(smoke.cell_counts(domain)) <= MOST_CELLS)


def leaks(walls: ThinWalls) -> bool:
    """Whether cells miss more of a body than what is beside its edges: air passes through it."""
    return walls.share > MISSED


def static_bodies(job: Job, solids: Mapping[KeyPath, PlacedSolid]) -> dict[int, PlacedSolid]:
    """The bodies that stand still, as far as they can be built, by number."""
    return {
        index: solids["rigid", index]
        for index, body in enumerate(job.rigid)
        if body.kind == "static" and ("rigid", index) in solids
    }


def bodies_beside(
    job: Job, smoke: SmokeParameters, index: int, solids: Mapping[KeyPath, PlacedSolid]
) -> list[PlacedSolid]:
    """Other static bodies that may hold a centre next to the surface of a static one."""
    at_rest = static_bodies(job, solids)
    return [
        solid
        for number, solid in at_rest.items()
        if number != index and touch(solid.bounds, at_rest[index].bounds, margin=smoke.cell_size)
    ]


def _check_static_body(
    job: Job, smoke: SmokeParameters, index: int, solids: Mapping[KeyPath, PlacedSolid], findings: Findings
) -> bool:
    """Note a static body that has no cell, or too few; whether the smoke can be simulated with it."""
    from sim.smoke.grid import SmokeGrid
    from sim.smoke.thin_walls import thin_walls

    solid = solids["rigid", index]
    thinnest = float(np.ptp(solid.bounds, axis=0).min())
    if SmokeGrid.of_box(smoke, job.domain).misses(solid):
        findings.error(
            ("rigid", index),
            f'is {thinnest:.3g} m thin and falls between the cells of smoke "{smoke.name}", {smoke.cell_size:g} m: '
            "the air would not notice it; use a smaller cell_size or a thicker body",
        )
        return False
    walls = thin_walls(solid, smoke, job.domain, bodies_beside(job, smoke, index, solids))
    if leaks(walls):
        findings.warn(("rigid", index), _of_thin_walls(walls, smoke))
    return True


def _check_moving_bodies(job: Job, solids: Mapping[KeyPath, PlacedSolid], findings: Findings) -> None:
    """Note bodies that move, can come into the box of a smoke, and are too thin for its cells."""
    from sim.coupling.smoke_reach import can_come, too_thin_bodies
    from sim.shapes import ShapeError
    from sim.shapes.body_geometry import BodyGeometry
    from sim.smoke.thin_walls import thin_walls_on_the_way

    moving = [index for index, body in enumerate(job.rigid) if body.kind != "static" and ("rigid", index) in solids]
    if not (moving and job.smoke):
        return
    bodies = [job.rigid[index] for index in moving]
    geometries = []
    for index, body in zip(moving, bodies, strict=True):
        try:
            geometries.append(BodyGeometry(body))
        except ShapeError as error:
            findings.error(("rigid", index, "shape"), f"is too thin for a body that moves in smoke: {error}")
            return
    for smoke in job.smoke:
        refused = dict(too_thin_bodies(smoke, bodies, geometries, job.domain))
        for number, reason in refused.items():
            findings.error(("rigid", moving[number]), reason)
        for number, (body, geometry) in enumerate(zip(bodies, geometries, strict=True)):
            if number in refused or not can_come(body, geometry, smoke, job.domain):
                continue
            walls = thin_walls_on_the_way(solids["rigid", moving[number]], smoke)
            if leaks(walls):
                findings.warn(("rigid", moving[number]), _of_thin_walls(walls, smoke))
            elif problem := problem_of_mesh_grid(
                solids["rigid", moving[number]], who=f'smoke "{smoke.name}"', what="air"
            ):
                findings.warn(("rigid", moving[number], "shape"), problem)


def _of_thin_walls(walls: ThinWalls, smoke: SmokeParameters) -> str:
    return (
        f'has walls thinner than the cells of smoke "{smoke.name}", {smoke.cell_size:g} m, which miss '
        f"{100.0 * walls.share:.0f} % of its surface: air passes through there; use a cell_size of "
        f"{rounded_down(walls.thickness):g} m or less, or thicker walls"
    )
