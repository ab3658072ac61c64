"""How dense looks are by themselves, and what that does to light."""

from __future__ import annotations

import math

import numpy as np
import pytest

from blender_scripts.look_table import LOOK_TABLE
from blender_scripts.optics import HONEY_TINT, INSIDES, REFRACTIVE_INDEX, per_metre, through_ball, usual_density

LIQUIDS = ("water", "honey", "wine", "oil", "coffee", "ink")


def transmitted(look: str, size: float, density: float, color=None) -> np.ndarray:
    """Part of red, green and blue light that gets across a body."""
    return np.exp(-size * np.array(per_metre(look, density, color)))


def test_every_look_that_has_a_density_has_one_by_itself():
    assert set(INSIDES) == {name for name, row in LOOK_TABLE.items() if "density" in row.keys}


@pytest.mark.parametrize("size", [0.03, 1.0, 40.0])
@pytest.mark.parametrize("look", LIQUIDS)
def test_a_colour_is_what_white_light_becomes_across_the_body_whatever_its_size(look, size):
    wine = (0.45, 0.03, 0.05)
    np.testing.assert_allclose(transmitted(look, size, usual_density(look, size, wine), wine), wine, rtol=1e-4)


@pytest.mark.parametrize("look", sorted(INSIDES))
def test_bodies_of_all_sizes_are_as_deep_as_each_other(look):
    depths = [size * np.array(per_metre(look, usual_density(look, size))) for size in (0.01, 0.3, 25.0)]
    np.testing.assert_allclose(depths, np.broadcast_to(depths[0], (3, 3)), rtol=1e-4)
    assert max(depths[0]) > 0.5  # it is seen


def test_a_glass_of_wine_is_red_where_it_is_deep_and_pink_at_its_rim():
    deep, rim = (np.exp(-path * np.array(per_metre("wine", 1.0))) for path in (0.05, 0.003))
    assert deep[0] > 0.2 and deep[1:].max() < 1e-5
    assert rim[0] > 0.9 and 0.3 < rim[1] < rim[2] < 0.45


def test_coffee_is_black_in_the_cup_and_brown_at_its_rim():
    deep, rim = (np.exp(-path * np.array(per_metre("coffee", 1.0))) for path in (0.05, 0.005))
    assert deep.max() < 1e-3
    assert rim[0] > 2.0 * rim[1] > 4.0 * rim[2]


def test_every_look_with_a_smooth_clear_surface_has_a_refractive_index():
    clear = {name for name, row in LOOK_TABLE.items() if row.refracts}
    liquids = {name for name in INSIDES if name in LOOK_TABLE and "fluid" in LOOK_TABLE[name].bodies}
    assert set(REFRACTIVE_INDEX) == clear | liquids


def test_densities_mean_what_they_meant():
    assert per_metre("water", 3.0) == pytest.approx((0.9, 0.165, 0.027))
    # Over a metre of water ten times exaggerated; a centimetre of honey; an extinction.
    np.testing.assert_allclose(transmitted("water", 1.0, 10.0, (0.5, 0.02, 0.3)), (0.5, 0.02, 0.3))
    np.testing.assert_allclose(transmitted("honey", 0.01, 1.0), HONEY_TINT)
    assert transmitted("smoke", 2.0, 0.5)[0] == pytest.approx(math.exp(-1.0))


@pytest.mark.parametrize(("look", "diameter"), [("water", 0.003), ("wine", 0.003), ("coffee", 0.02)])
def test_light_through_a_ball_is_the_mean_over_its_disc(look, diameter):
    share = (np.arange(20_000) + 0.5) / 20_000  # of the disc's area
    chord = diameter * np.sqrt(1.0 - share)
    expected = [np.exp(-each * chord).mean() for each in per_metre(look, 1.0)]
    np.testing.assert_allclose(through_ball(per_metre(look, 1.0), diameter), expected, rtol=1e-4)
