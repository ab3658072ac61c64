"""Checks of mesh walls against the grids of distances that the device reads."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sim.shapes import PlacedSolid


def problem_of_mesh_grid(solid: PlacedSolid, *, who: str, what: str) -> str | None:
    """Reason why walls of a body are too thin for the finest grid of its distances; None if they are not.

    Args:
        solid: the body; primitives need no grid.
        who: meets it by that grid.
        what: may pass through the walls then.
    """
    from sim.shapes.distance_grids import CELLS_PER_WALL, THIN_SHARE, grid_spacing, thin_wall

    wall = thin_wall(solid)
    cell = grid_spacing(solid, wall)
    if wall >= CELLS_PER_WALL * cell:
        return None
    return (
        f"{THIN_SHARE:.0%} of its surface or more is on walls of {wall:.3g} m or thinner; the finest grid that {who} "
        f"may meet it by has cells of {cell:.3g} m and feels walls of {CELLS_PER_WALL:g}: {what} may pass through "
        "them; make them thicker, or build the body of several"
    )
