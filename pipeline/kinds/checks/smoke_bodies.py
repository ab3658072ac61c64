"""Checks of smoke cells against the bodies in them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.shapes import warn_of_thin_walls
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import smoke_box, touch
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.core.domain import DomainParameters
from sim.coupling.smoke_reach import can_come, too_thin_bodies
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.placement import PlacedSolid
from sim.shapes.solid import ShapeError
from sim.smoke.grid import SmokeGrid, Window
from sim.smoke.parameters import MOST_CELLS, SmokeParameters
from sim.smoke.thin_walls import ThinWalls, thin_walls, thin_walls_on_the_way

GeometryBuilder = Callable[[int], "BodyGeometry | None"]

# Cells along each edge of a smoke's box, at least.
LEAST_LAYERS = 4.0
# Share of a body's surface that cells may miss: what is beside sharp edges they always do.
MISSED = 0.05


def geometry_builder(job: Job, findings: Findings) -> GeometryBuilder:
    """Builder of the geometry of a body that moves, by number; None for one too thin to have an inside, as is noted."""

    @cache
    def build(number: int) -> BodyGeometry | None:
        try:
            return BodyGeometry(job.rigid[number])
        except ShapeError as error:
            findings.error(("rigid", number, "shape"), f"is too thin for a body that moves in smoke: {error}")
            return None

    return build


def check_bodies_in_smoke(
    job: Job, smoke: SmokeParameters, solids: Solids, geometry_of: GeometryBuilder, findings: Findings
) -> set[int]:
    """Note bodies that are too thin for the cells of a smoke; returns the static ones without any cell, by number."""
    if not _has_grid(smoke, job.domain):
        return set()
    _check_moving_bodies(job, smoke, solids, geometry_of, findings)
    standing = static_bodies(job, solids)
    box = np.array(smoke.limits(job.domain))
    inside = [number for number, solid in standing.items() if touch(solid.bounds, box, margin=0.0)]
    return {number for number in inside if not _has_cells(job, smoke, number, standing, findings)}


def static_bodies(job: Job, solids: Solids) -> dict[int, PlacedSolid]:
    """The bodies that stand still, as far as they can be built, by number."""
    return {
        index: solids["rigid", index]
        for index, body in enumerate(job.rigid)
        if body.kind == "static" and ("rigid", index) in solids
    }


def _has_grid(smoke: SmokeParameters, domain: DomainParameters) -> bool:
    """Whether a smoke's box has as many cells as it may; if not, the check of its size tells."""
    box = smoke_box(smoke, domain)
    is_large_enough = np.all(box[1] - box[0] >= LEAST_LAYERS * smoke.cell_size)
    return bool(is_large_enough and (smoke.grid != "box" or math.prod(smoke.cell_counts(domain)) <= MOST_CELLS))


def _has_cells(
    job: Job, smoke: SmokeParameters, number: int, standing: Mapping[int, PlacedSolid], findings: Findings
) -> bool:
    """Whether a static body has a cell in a smoke's grid; notes one that has none, or through which air passes."""
    solid = standing[number]
    window = None if smoke.grid == "box" else Window.around(solid.bounds, smoke, job.domain)
    if SmokeGrid.of_box(smoke, job.domain, window).misses(solid):
        thinnest = float(np.ptp(solid.bounds, axis=0).min())
        findings.error(
            ("rigid", number),
            f'is {thinnest:.3g} m thin and falls between the cells of smoke "{smoke.name}", {smoke.cell_size:g} m: '
            "the air would not notice it; use a smaller cell_size or a thicker body",
        )
        return False
    others = [
        other
        for each, other in standing.items()
        if each != number and touch(other.bounds, solid.bounds, margin=smoke.cell_size)
    ]
    _check_walls(thin_walls(solid, smoke, job.domain, others), smoke, number, findings)
    return True


def check_mesh_grids(
    job: Job, smoke: SmokeParameters, solids: Solids, geometry_of: GeometryBuilder, findings: Findings
) -> None:
    """Note meshes that can come into a smoke's box, and whose walls are too thin for the finest grid of distances."""
    told: set[str] = set()
    for number in _moving(job, solids):
        body, solid, geometry = job.rigid[number], solids["rigid", number], geometry_of(number)
        if geometry is not None and can_come(body, geometry, smoke, job.domain):
            warn_of_thin_walls(number, body, solid, findings, told, who=f'smoke "{smoke.name}"', what="air")


def _moving(job: Job, solids: Solids) -> list[int]:
    """The bodies that move, as far as they can be built, by number."""
    return [index for index, body in enumerate(job.rigid) if body.kind != "static" and ("rigid", index) in solids]


def _check_moving_bodies(
    job: Job, smoke: SmokeParameters, solids: Solids, geometry_of: GeometryBuilder, findings: Findings
) -> None:
    """Note bodies that move, can come into the box of a smoke, and are too thin for its cells."""
    for number in _moving(job, solids):
        body, solid = job.rigid[number], solids["rigid", number]
        unturned = replace(solid, rotation=np.eye(3), position=np.zeros(3))
        is_thick = np.ptp(unturned.bounds, axis=0).min() >= smoke.cell_size
        walls = thin_walls_on_the_way(solid, smoke)
        if is_thick and walls.share <= MISSED:
            continue  # without its geometry, which is dear to build
        if (geometry := geometry_of(number)) is None:
            continue
        if too_thin := too_thin_bodies(smoke, [body], [geometry], job.domain):
            findings.error(("rigid", number), too_thin[0][1])
        elif can_come(body, geometry, smoke, job.domain):
            _check_walls(walls, smoke, number, findings)


def _check_walls(walls: ThinWalls, smoke: SmokeParameters, number: int, findings: Findings) -> None:
    """Note a body of which cells miss more than what is beside its edges: air passes through it."""
    if walls.share > MISSED:
        findings.warn(
            ("rigid", number),
            f'has walls thinner than the cells of smoke "{smoke.name}", {smoke.cell_size:g} m, which miss '
            f"{100.0 * walls.share:.0f} % of its surface: air passes through there; use a cell_size of "
            f"{rounded_down(walls.thickness):g} m or less, or thicker walls",
        )
