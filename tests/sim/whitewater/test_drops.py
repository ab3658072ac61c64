"""Drops of spray: their volume, sizes, number and places, and that they move as they say."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from sim.whitewater.drops import (
    FIRST_PIECES,
    FIRST_REACH_IN_RADII,
    LARGEST_REACH_IN_RADII,
    LEAST_REACH_IN_RADII,
    REACH_IN_GAPS,
    Drops,
    Reach,
    atomizes,
    drops_of,
    grown_reach,
    in_the_air,
)
from sim.whitewater.kinds import (
    GAMMA_ORDER,
    LIGAMENT_ORDER,
    LiquidKind,
    drops_of_mean,
    drops_of_particle,
    mean_diameter,
)
from sim.whitewater.liquid import LiquidState
from sim.whitewater.motion import FluidState

RADIUS = 0.005
DT = 1.0 / 60.0
MOST = 16
PARTICLE = (2.0 * RADIUS) ** 3


def spray(
    count: int, speed: float = 3.0, width: float = 2.0, spread_over: float = 1.0
) -> tuple[LiquidState, FluidState]:
    """As many particles far from each other, in flight, their drops some radii apart; the last of them no spray."""
    random = np.random.default_rng(0)
    ids = np.arange(count, dtype=np.int32)
    velocity = random.normal(size=(count, 3))
    velocity *= speed / np.linalg.norm(velocity, axis=1, keepdims=True)
    kind = np.full(count, LiquidKind.SPRAY, np.uint8)
    kind[-1] = LiquidKind.BULK
    reach = np.full(count, width * RADIUS, np.float32)
    reach[-1] = 0.0
    fluid = FluidState(ids, random.uniform(0, spread_over, (count, 3)).astype(np.float32), velocity.astype(np.float32))
    return LiquidState(ids, kind, np.full(count, 9, np.uint8), reach), fluid


def reach_of(state: LiquidState) -> Reach:
    """Drops that stay as far apart as they are."""
    return Reach(state.reach, np.zeros(len(state.kind)))


def made(state: LiquidState, fluid: FluidState, reach: Reach | None = None, most: int = MOST, diameter=1e-3) -> Drops:
    reach = reach_of(state) if reach is None else reach
    return drops_of(state, fluid, reach, particle_radius=RADIUS, diameter=diameter, most=most)


def owners(state: LiquidState, fluid: FluidState, **options) -> list[Drops]:
    """The drops of each particle, drawn alone."""
    alone = [
        (
            LiquidState(*(getattr(state, name)[[row]] for name in ("particle_id", "kind", "held", "reach"))),
            FluidState(*(getattr(fluid, name)[[row]] for name in ("particle_id", "position", "velocity"))),
        )
        for row in range(len(state.kind))
    ]
    return [made(*each, **options) for each in alone]


def volumes(drops: Drops) -> np.ndarray:
    return 4.0 / 3.0 * math.pi * drops.radius**3


@pytest.mark.parametrize("width", [FIRST_REACH_IN_RADII, 2.5, LEAST_REACH_IN_RADII, 12.0])
def test_drops_have_the_volume_of_their_particle_and_their_middle_is_it(width):
    state, fluid = spray(50, width=width)
    growing = Reach(state.reach, np.full(50, 0.4))
    assert made(state, fluid).volume == pytest.approx(49 * PARTICLE, rel=1e-12)
    for row, drops in enumerate(owners(state, fluid)[:-1]):
        shares = volumes(drops)[:, None] / PARTICLE
        assert shares.sum() == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_allclose((shares * drops.position).sum(axis=0), fluid.position[row], atol=1e-9)
    moving = made(state, fluid, growing)
    momentum = (volumes(moving)[:, None] * moving.velocity).sum(axis=0) / PARTICLE
    np.testing.assert_allclose(momentum, fluid.velocity[:-1].sum(axis=0, dtype=np.float64), atol=1e-5)


def test_diameters_of_a_ligament_follow_a_gamma_distribution():
    """Villermaux 2007. Scaled to a particle's volume, so by the ratio to their mean."""
    state, fluid = spray(400, width=16.0)
    each = [drops.radius for drops in owners(state, fluid, most=400)[:-1]]
    shares = np.concatenate([radii / radii.mean() for radii in each if len(radii) > 150])
    assert len(shares) > 50_000
    distance = stats.kstest(shares, stats.gamma(GAMMA_ORDER, scale=1.0 / GAMMA_ORDER).cdf).statistic
    assert distance < 0.02  # an order of 3 is 0.05 away
    assert stats.kstest(shares, stats.gamma(3.0, scale=1.0 / 3.0).cdf).statistic > 0.04


