"""What is in the way of an opening: walls and bodies, the domain's end, another opening."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from sim.fluid.opening_layers import NEAREST_IN_SPACINGS

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.opening import Opening
    from sim.shapes.solid import Solid

SAME_IN_SPACINGS = 1.0e-3  # openings whose particles differ by less are one


def opening_problem(
    opening: Opening,
    spacing: float,
    domain: DomainParameters,
    solids: Sequence[Solid],
    earlier: Mapping[str, Opening],
) -> str | None:
    """Why an opening cannot be where it is, or None: it is not free, or in the way of an earlier one.

    The earlier ones are named as messages call them. Of one that moves only the start counts, and not if it follows a
    body that has time to carry it elsewhere before it begins.
    """
    is_elsewhere = opening.follow is not None and opening.start_s > 0.0
    reason = None if is_elsewhere else obstruction(opening, spacing, domain, solids)
    for name, other in earlier.items():
        reason = reason or opening_collision(opening, other, name, spacing)
    return reason


def obstruction(opening: Opening, spacing: float, domain: DomainParameters, solids: Sequence[Solid]) -> str | None:
    """Why fluid cannot enter here, or None: particles of the opening outside the domain, or in a solid."""
    points = opening.points(1, opening.start_s)
    outside = ((points < domain.min) | (points > domain.max)).any(axis=1)
    if outside.any():
        return (
            f"{np.count_nonzero(outside)} of the {len(outside)} places of its opening are outside the domain; "
            "move it in, or let it point inwards"
        )
    inside = np.zeros(len(points), dtype=bool)
    for solid in solids:
        inside |= solid.signed_distance(points) < 0.25 * spacing
    if inside.any():
        return f"{np.count_nonzero(inside)} of the {len(inside)} places of its opening are in a solid body; move it out"
    return None


def is_same_opening(one: Opening, other: Opening, spacing: float) -> bool:
    """Whether two emitters have one opening that rests, or rests on one body, as when an inflow changes its speed."""
    return (
        _move_alike(one, other)
        and one.places.shape == other.places.shape
        and bool(np.allclose(one.points(1), other.points(1), rtol=0.0, atol=SAME_IN_SPACINGS * spacing))
    )


def _move_alike(one: Opening, other: Opening) -> bool:
    """Whether two openings always are where they are at the start, as seen from each other."""
    return one.path is None and other.path is None and one.follow == other.follow


def opening_collision(one: Opening, other: Opening, name: str, spacing: float) -> str | None:
    """Why an emitter cannot be in one tank with another one, of this name, or None.

    Layers that leave one must not be where those of the other do at the same time, as they would take their places.
    """
    if not _move_alike(one, other) or one.start_s >= other.end_s or other.start_s >= one.end_s:
        return None
    if is_same_opening(one, other, spacing):
        return f"is the same opening as {name}, at the same time; let one start when the other has ended"
    if float(cKDTree(one.points(1)).query(other.points(1))[0].min()) < NEAREST_IN_SPACINGS * spacing:
        return f"its opening overlaps that of {name}, at the same time; move one of them"
    return None
