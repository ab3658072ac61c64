"""Whether the bodies of a job are large and thick enough for its cloths to meet them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings
from sim.cloth.parameters import BODY_GRID_CELLS

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.shapes import Solid
    from sim.shapes.mesh_solid import MeshSolid

LEAST_EDGES = 2.0
"""A body whose shortest side has fewer edges of the cloth may show between its nodes, and pass with less than half."""

PROBES = 1000
"""Points of a mesh's surface below which its thickness is looked at."""

THIN_SHARE = 0.1
"""Share of a mesh's surface that may be thin: what is beside its sharp edges always is."""


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
    from sim.shapes.mesh_solid import MeshSolid
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
        if isinstance(solid.shape, MeshSolid):
            cell = float(sides.max()) / BODY_GRID_CELLS
            share = _thin_share(solid.shape, cell / solid.scale)
            if share > THIN_SHARE:
                findings.warn(
                    (*path[:2], "shape"),
                    f"{share:.0%} of its surface is on walls thinner than {2.0 * cell:.3g} m, two cells of the grid "
                    f"that cloth meets it by, its longest side over {BODY_GRID_CELLS}: cloth may pass through them; "
                    "make them thicker, or build the body of several",
                )


def _thin_share(solid: MeshSolid, cell: float) -> float:
    """Share of a mesh's surface that has less than half a cell [m] of solid around a point one cell below it."""
    from sim.shapes.sampling import stratified_points

    points, face = stratified_points(solid.mesh, PROBES)
    inwards = -solid.mesh.area_vectors[face]
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    return float((solid.signed_distance(points + cell * inwards) > -0.5 * cell).mean())
