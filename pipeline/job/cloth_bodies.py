"""Whether the bodies of a job are large and thick enough for its cloths to meet them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.shapes import Solid

LEAST_EDGES = 2.0
"""A body whose shortest side has fewer edges of the cloth may show between its nodes, and pass with less than half."""


@dataclass(frozen=True, eq=False)
class ClothAtStart:
    """What counts of a cloth.

    Attributes:
        longest_edge: longest distance of neighbouring nodes [m].
        pinned: where the nodes of each pin are at the start [m], (n, 3) each.
    """

    longest_edge: float
    pinned: Sequence[NDArray[np.float64]]


def check_bodies_for_cloth(
    job: Job, solids: Mapping[KeyPath, Solid], cloths: Mapping[int, ClothAtStart], findings: Findings
) -> None:
    """Warn of bodies that cloth may let through.

    A rod that a sheet is pinned along may be thin for it: the sheet hangs from it, and does not have to find it.

    Args:
        job: the job.
        solids: its solid shapes as far as they can be built, by path.
        cloths: its cloths, by their numbers.
        findings: where warnings go.
    """
    from sim.rigid.shape_grids import CELLS_PER_WALL, THIN_SHARE, grid_spacing, thin_wall
    from sim.shapes.placement import PlacedSolid

    if not cloths:
        return
    for path, solid in solids.items():
        if path[0] != "rigid" or not isinstance(solid, PlacedSolid):
            continue
        axes = np.eye(3)
        sides = solid.scale * (solid.shape.support(axes) + solid.shape.support(-axes))
        body, thickness = job.rigid[int(path[1])].name, float(sides.min())
        too_coarse = [
            number
            for number, cloth in cloths.items()
            if thickness < LEAST_EDGES * cloth.longest_edge
            and not any(_lies_along(pin, solid, thickness) for pin in cloth.pinned)
        ]
        if too_coarse:
            coarsest = max(too_coarse, key=lambda number: cloths[number].longest_edge)
            findings.warn(
                ("cloth", coarsest, "shape"),
                f'"{body}" is {thickness:.3g} m across, less than two of the longest edges, '
                f"{cloths[coarsest].longest_edge:.3g} m each: it may show or pass between the nodes; divide the sheet "
                "more finely, or make the body larger",
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


def _lies_along(pin: NDArray[np.float64], solid: Solid, thickness: float) -> bool:
    """Whether all nodes of a pin, of which there are several, are nearer to a body than it is thick [m]."""
    return len(pin) > 1 and bool((solid.signed_distance(pin) < thickness).all())
