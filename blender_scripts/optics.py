"""Optics of looks that light goes into: what a metre of them takes away, and how dense they are by themselves.

A look's density is a factor on its coefficients. Where a job gives none it follows from the size of the body, so that a
glass of wine is as red as a vat, and a chimney's smoke as thick as a volcano's. Both sides of the Blender wall read
this; it needs the standard library alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

Color = tuple[float, float, float]

WATER_ABSORPTION_PER_M: Color = (0.30, 0.055, 0.009)
"""Of pure water for red, green and blue light [1/m] (Pope & Fry 1997, rounded)."""

HONEY_TINT: Color = (0.80, 0.59, 0.045)
"""What a centimetre of honey makes of white light: an amber between clover's and heather's, chosen by eye."""

MILK_PATH_M: Color = (10.9e-3, 6.6e-3, 2.5e-3)
"""How far light spreads in whole milk [m]: 1 / sqrt(3 a (a + s)) with the absorption a = (0.0011, 0.0024, 0.014)/mm
and the reduced scattering s = (2.55, 3.21, 3.77)/mm (Jensen et al. 2001, fig. 5)."""

_PALEST = 0.999  # channel of a tint; what absorbs nothing at all would have no node
_DIGITS = 6  # significant, of a density: the last bits of a root differ from one C library to the next


def _absorption_of(tint: Color, path_m: float, *, darkest: float) -> Color:
    """Absorption that makes this of white light over so many metres, each channel at least `darkest` [1/m]."""
    red, green, blue = (-math.log(min(max(channel, darkest), _PALEST)) / path_m for channel in tint)
    return red, green, blue


def _water(color: Color | None) -> Color:
    return WATER_ABSORPTION_PER_M if color is None else _absorption_of(color, 10.0, darkest=0.02)


def _honey(color: Color | None) -> Color:
    return _absorption_of(HONEY_TINT if color is None else color, 0.01, darkest=1.0e-3)


def _milk(_color: Color | None) -> Color:
    red, green, blue = MILK_PATH_M
    return 1.0 / red, 1.0 / green, 1.0 / blue


@dataclass(frozen=True)
class Inside:
    """What happens to light in a look.

    Attributes:
        per_metre: what takes it from its way at density 1, for red, green and blue [1/m], by the job's colour.
        true_size: of a body that has density 1 by itself [m]; others have it in inverse proportion to their size.
        tinted_size: the same with a colour of the job: such that it is seen across the body.
        scatters: whether the light comes back: what is thick of it is bright, not black.
    """

    per_metre: Callable[[Color | None], Color]
    true_size: float
    tinted_size: float
    scatters: bool = False


def _smoke(_color: Color | None) -> Color:
    return 1.0, 1.0, 1.0


INSIDES: dict[str, Inside] = {
    # Nobody sees the blue of a glass of water: what is two metres across looks as it is, all else as blue as that.
    "water": Inside(_water, true_size=2.2, tinted_size=10.0),
    "honey": Inside(_honey, true_size=0.025, tinted_size=0.01),
    "milk": Inside(_milk, true_size=0.15, tinted_size=0.15, scatters=True),
    # A plume soon has a part of its source's density, and is seen so far; flames are thin.
    "smoke": Inside(_smoke, true_size=2.5, tinted_size=2.5, scatters=True),
    "fire": Inside(_smoke, true_size=2.0, tinted_size=2.0, scatters=True),
}
"""Every look that has a density."""


def usual_density(look: str, size: float, color: Color | None = None) -> float:
    """Density of a look by itself, on a body of a size [m]; of smoke that of its source."""
    inside = INSIDES[look]
    return float(f"{(inside.true_size if color is None else inside.tinted_size) / size:.{_DIGITS}g}")


def per_metre(look: str, density: float, color: Color | None = None) -> Color:
    """What a look takes from light, for red, green and blue [1/m]."""
    red, green, blue = INSIDES[look].per_metre(color)
    return density * red, density * green, density * blue
