"""The box that holds the particles: closed faces stop them, open faces let them go."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.core.domain import DomainParameters
    from sim.core.parameters import Vector3

UNLIMITED = 1.0e30
"""Coordinate that no particle reaches [m]."""


@dataclass(frozen=True)
class Box:
    """What holds the particles.

    Attributes:
        walls: lower and upper corner of the closed faces [m]; out of reach where a face is open.
        openings: lower and upper corner of the open faces [m]; out of reach where a face is closed.
    """

    walls: tuple[Vector3, Vector3]
    openings: tuple[Vector3, Vector3]

    @classmethod
    def of_domain(cls, domain: DomainParameters) -> Box:
        """The box of a domain."""
        return cls(_limits(domain, of_walls=True), _limits(domain, of_walls=False))


def check_particles(
    positions: NDArray[np.floating], velocities: NDArray[np.floating], domain: DomainParameters
) -> None:
    """Raise ValueError for particles of the wrong shape, not finite, or outside the domain.

    Args:
        positions: [m], (n, 3).
        velocities: [m/s], (n, 3).
        domain: where they have to be.
    """
    if positions.ndim != 2 or positions.shape[1] != 3 or velocities.shape != positions.shape:
        raise ValueError(f"positions and velocities must both be (n, 3), got {positions.shape} and {velocities.shape}")
    if not (np.isfinite(positions).all() and np.isfinite(velocities).all()):
        raise ValueError("positions and velocities must be finite numbers")
    outside = ((positions < np.float32(domain.min)) | (positions > np.float32(domain.max))).any(axis=1).sum()
    if outside:
        raise ValueError(f"{outside} of {len(positions)} particles start outside the domain")


def _limits(domain: DomainParameters, *, of_walls: bool) -> tuple[Vector3, Vector3]:
    """Lower and upper corner of the box of closed faces, or of open ones; out of reach where a face is the other."""
    low, high = list(domain.min), list(domain.max)
    for axis, name in enumerate("xyz"):
        if (f"{name}-" in domain.open_faces) == of_walls:
            low[axis] = -UNLIMITED
        if (f"{name}+" in domain.open_faces) == of_walls:
            high[axis] = UNLIMITED
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
