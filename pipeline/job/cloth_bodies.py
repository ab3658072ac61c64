"""Whether the bodies of a job are large and thick enough for its cloths to meet them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.shapes import Solid

LEAST_EDGES = 2.0
"""A body whose shortest side has fewer edges of the cloth may show between its nodes, and pass with less than half."""


def check_bodies_for_cloth(
    job: Job, solids: Mapping[KeyPath, Solid], longest_edges: Mapping[int, float], findings: Findings
) -> None:
    """Warn of bodies that cloth may let through.

    Args:
        job: the job.
        solids: its solid shapes as far as they can be built, by path.
        longest_edges: longest distance of neighbouring nodes of the cloths, by their numbers [m].
        findings: where warnings go.
    """
    from sim.rigid.shape_grids import CELLS_PER_WALL, THIN_SHARE, grid_spacing, thin_wall
    from sim.shapes.placement import PlacedSolid

    if not longest_edges:
        return
    coarsest = max(longest_edges, key=longest_edges.__getitem__)
    for path, solid in solids.items():
        if path[0] != "rigid" or not isinstance(solid, PlacedSolid):
            continue
        axes = np.eye(3)
        sides = solid.scale * (solid.shape.support(axes) + solid.shape.support(-axes))
        body, longest = job.rigid[int(path[1])].name, longest_edges[coarsest]
        if sides.min() < LEAST_EDGES * longest:
            findings.warn(
                ("cloth", coarsest, "shape"),
                f'"{body}" is {sides.min():.3g} m across, less than two of the longest edges, {longest:.3g} m each: '
                "it may show or pass between the nodes; divide the sheet more finely, or make the body larger",
            )
        wall = thin_wall(solid)
        cell = grid_spacing(solid, wall)
        if wall < CELLS_PER_WALL * cell:
            findings.warn(
                (*path[:2], "shape"),
                f"{THIN_SHARE:.0%} of its surface or more is on walls of {wall:.3g} m or thinner; the finest grid that "
                f"cloth may meet it by has cells of {cell:.3g} m and feels walls of {CELLS_PER_WALL:g}: cloth may pass "
                "through them; make them thicker, or build the body of several",
            )
