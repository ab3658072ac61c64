"""Colours of particles by their values, and of bodies by their materials. Pure."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Colors = NDArray[np.uint8]

_RISING = ("#26337a", "#2a5fb0", "#2f93c9", "#4fc3c7", "#a6e3c0", "#f6f3c4", "#ffc35c", "#f07f3c", "#d43d3d")
"""From rest to fast: equal steps look about equally large, and the order shows without hues."""
_AROUND = ("#2c5fc9", "#7fa6e6", "#ccd2d4", "#f0a37a", "#c8382f")
"""Below, at and above a middle."""

SURFACE = (92, 158, 220)
WHITEWATER = (240, 246, 250)
PIN = (255, 190, 70)
CLOTH = (205, 120, 96)
BODY = (176, 176, 170)


def ramp(values: ArrayLike, low: float, high: float, *, around: bool = False) -> Colors:
    """Colours of values, (n,), between those of the first and the last colour; what is not finite counts as low.

    `around`: the middle is neutral. Returns sRGB, (n, 3) uint8.
    """
    stops = _rgb(_AROUND if around else _RISING)
    span = high - low
    share = (np.asarray(values, np.float64) - low) / (span if span > 0.0 else 1.0)
    share = np.clip(np.nan_to_num(share, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
    # A table of 256 colours: a million particles take 10 ms instead of 60.
    places = np.linspace(0.0, len(stops) - 1.0, 256)
    table = np.stack([np.interp(places, np.arange(len(stops)), stops[:, axis]) for axis in range(3)], axis=1)
    colors: Colors = np.rint(table).astype(np.uint8)[np.rint(share * 255.0).astype(np.intp)]
    return colors


def css_ramp(*, around: bool = False) -> str:
    """The same colours as a background of a legend."""
    return f"linear-gradient(90deg, {', '.join(_AROUND if around else _RISING)})"


def srgb(linear: Sequence[float]) -> tuple[int, int, int]:
    """A job's colour, which is linear, for a screen (IEC 61966-2-1)."""
    values = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    encoded = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1.0 / 2.4) - 0.055)
    red, green, blue = (round(255.0 * value) for value in encoded.tolist())
    return red, green, blue


def _rgb(stops: Sequence[str]) -> NDArray[np.float64]:
    return np.array([[int(stop[start : start + 2], 16) for start in (1, 3, 5)] for stop in stops], np.float64)
