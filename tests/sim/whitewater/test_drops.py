"""Drops of spray: their volume, sizes and places, and that they move as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from sim.whitewater.drops import (
    LARGEST_REACH_IN_RADII,
    Drops,
    atomizes,
    drops_of,
    in_the_air,
    spread,
)
from sim.whitewater.kinds import GAMMA_ORDER, LiquidKind, drops_of_particle, mean_diameter
from sim.whitewater.liquid import LiquidState
from sim.whitewater.motion import FluidState

RADIUS = 0.005
DT = 1.0 / 60.0
COUNT = 24


def spray(count: int, speed: float = 3.0, first: int = 0) -> tuple[LiquidState, FluidState]:
    """As many particles far from each other, in flight, the last of them no spray."""
    random = np.random.default_rng(first)
    ids = np.arange(first, first + count, dtype=np.int32)
    velocity = random.normal(size=(count, 3))
    velocity *= speed / np.linalg.norm(velocity, axis=1, keepdims=True)
    kind = np.full(count, LiquidKind.SPRAY, np.uint8)
    kind[-1] = LiquidKind.BULK
    state = LiquidState(ids, kind, np.full(count, 9, np.uint8), np.zeros(count, np.float32))
    fluid = FluidState(ids, random.uniform(0, 1, (count, 3)).astype(np.float32), velocity.astype(np.float32))
    return spread(state, fluid, particle_radius=RADIUS, dt=DT), fluid


def test_drops_have_the_volume_of_their_particle_and_their_middle_is_it():
    state, fluid = spray(50)
    drops = drops_of(state, fluid, particle_radius=RADIUS, count=COUNT)
    assert drops.radius.shape == (49 * COUNT,)
    volumes = 4.0 / 3.0 * math.pi * drops.radius.reshape(-1, COUNT) ** 3
    np.testing.assert_allclose(volumes.sum(axis=1), (2.0 * RADIUS) ** 3, rtol=1e-12)
    assert drops.volume == pytest.approx(49 * (2.0 * RADIUS) ** 3, rel=1e-12)
    middles = (volumes[..., None] * drops.position.reshape(-1, COUNT, 3)).sum(axis=1) / (2.0 * RADIUS) ** 3
    np.testing.assert_allclose(middles, fluid.position[:-1], atol=1e-9)
    momentum = (volumes[..., None] * drops.velocity.reshape(-1, COUNT, 3)).sum(axis=1) / (2.0 * RADIUS) ** 3
    np.testing.assert_allclose(momentum, fluid.velocity[:-1], atol=1e-9)


def test_diameters_follow_the_gamma_distribution():
    """Villermaux 2007. Scaled to a particle's volume, so by the ratio of moments: d30/d10 and the shape itself."""
    state, fluid = spray(400)
    radii = drops_of(state, fluid, particle_radius=RADIUS, count=200).radius.reshape(-1, 200)
    shares = (radii / radii.mean(axis=1, keepdims=True)).ravel()
    distance = stats.kstest(shares, stats.gamma(GAMMA_ORDER, scale=1.0 / GAMMA_ORDER).cdf).statistic
    assert distance < 0.02  # of 80,000; an order of 3 is 0.05 away
    assert stats.kstest(shares, stats.gamma(3.0, scale=1.0 / 3.0).cdf).statistic > 0.04


def test_the_number_of_drops_gives_the_mean_diameter():
    """A Gamma distribution of order 4 has <d³> = 1.875 <d>³."""
    for diameter in (1e-3, 2.7e-3, 4e-3):
        count = drops_of_particle(particle_radius=RADIUS, diameter=diameter, most=100_000)
        mean_volume = math.pi / 6.0 * 1.875 * diameter**3
        assert count == pytest.approx((2.0 * RADIUS) ** 3 / mean_volume, abs=0.5)
        assert mean_diameter(particle_radius=RADIUS, count=count) == pytest.approx(diameter, rel=0.2 / count)
    assert drops_of_particle(particle_radius=RADIUS, diameter=1e-3, most=24) == 24
    assert drops_of_particle(particle_radius=1e-4, diameter=2.7e-3, most=24) == 1


def test_a_drop_does_not_depend_on_other_particles():
    state, fluid = spray(20)
    whole = drops_of(state, fluid, particle_radius=RADIUS, count=COUNT)
    rows = np.array([3, 11])
    part = drops_of(
        LiquidState(state.particle_id[rows], state.kind[rows], state.held[rows], state.reach[rows]),
        FluidState(fluid.particle_id[rows], fluid.position[rows], fluid.velocity[rows]),
        particle_radius=RADIUS,
        count=COUNT,
    )
    chosen = (rows[:, None] * COUNT + np.arange(COUNT)).ravel()
    np.testing.assert_array_equal(part.position, whole.position[chosen])
    np.testing.assert_array_equal(part.radius, whole.radius[chosen])


def test_drops_are_a_frame_later_where_their_velocity_led():
    """In steady flight, so that blur and motion agree."""
    state, fluid = spray(30)
    now = drops_of(state, fluid, particle_radius=RADIUS, count=COUNT)
    later_fluid = FluidState(fluid.particle_id, fluid.position + np.float32(DT) * fluid.velocity, fluid.velocity)
    later = drops_of(
        spread(state, later_fluid, particle_radius=RADIUS, dt=DT), later_fluid, particle_radius=RADIUS, count=COUNT
    )
    np.testing.assert_allclose(later.position, now.position + DT * now.velocity, atol=2e-6)
    assert np.linalg.norm(later.position - now.position, axis=1).min() > 0.02


def test_drops_spread_from_within_the_particle_up_to_a_limit():
    state, fluid = spray(30)
    for _ in range(60):
        before, state = state, spread(state, fluid, particle_radius=RADIUS, dt=DT)
        assert (state.reach >= before.reach).all()
    np.testing.assert_allclose(state.reach[:-1], LARGEST_REACH_IN_RADII * RADIUS, rtol=1e-6)
    assert state.reach[-1] == 0.0
    drops = drops_of(state, fluid, particle_radius=RADIUS, count=COUNT)
    np.testing.assert_array_equal(drops.velocity, fluid.velocity[:-1].repeat(COUNT, axis=0))


def test_honey_and_fine_drops_do_not_break_up_and_water_does():
    assert atomizes(viscosity=1e-6, rest_density=1000.0, particle_radius=RADIUS)
    assert not atomizes(viscosity=5e-3, rest_density=1400.0, particle_radius=RADIUS)
    assert not atomizes(viscosity=1e-6, rest_density=1000.0, particle_radius=1e-7)


def test_drops_in_the_liquid_are_left_out():
    position = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9 * RADIUS], [0.0, 0.0, 1.1 * RADIUS]])
    drops = Drops(position, np.zeros_like(position), np.full(3, 1e-4))
    left = in_the_air(drops, np.zeros((1, 3), np.float32), particle_radius=RADIUS)
    np.testing.assert_array_equal(left.position, position[2:])
