"""The closed faces of the domain, as rigid bodies meet them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Wall:
    """A closed face of the domain: a rectangle in a plane across an axis."""

    name: str  # the face, such as "z-"
    axis: int  # the axis across it
    side: float  # 1 if the domain lies on the side of larger coordinates, else -1
    offset: float  # coordinate of its plane [m]
    lower: Array  # the rectangle's corners [m], (2,), on the two other axes in ascending order
    upper: Array

    @property
    def normal(self) -> Array:
        """Into the domain, (3,)."""
        normal = np.zeros(3)
        normal[self.axis] = self.side
        return normal

    def distance(self, lower: Array, upper: Array) -> float:
        """From the plane to the nearest point of an axis-aligned box [m]; negative where the box reaches beyond."""
        return float(lower[self.axis] - self.offset if self.side > 0.0 else self.offset - upper[self.axis])

    def holds(self, centre_of_mass: Array) -> bool:
        """Whether a body's centre of mass [m], (3,), is inside of its plane: what left by an open face falls on."""
        return bool(self.side * (centre_of_mass[self.axis] - self.offset) > 0.0)

    def is_beside(self, points: Array) -> NDArray[np.bool_]:
        """Whether the feet of the perpendiculars from points [m], (3, m), are in the rectangle."""
        along = points[[axis for axis in range(3) if axis != self.axis]]
        return np.asarray(np.all((along >= self.lower[:, None]) & (along <= self.upper[:, None]), axis=0))


def walls_of(domain: DomainParameters) -> list[Wall]:
    """The walls of a domain, in the order x-, x+, y-, y+, z-, z+."""
    corners = (np.asarray(domain.min, dtype=np.float64), np.asarray(domain.max, dtype=np.float64))
    walls = []
    for axis, letter in enumerate("xyz"):
        others = [other for other in range(3) if other != axis]
        for corner, sign, side in zip(corners, "-+", (1.0, -1.0), strict=True):
            if f"{letter}{sign}" not in domain.open_faces:
                lower, upper = (each[others] for each in corners)
                walls.append(Wall(f"{letter}{sign}", axis, side, float(corner[axis]), lower, upper))
    return walls
