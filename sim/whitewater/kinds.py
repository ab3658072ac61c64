"""What particles of a fluid stand for, and how many drops a particle of spray is: for who plans and draws as well."""

import math
from enum import IntEnum

GAMMA_ORDER = 4.0
"""Of the Gamma distribution of diameters (Villermaux 2007, "Fragmentation", eq. 22): 4 to 5 for the ligaments of
splashes."""

_VOLUME_OF_MEAN = math.pi / 6.0 * (GAMMA_ORDER + 1.0) * (GAMMA_ORDER + 2.0) / GAMMA_ORDER**2
"""Mean volume of drops over the cube of their mean diameter [-]."""


class LiquidKind(IntEnum):
    """What a particle of a fluid stands for; values of the array `liquid`."""

    BULK = 0
    SHEET = 1  # sheets, films and threads one particle thick
    SPRAY = 2  # drops that are smaller than it


def drops_of_particle(*, particle_radius: float, diameter: float, most: int) -> int:
    """Number of drops of one particle, of this mean diameter [m] where `most` allows them, and 1 at least."""
    return min(most, max(1, round((2.0 * particle_radius) ** 3 / (_VOLUME_OF_MEAN * diameter**3))))


def mean_diameter(*, particle_radius: float, count: int) -> float:
    """Mean diameter of so many drops, at least 1, that are one particle [m]."""
    return 2.0 * particle_radius / (_VOLUME_OF_MEAN * count) ** (1.0 / 3.0)