def test_ligaments_differ_in_width_by_a_gamma_distribution():
    """Kooij et al. 2018. Drops as wide as their ligament, so their number gives its width."""
    state, fluid = spray(3000, width=16.0)
    diameter, most = 2.2e-3, 100_000
    of_mean = drops_of_mean(particle_radius=RADIUS, diameter=diameter, most=most)
    assert of_mean > 90
    drops = made(state, fluid, most=2000, diameter=diameter)
    assert len(drops.radius) / 2999 == pytest.approx(
        drops_of_particle(particle_radius=RADIUS, diameter=diameter, most=2000), rel=0.05
    )
    counts = np.array([len(each.radius) for each in owners(state, fluid, most=2000, diameter=diameter)[:-1]])
    widths = np.cbrt(of_mean / counts[counts < 2000])
    law = stats.gamma(LIGAMENT_ORDER, scale=1.0 / LIGAMENT_ORDER)
    thinnest = np.cbrt(of_mean / 2000)
    assert np.mean(counts == 2000) == pytest.approx(law.cdf(thinnest), abs=0.02)
    distance = stats.kstest(widths, lambda x: (law.cdf(x) - law.cdf(thinnest)) / law.sf(thinnest)).statistic
    assert distance < 0.03
    assert stats.kstest(widths, stats.gamma(2.0, scale=0.5).cdf).statistic > 0.06


def test_the_number_of_drops_gives_the_mean_diameter():
    """A Gamma distribution of order 4 has <d³> = 1.875 <d>³."""
    for diameter in (1e-3, 2.7e-3, 4e-3):
        count = drops_of_mean(particle_radius=RADIUS, diameter=diameter, most=100_000)
        assert count == pytest.approx(PARTICLE / (math.pi / 6.0 * 1.875 * diameter**3))
        assert mean_diameter(particle_radius=RADIUS, diameter=diameter, most=100_000) == pytest.approx(diameter)
    assert drops_of_mean(particle_radius=RADIUS, diameter=1e-3, most=24) == 12
    assert mean_diameter(particle_radius=RADIUS, diameter=1e-3, most=24) == pytest.approx(
        2.0 * RADIUS * (6.0 / math.pi / 1.875 / 12.0) ** (1.0 / 3.0)
    )
    assert drops_of_particle(particle_radius=1e-4, diameter=2.7e-3, most=24) == pytest.approx(1.0, abs=1e-3)
    assert drops_of_particle(particle_radius=RADIUS, diameter=2.7e-3, most=0) == 0.0
    drops = made(*spray(2000, width=16.0), most=24)
    expected = drops_of_particle(particle_radius=RADIUS, diameter=1e-3, most=24)
    assert len(drops.radius) / 1999 == pytest.approx(expected, rel=0.03)
    assert 12 < expected < 24


def test_a_particle_breaks_bit_by_bit_and_what_breaks_are_whole_drops():
    state, fluid = spray(60)
    widths = np.linspace(FIRST_REACH_IN_RADII, LEAST_REACH_IN_RADII, 12)
    of_widths = [
        owners(replace(state, reach=np.full(60, width * RADIUS, np.float32)), fluid, most=40)[:-1] for width in widths
    ]
    assert max(len(drops.radius) for drops in of_widths[0]) == FIRST_PIECES
    assert max(len(drops.radius) for drops in of_widths[-1]) == 40
    whole = 0
    for before, after in pairwise(of_widths):
        for coarse, fine in zip(before, after, strict=True):
            assert len(coarse.radius) <= len(fine.radius) <= max(2 * len(coarse.radius), 40)
            edges = np.cumsum(volumes(fine))
            if max(volumes(coarse).max(), volumes(fine).max()) < 0.479 * PARTICLE:  # which is the most of a drop
                whole += 1
                assert all(np.abs(edges - edge).min() < 1e-9 * PARTICLE for edge in np.cumsum(volumes(coarse)))
    assert whole > 100


@pytest.mark.parametrize("width", [FIRST_REACH_IN_RADII, LARGEST_REACH_IN_RADII])
def test_no_drop_is_a_ball_of_a_particle_s_size(width):
    state, fluid = spray(5000, width=width)
    radii = made(state, fluid).radius
    assert radii.max() < RADIUS
    assert radii.max() > 0.9 * RADIUS
    assert len(np.unique(radii.astype(np.float32))) > 0.99 * len(radii), "a radius is what tells drops apart"
    large = made(state, fluid, diameter=2.5 * RADIUS)  # where drops are larger than particles each is one
    assert np.mean(large.radius > RADIUS) > 0.2


def test_a_drop_does_not_depend_on_other_particles():
    state, fluid = spray(20)
    whole = made(state, fluid)
    each = owners(state, fluid)
    np.testing.assert_array_equal(whole.radius, np.concatenate([drops.radius for drops in each]))
    np.testing.assert_array_equal(whole.position, np.concatenate([drops.position for drops in each]))


