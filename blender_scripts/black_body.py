"""Colour and brightness of a black body, by its temperature."""

from __future__ import annotations

import numpy as np

LUMINANCE_EXPONENT_K = 24_000.0
"""Luminance grows with temperature as exp(-24000 K / T): Wien's law at 600 nm, where eyes see most of a flame's light,
from 900 to 2000 K within 10 % of Planck's law weighted by the CIE's luminous efficiency."""

_LINEAR_REC709_OF_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def relative_luminance(temperature: np.ndarray, reference: float) -> np.ndarray:
    """Luminance of black bodies of any temperatures [K] over that of one at the reference temperature [K]."""
    return np.exp(LUMINANCE_EXPONENT_K * (1.0 / reference - 1.0 / temperature))


def black_body_color(temperature: np.ndarray) -> np.ndarray:
    """Linear Rec. 709 colours (n, 3) of black bodies (n,) [K] at luminance 1, by Krystek's fit (1985).

    What is below 1000 K looks as at 1000 K, where the fit ends. Negative channels of reds beyond the gamut are zero.
    """
    kelvin = np.maximum(temperature, 1000.0)
    u = (0.860117757 + 1.54118254e-4 * kelvin + 1.28641212e-7 * kelvin**2) / (
        1.0 + 8.42420235e-4 * kelvin + 7.08145163e-7 * kelvin**2
    )
    v = (0.317398726 + 4.22806245e-5 * kelvin + 4.20481691e-8 * kelvin**2) / (
        1.0 - 2.89741816e-5 * kelvin + 1.61456053e-7 * kelvin**2
    )
    x, y = 3.0 * u / (2.0 * u - 8.0 * v + 4.0), 2.0 * v / (2.0 * u - 8.0 * v + 4.0)
    xyz = np.stack([x / y, np.ones_like(x), (1.0 - x - y) / y], axis=-1)
    return np.maximum(xyz @ _LINEAR_REC709_OF_XYZ.T, 0.0)
