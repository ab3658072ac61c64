"""Colours and brightness of what glows, against tables and Planck's law."""

from __future__ import annotations

import numpy as np
import pytest

from blender_scripts.black_body import black_body_color, relative_luminance

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
XYZ_OF_LINEAR_REC709 = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


@pytest.mark.parametrize(
    ("kelvin", "x", "y"), [(2000.0, 0.5267, 0.4133), (2500.0, 0.4770, 0.4137), (3000.0, 0.4369, 0.4041)]
)
def test_chromaticities_are_those_of_the_planckian_locus(kelvin, x, y):
    # Wyszecki & Stiles, Color Science, table of the Planckian radiator; to the last digit but one.
    xyz = XYZ_OF_LINEAR_REC709 @ black_body_color(np.array([kelvin]))[0]
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), (x, y), atol=5e-4)


def test_colours_have_one_luminance():
    # Blue is out of gamut below 1900 K, where it would take 0.5 % off.
    np.testing.assert_allclose(black_body_color(np.arange(900.0, 4000.0, 100.0)) @ LUMINANCE, 1.0, atol=0.01)


@pytest.mark.parametrize("kelvin", [900.0, 1100.0, 1300.0, 1700.0, 2000.0])
def test_luminance_grows_as_plancks_law_seen_by_an_eye(kelvin):
    metres = 1e-9 * np.arange(380.0, 781.0)
    # Luminous efficiency of the CIE's observer, by its usual Gaussian fit in micrometres.
    efficiency = 1.019 * np.exp(-285.4 * (1e6 * metres - 0.559) ** 2)

    def luminance(temperature: float) -> float:
        return float((efficiency * metres**-5 / np.expm1(1.438777e-2 / (metres * temperature))).sum())

    ratio = luminance(kelvin) / luminance(1500.0)
    assert relative_luminance(np.array([kelvin]), 1500.0)[0] == pytest.approx(ratio, rel=0.1)
