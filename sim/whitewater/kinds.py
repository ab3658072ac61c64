"""What particles of a fluid stand for, and how many drops a particle of spray is: for who plans and draws as well."""

import math
import operator
from enum import IntEnum

GAMMA_ORDER = 4.0
"""Of the Gamma distribution of diameters (Villermaux 2007, "Fragmentation", eq. 22): 4 to 5 for the ligaments of
splashes."""

LIGAMENT_ORDER = 4.0
"""The same of the widths of ligaments, which drops are about as large as: a compound Gamma distribution, as sheets that
break up have (Kooij et al. 2018, "What determines the drop size in sprays?"), of an order that looks like a splash."""
MEAN_SHARE = 0.5
"""Drops of a ligament of mean width, at most, as a share of what one particle may be: thinner ones have more [-]."""
LARGEST_SHARE = 0.5
"""Of a particle that one drop is about at most, unless drops are larger [-]: spray is no ball of a particle's size."""

_VOLUME_OF_MEAN = math.pi / 6.0 * (GAMMA_ORDER + 1.0) * (GAMMA_ORDER + 2.0) / GAMMA_ORDER**2
"""Mean volume of drops over the cube of their mean diameter [-]."""
_WIDEST, _STEPS = 5.0, 200  # of the integral over widths: beyond five means is 1e-5 of the ligaments


class LiquidKind(IntEnum):
    """What a particle of a fluid stands for; values of the array `liquid`."""

    BULK = 0
    SHEET = 1  # sheets, films and threads one particle thick
    SPRAY = 2  # drops that are smaller than it


def drops_of_mean(*, particle_radius: float, diameter: float, most: int) -> float:
    """How many drops a particle of a ligament of mean width is [-]; they may be larger than this diameter [m]."""
    return min(MEAN_SHARE * most, (2.0 * particle_radius) ** 3.0 / (_VOLUME_OF_MEAN * diameter**3.0))


def mean_diameter(*, particle_radius: float, diameter: float, most: int) -> float:
    """Mean diameter of these drops [m], which are not larger than the particle."""
    of_mean = drops_of_mean(particle_radius=particle_radius, diameter=diameter, most=most)
    return float(2.0 * particle_radius / (_VOLUME_OF_MEAN * max(1.0, of_mean)) ** (1.0 / 3.0))


def bounds_of_drops(*, of_mean: float, most: int) -> tuple[int, int]:
    """Fewest and most drops of a particle, by their number where the ligament has the mean width."""
    return min(most, 1 if LARGEST_SHARE * of_mean < 1.0 else round(1.0 / LARGEST_SHARE)), most


def drops_of_particle(*, particle_radius: float, diameter: float, most: int) -> float:
    """Mean number of drops of a particle that has broken up, at most `most`: ligaments differ in width."""
    of_mean = drops_of_mean(particle_radius=particle_radius, diameter=diameter, most=most)
    step = _WIDEST / _STEPS
    widths = [(number + 0.5) * step for number in range(_STEPS)]
    shares = [width ** (LIGAMENT_ORDER - 1.0) * math.exp(-LIGAMENT_ORDER * width) for width in widths]
    fewest, most = bounds_of_drops(of_mean=of_mean, most=most)
    numbers = [min(most, max(fewest, of_mean / width**3)) for width in widths]
    return math.fsum(map(operator.mul, shares, numbers)) / math.fsum(shares)
