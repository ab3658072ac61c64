"""Solids of a job: every shape that can be built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.kinds.checks.meshes import mesh_exists
from pipeline.kinds.table import placements
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings

if TYPE_CHECKING:
    from sim.shapes import PlacedSolid


def build_solids(job: Job, findings: Findings) -> Mapping[KeyPath, PlacedSolid]:
    """Every shape that can be built, by its path."""
    from sim.shapes import ShapeError, build_solid

    solids = {}
    for path, placement in placements(job):
        if not mesh_exists(placement.shape, path, findings):
            continue
        try:
            solid = build_solid(placement)
        except ShapeError as error:
            findings.error((*path, "shape"), str(error))
        else:
            solids[path] = solid
            for warning in solid.warnings:
                findings.warn((*path, "shape"), warning)
    return solids