def test_drops_are_a_frame_later_where_their_velocity_led():
    """In steady flight, so that blur and motion agree."""
    state, fluid = spray(30, width=6.0)
    reaches = [grown_reach(state, fluid, particle_radius=RADIUS, dt=DT)]
    now = made(state, fluid, reaches[0])
    later_fluid = FluidState(fluid.particle_id, fluid.position + np.float32(DT) * fluid.velocity, fluid.velocity)
    later_state = replace(state, reach=reaches[0].width)
    later = made(later_state, later_fluid, grown_reach(later_state, later_fluid, particle_radius=RADIUS, dt=DT))
    np.testing.assert_allclose(later.position, now.position + DT * now.velocity, atol=2e-6)
    assert np.linalg.norm(later.position - now.position, axis=1).min() > 0.02


def flown(state: LiquidState, fluid: FluidState, frames: int) -> LiquidState:
    """The state after some frames in which particles stay where they are to each other."""
    for _ in range(frames):
        reach = grown_reach(state, fluid, particle_radius=RADIUS, dt=DT)
        spray = state.kind == LiquidKind.SPRAY
        assert (reach.width >= state.reach).all() and (reach.width[~spray] == 0.0).all()
        state = replace(state, reach=reach.width)
    return state


@pytest.mark.parametrize(
    ("gap", "expected"),
    [(2.0, LEAST_REACH_IN_RADII), (8.0, 8.0 * REACH_IN_GAPS), (60.0, LARGEST_REACH_IN_RADII)],
)
def test_drops_spread_as_far_as_the_next_particles_of_spray(gap, expected):
    """On a lattice, whose particles have six neighbours at a gap, three in its corners: the fourth is a diagonal."""
    state, fluid = spray(65)
    axes = np.meshgrid(*[np.arange(4.0)] * 3, indexing="ij")
    places = np.stack(axes, axis=-1).reshape(-1, 3) * gap * RADIUS
    fluid = replace(fluid, position=np.concatenate([places, [[9, 9, 9]]]).astype(np.float32))
    state = flown(replace(state, reach=np.zeros(65, np.float32)), fluid, 60)
    inner = ((places > 0.0) & (places < 2.9 * gap * RADIUS)).all(axis=1)
    np.testing.assert_allclose(state.reach[:-1][inner], expected * RADIUS, rtol=1e-5)
    assert state.reach[-1] == 0.0


def test_a_lone_particle_has_drops_and_nothing_else_needs_any():
    state, fluid = spray(2)
    reach = grown_reach(state, fluid, particle_radius=RADIUS, dt=DT)
    assert reach.width[0] > state.reach[0] and np.isfinite(reach.width).all()
    assert len(made(state, fluid, reach).radius) > 1
    none = replace(state, kind=np.zeros(2, np.uint8))
    assert len(made(none, fluid, grown_reach(none, fluid, particle_radius=RADIUS, dt=DT)).radius) == 0


def test_clouds_of_drops_become_one():
    """Numbers in boxes: of drops that are anywhere the variance is the mean."""
    gap, cells = 12.0 * RADIUS, 8
    axes = np.meshgrid(*[np.arange(cells) + 0.5] * 3, indexing="ij")
    places = np.stack(axes, axis=-1).reshape(-1, 3) * gap
    state, fluid = spray(len(places) + 1, speed=1.0, width=LEAST_REACH_IN_RADII)
    fluid = replace(fluid, position=np.concatenate([places, [[9, 9, 9]]]).astype(np.float32))
    edges = [np.arange(2.25 * gap, (cells - 2) * gap, gap / 2)] * 3
    unevenness = []
    for each in (state, flown(state, fluid, 60)):
        numbers, _ = np.histogramdd(made(each, fluid, most=24).position, edges)
        unevenness.append(numbers.var() / numbers.mean())
    assert unevenness[0] > 2.5
    assert unevenness[1] < 1.5


def test_honey_and_fine_drops_do_not_break_up_and_water_does():
    assert atomizes(viscosity=1e-6, rest_density=1000.0, particle_radius=RADIUS)
    assert not atomizes(viscosity=5e-3, rest_density=1400.0, particle_radius=RADIUS)
    assert not atomizes(viscosity=1e-6, rest_density=1000.0, particle_radius=1e-7)


def test_drops_in_the_liquid_are_left_out():
    position = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.9 * RADIUS], [0.0, 0.0, 1.1 * RADIUS]])
    drops = Drops(position, np.zeros_like(position), np.full(3, 1e-4), np.arange(3, dtype=np.int32))
    left = in_the_air(drops, np.zeros((1, 3), np.float32), particle_radius=RADIUS)
    np.testing.assert_array_equal(left.position, position[2:])
