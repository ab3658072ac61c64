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

WINE_ABSORPTION_PER_M: Color = (30.0, 370.0, 300.0)
"""Of a light red wine [1/m]: decadic absorbances of 0.13, 1.6 and 1.3 per centimetre near 640, 545 and 450 nm, a colour
intensity of about 3 (method OIV-MA-AS2-07B adds those of 420, 520 and 620 nm). Red light gets through where a deep wine
absorbs least, so its coefficient is that of the band's far end."""

OIL_ABSORPTION_PER_M: Color = (6.0, 10.0, 160.0)
"""Of olive oil [1/m]: carotenoids take blue light, absorbance 0.7 per centimetre near 450 nm; red and green pass."""

COFFEE_ABSORPTION_PER_M: Color = (150.0, 350.0, 900.0)
"""Of filter coffee [1/m]: black in the cup and brown at its rim, as melanoidins absorb more towards short waves; half
of red light, a sixth of green and a hundredth of blue get through 5 mm. Chosen by eye."""

INK_ABSORPTION_PER_M: Color = (3000.0, 2200.0, 500.0)
"""Of blue writing ink [1/m]: a film of a millimetre is blue, what is thicker black. Chosen by eye."""

JUICE_REFLECTANCE: Color = (0.85, 0.38, 0.02)
JUICE_PATH_M: Color = (6.0e-3, 4.0e-3, 1.2e-3)
"""Diffuse reflectance [-] of orange juice, and how far light spreads in its pulp [m]: less than in milk. By eye."""

MUD_REFLECTANCE: Color = (0.32, 0.21, 0.12)
MUD_PATH_M: Color = (2.0e-2, 1.2e-2, 6.0e-3)
"""The same of a river that carries about a gram of silt a litre, where a hand is out of sight at a hand's depth."""

REFRACTIVE_INDEX: dict[str, float] = {
    "water": 1.333,
    "wine": 1.343,  # 13 % of ethanol by volume
    "oil": 1.469,  # olive oil has 1.4677 to 1.4705 (Codex Stan 33)
    "coffee": 1.335,  # 1.3 % of solids
    "ink": 1.34,
    "honey": 1.49,  # with 18 % of water (Chataway's table has 1.4915 at 20 °C)
    "milk": 1.35,
    "juice": 1.349,  # 11 °Brix
    "muddy_water": 1.333,
    "glass": 1.5,
}
"""Of every look that light goes into through a smooth surface [-], for yellow light at 20 °C."""

_PALEST = 0.999  # channel of a tint; what absorbs nothing at all would have no node
_THINNEST = 1.0e-4  # optical depth of a ball; of what is thinner only round-off would be seen
_DIGITS = 6  # significant, of what is computed: the last bits of a root differ from one C library to the next


def _absorption_of(tint: Color, path_m: float, *, darkest: float) -> Color:
    """Absorption that makes this of white light over so many metres, each channel at least `darkest` [1/m]."""
    red, green, blue = (-math.log(min(max(channel, darkest), _PALEST)) / path_m for channel in tint)
    return red, green, blue


def _water(color: Color | None) -> Color:
    return WATER_ABSORPTION_PER_M if color is None else _absorption_of(color, 10.0, darkest=0.02)


def _honey(color: Color | None) -> Color:
    return _absorption_of(HONEY_TINT if color is None else color, 0.01, darkest=1.0e-3)


def _absorbing(own: Color, path_m: float) -> Callable[[Color | None], Color]:
    """Absorption of a liquid [1/m], or that which makes a colour of the job of white light over a path [m]."""
    return lambda color: own if color is None else _absorption_of(color, path_m, darkest=1.0e-3)


def _spreading(path_m: Color) -> Callable[[Color | None], Color]:
    red, green, blue = path_m
    return lambda _color: (1.0 / red, 1.0 / green, 1.0 / blue)


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
    "wine": Inside(_absorbing(WINE_ABSORPTION_PER_M, 0.05), true_size=0.05, tinted_size=0.05),
    "oil": Inside(_absorbing(OIL_ABSORPTION_PER_M, 0.05), true_size=0.05, tinted_size=0.05),
    "coffee": Inside(_absorbing(COFFEE_ABSORPTION_PER_M, 0.05), true_size=0.05, tinted_size=0.05),
    "ink": Inside(_absorbing(INK_ABSORPTION_PER_M, 0.003), true_size=0.003, tinted_size=0.003),
    "milk": Inside(_spreading(MILK_PATH_M), true_size=0.15, tinted_size=0.15, scatters=True),
    "juice": Inside(_spreading(JUICE_PATH_M), true_size=0.15, tinted_size=0.15, scatters=True),
    "muddy_water": Inside(_spreading(MUD_PATH_M), true_size=1.0, tinted_size=1.0, scatters=True),
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


def dye_per_metre(look: str, density: float, color: Color | None, dye_color: Color) -> Color:
    """What dye of concentration 1 takes from light beside the look itself, for red, green and blue [1/m].

    With it the look has the colour `dye_color` as it would have that of a job. A dye takes light away, and brings none.
    """
    inside = INSIDES[look]
    own_size = inside.true_size if color is None else inside.tinted_size
    dyed = per_metre(look, density * inside.tinted_size / own_size, dye_color)
    red, green, blue = (max(0.0, d - c) for d, c in zip(dyed, per_metre(look, density, color), strict=True))
    return red, green, blue


def through_ball(absorption: Color, diameter: float) -> Color:
    """What white light becomes through a ball that absorbs [1/m], of a diameter [m], along straight rays [-].

    The mean of exp(-absorption chord) over its disc is 2 (1 - (1 + x) exp(-x)) / x², where x is absorption times
    diameter (van de Hulst 1957, "Light Scattering by Small Particles", 11.23).
    """
    depths = (max(_THINNEST, each * diameter) for each in absorption)
    red, green, blue = (float(f"{2.0 * (-math.expm1(-x) - x * math.exp(-x)) / (x * x):.{_DIGITS}g}") for x in depths)
    return red, green, blue


def seen_across(look: str) -> Color:
    """What white light becomes across a body of a look that absorbs, as dense as it is by itself [-]."""
    red, green, blue = (math.exp(-each) for each in per_metre(look, INSIDES[look].true_size))
    return red, green, blue
