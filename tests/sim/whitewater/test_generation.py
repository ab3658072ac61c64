"""How many whitewater particles come to be, where, and how they differ."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from whitewater_scenes import RADIUS, fluid

from sim.whitewater.cloud import WhitewaterCloud
from sim.whitewater.generation import clamp_potential, generate, generation_rate
from sim.whitewater.parameters import WhitewaterParameters

PARAMETERS = WhitewaterParameters()
DT = 0.01
VELOCITY = np.array([1.0, -2.0, 0.5])


def generated(rate: float, *, count: int = 20_000, room: int = 10**7, parameters=PARAMETERS, substep: int = 1):
    state = fluid(np.zeros((count, 3), np.float32), tuple(VELOCITY))
    return generate(
        state,
        np.full(count, rate),
        DT,
        particle_radius=RADIUS,
        room=room,
        moment=(3, substep),
        parameters=parameters,
    )


def test_a_potential_rises_from_nothing_to_one_between_its_limits():
    np.testing.assert_allclose(clamp_potential(np.array([-1.0, 2.0, 3.0, 5.0, 9.0]), 2.0, 5.0), [0, 0, 1 / 3, 1, 1])


def test_slow_fluid_makes_nothing_and_fast_fluid_both_kinds():
    velocity = np.array([[0.5, 0, 0], [3.0, 0, 0], [9.0, 0, 0], [9.0, 0, 0]])
    rate = generation_rate(velocity, np.array([9.0, 9.0, 9.0, 0.0]), np.array([9.0, 0.0, 9.0, 0.0]), PARAMETERS)
    both = PARAMETERS.trapped_air_rate + PARAMETERS.wave_crest_rate
    np.testing.assert_allclose(rate, [0.0, PARAMETERS.trapped_air_rate, both, 0.0])


@pytest.mark.parametrize("mean", [0.03, 0.5, 1.0, 2.7])
def test_the_number_is_right_on_average(mean):
    born, missed = generated(mean / DT)
    fraction = mean % 1
    # Rounding up has the probability of the fraction: four standard deviations of the sum over 20,000 particles.
    assert len(born) == pytest.approx(20_000 * mean, abs=4 * np.sqrt(20_000 * fraction * (1 - fraction)) + 1e-6)
    assert missed == 0


def test_they_fill_the_cylinder_that_the_particle_sweeps():
    born, _ = generated(2.0 / DT)
    speed = np.linalg.norm(VELOCITY)
    along = born.position @ (VELOCITY / speed)
    across = np.linalg.norm(born.position - np.outer(along, VELOCITY / speed), axis=1)
    # Positions are single precision, of a few centimetres.
    assert along.min() >= -1e-8
    assert along.max() <= speed * DT + 1e-8
    assert across.max() <= RADIUS + 1e-8
    # Evenly by volume: means of 40,000 places are good to a standard deviation / 200, and four of these.
    assert along.mean() == pytest.approx(0.5 * speed * DT, abs=4 * speed * DT / np.sqrt(12) / 200)
    assert (across**2).mean() == pytest.approx(0.5 * RADIUS**2, abs=4 * RADIUS**2 / np.sqrt(12) / 200)
    assert np.abs(born.position.mean(axis=0) - 0.5 * DT * VELOCITY).max() < 4 * RADIUS / 200


def test_sizes_and_lifetimes_keep_their_limits():
    born, _ = generated(2.0 / DT)
    assert PARAMETERS.radius_min_in_radii * RADIUS <= born.radius.min() * (1 + 1e-6)
    assert born.radius.max() <= PARAMETERS.radius_max_in_radii * RADIUS * (1 + 1e-6)
    assert PARAMETERS.lifetime_min <= born.lifetime.min()
    assert born.lifetime.max() <= PARAMETERS.lifetime_max
    assert born.lifetime.std() > 0.2 * (PARAMETERS.lifetime_max - PARAMETERS.lifetime_min)


def test_without_spread_they_have_the_fluids_velocity():
    born, _ = generated(1.0 / DT, parameters=WhitewaterParameters(spread=0.0))
    np.testing.assert_allclose(born.velocity, np.broadcast_to(VELOCITY, born.velocity.shape), rtol=1e-6)


def test_without_room_they_are_thinned_evenly():
    state = fluid(np.outer(np.arange(1000), [1.0, 0, 0]), tuple(VELOCITY))
    born, missed = generate(
        state, np.full(1000, 4.0 / DT), DT, particle_radius=RADIUS, room=500, moment=(1, 0), parameters=PARAMETERS
    )
    assert (len(born), missed) == (500, 3500)
    assert np.histogram(born.position[:, 0], bins=10, range=(-0.5, 999.5))[0].min() >= 45


def test_every_substep_throws_other_dice():
    first, second = (generated(1.5 / DT, substep=substep)[0] for substep in (0, 1))
    assert not np.array_equal(first.position[:100], second.position[:100])


def test_nothing_comes_of_nothing():
    born, missed = generated(0.0)
    assert (len(born), missed) == (0, 0)
    assert len(WhitewaterCloud.empty().joined(born)) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"min_speed": 4.0}, "max_speed must be above min_speed = 4 m/s, got 3 m/s"),
        ({"max_wave_crest": 0.01}, "max_wave_crest must be above min_wave_crest = 0.04, got 0.01"),
        ({"lifetime_min": 9.0}, "lifetime_max must not be below lifetime_min = 9, got 2.5"),
        ({"bubble_neighbors": 3}, "bubble_neighbors must not be below spray_neighbors = 6, got 3"),
    ],
)
def test_ranges_that_are_upside_down_are_refused(change, said):
    with pytest.raises(ValidationError, match=said):
        WhitewaterParameters(**change)
