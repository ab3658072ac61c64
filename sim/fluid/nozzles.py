"""The nozzles of a tank together: which are in each other's way, the pipes around them, and what would brake them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.fluid.opening import NEAREST_IN_SPACINGS, obstruction, pipe_clearance

if TYPE_CHECKING:
    from sim.core.domain import DomainParameters
    from sim.fluid.opening import Opening
    from sim.shapes.solid import Solid

# Nozzles whose particles, and whose sides, differ by less are one.
SAME_IN_SPACINGS = 1.0e-3


def is_same_nozzle(one: Opening, other: Opening, spacing: float) -> bool:
    """Whether two emitters have one opening and one pipe, as when an inflow changes its speed."""

    def is_equal(own: object, others: object) -> bool:
        return bool(np.allclose(own, others, rtol=0.0, atol=SAME_IN_SPACINGS * spacing))  # type: ignore[arg-type]

    return (
        one.is_round == other.is_round
        and one.points.shape == other.points.shape
        and is_equal(one.points, other.points)
        and is_equal(one.half_size, other.half_size)
        and is_equal(spacing * one.direction, spacing * other.direction)
    )


def nozzle_collision(one: Opening, other: Opening, name: str, spacing: float) -> str | None:
    """Why an emitter cannot be in one tank with another one, of this name, or None.

    Particles of one nozzle must not be where those of the other are at the same time, as nothing would push them apart,
    and not at its pipe, which stays when its emitter has ended.
    """
    if is_same_nozzle(one, other, spacing):
        if one.start_s < other.end_s and other.start_s < one.end_s:
            return f"is the same opening as {name}, at the same time; let one start when the other has ended"
        return None
    places, others_places = one.nozzle_places(), other.nozzle_places()
    if one.start_s < other.drained_s and other.start_s < one.drained_s:
        nearest = _least_distance(places, others_places)
        if nearest < NEAREST_IN_SPACINGS * spacing:
            return f"its nozzle overlaps that of {name}, at the same time; move one of them"
    clearance = pipe_clearance(one.support_in_spacings) * spacing
    nearest = min(_least_distance(places, other.pipe(spacing)), _least_distance(others_places, one.pipe(spacing)))
    if nearest < clearance:
        return (
            f"its nozzle and that of {name} are so near that the pipe around one is in the way of the other; "
            f"move them apart by {clearance - nearest:.2g} m at least"
        )
    return None


def opening_problem(
    opening: Opening,
    spacing: float,
    domain: DomainParameters,
    solids: Sequence[Solid],
    earlier: Mapping[str, Opening],
) -> str | None:
    """Why an opening cannot be where it is, or None: it is not free, or in the way of an earlier one.

    The earlier ones are named as messages call them.
    """
    reason = obstruction(opening, spacing, domain, solids)
    for name, other in earlier.items():
        reason = reason or nozzle_collision(opening, other, name, spacing)
    return reason


def pipes(openings: Sequence[Opening], spacing: float) -> list[NDArray[np.float64]]:
    """Boundary samples of the pipes of all openings [m], (m_k, 3) each; emitters with one nozzle share its pipe."""
    return [
        opening.pipe(spacing)
        for number, opening in enumerate(openings)
        if not any(is_same_nozzle(opening, earlier, spacing) for earlier in openings[:number])
    ]


def is_felt_in_nozzles(
    positions: NDArray[np.floating], openings: Sequence[Opening], support_radius: float
) -> NDArray[np.bool_]:
    """Whether particles in any of the nozzles may feel a sample at one of these positions [m], (m, 3); (m,).

    Such samples, of pipes and of walls and bodies at rest that an opening lies in, exert no friction. A nozzle gives
    its particles their velocity once a step, but within it they are unknowns of the viscosity as all others are: held
    by samples at rest, they would brake the jet that they push.
    """
    felt = np.zeros(len(positions), dtype=np.bool_)
    for opening in openings:
        felt |= opening.distance_to_nozzle(positions) < support_radius
    return felt


def _least_distance(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """From a point of one set to a point of the other [m]."""
    return float(cKDTree(one).query(other)[0].min())
