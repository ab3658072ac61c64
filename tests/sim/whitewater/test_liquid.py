"""Kinds of liquid: what stands in a block, a film, a thread and alone, and that it stays what it is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sim.core.domain import DomainParameters
from sim.whitewater.kinds import LiquidKind
from sim.whitewater.liquid import CROWDED, KEPT_FRAMES, LiquidState, hangs_together, lie_on, next_liquid
from sim.whitewater.motion import FluidState
from sim.whitewater.obstacles import Obstacles

pytestmark = pytest.mark.usefixtures("taichi_cpu")

RADIUS = 0.005
D = 2.0 * RADIUS
DT = 1.0 / 60.0


def lattice(*counts: int) -> np.ndarray:
    axes = [np.arange(count) for count in counts]
    return (D * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)).astype(np.float32)


def fluid(position: np.ndarray, velocity=(0.0, 0.0, 0.0)) -> FluidState:
    moving = np.broadcast_to(np.asarray(velocity, np.float32), position.shape).copy()
    return FluidState(np.arange(len(position), dtype=np.int32), position.astype(np.float32), moving)


def kinds(
    state: FluidState, before: LiquidState | None = None, *, atomizes: bool = True, lies: bool = False
) -> LiquidState:
    return next_liquid(
        before or LiquidState.empty(),
        state,
        state.particle_id,
        particle_radius=RADIUS,
        frame_dt=DT,
        atomizes=atomizes,
        lies=np.full(len(state.particle_id), lies),
    )


@pytest.mark.parametrize(
    ("counts", "kind"),
    [((8, 8, 8), LiquidKind.BULK), ((20, 20, 1), LiquidKind.SHEET), ((40, 1, 1), LiquidKind.SHEET)],
    ids=["block", "film", "thread"],
)
def test_what_lies_in_a_lattice(counts, kind):
    position = lattice(*counts)
    extent = np.ptp(position, axis=0)
    inner = (np.abs(position - position.mean(axis=0)) <= np.maximum(0.5 * extent - 1.5 * D, 0.1 * D)).all(axis=1)
    assert inner.sum() > 10
    assert (kinds(fluid(position)).kind[inner] == kind).all()


def test_a_film_is_a_sheet_however_it_is_turned():
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    position = lattice(20, 20, 1) @ turn
    assert (kinds(fluid(position)).kind == LiquidKind.SHEET).mean() > 0.95


def test_small_pieces_are_spray_and_large_ones_are_not():
    thread = 1.1 * lattice(30, 1, 1)
    pieces = [lattice(1, 1, 1), 1.0 + lattice(2, 2, 2), 2.0 + lattice(5, 5, 5), 3.0 + thread]
    state = kinds(fluid(np.concatenate(pieces)))
    of_piece = np.split(state.kind == LiquidKind.SPRAY, np.cumsum([len(piece) for piece in pieces])[:-1])
    assert [bool(each.all()) for each in of_piece] == [True, True, False, False]
    assert not of_piece[2].any()
    assert of_piece[3].sum() == 2, "the ends of the thread fray"


def test_what_hangs_together_by_itself_is_what_is_no_spray_in_the_first_frame():
    pieces = [lattice(1, 1, 1), 1.0 + lattice(2, 2, 2), 2.0 + lattice(5, 5, 5), 3.0 + 1.1 * lattice(30, 1, 1)]
    tank = fluid(np.concatenate(pieces))
    whole = hangs_together(tank, particle_radius=RADIUS)
    np.testing.assert_array_equal(whole, kinds(tank).kind != LiquidKind.SPRAY)
    assert 100 < whole.sum() < len(whole)


def test_nothing_of_a_stiff_liquid_is_spray():
    state = kinds(fluid(np.concatenate([lattice(1, 1, 1), lattice(5, 5, 5) + 1])), atomizes=False)
    assert not (state.kind == LiquidKind.SPRAY).any()


def test_a_lone_particle_that_falls_into_the_pool_within_the_frames_of_a_kind_is_no_spray():
    pool = lattice(10, 10, 4)
    drop = np.array([[4.5 * D, 4.5 * D, 6.5 * D]])
    still = fluid(np.concatenate([pool, drop]))
    falling = replace(still, velocity=still.velocity.copy())
    falling.velocity[-1, 2] = -4.5 * D / (KEPT_FRAMES * DT)
    assert kinds(still).kind[-1] == LiquidKind.SPRAY
    assert kinds(falling).kind[-1] != LiquidKind.SPRAY


def test_spray_that_has_fallen_into_the_crowd_is_spray_no_more():
    pool = lattice(10, 10, 10)
    apart, within = pool.copy(), pool.copy()
    apart[555] = [0.0, 0.0, 1.0]
    before = kinds(fluid(apart))
    assert before.kind[555] == LiquidKind.SPRAY
    after = kinds(fluid(within), before)
    assert after.kind[555] == LiquidKind.BULK
    assert after.reach[555] == 0.0


def test_a_piece_whose_size_wavers_does_not_flicker():
    """Of 8 to 20 particles in turn: spray once, and spray for good."""
    large, small = lattice(5, 2, 2), lattice(2, 2, 2)
    apart = np.concatenate([small, lattice(12, 1, 1)[:, ::-1] * 20 + 1.0])
    state, told = LiquidState.empty(), []
    for frame in range(12):
        state = kinds(fluid(apart if frame % 2 else large), state)
        told.append(state.kind[:8].copy())
    changes = [(before != after).any() for before, after in pairwise(told)]
    assert sum(changes) <= 1


def test_no_kind_is_left_and_taken_up_again_within_three_frames():
    """A random cloud that is dense and thin in turn, the worst case: all but what falls into the crowd keep to it."""
    random = np.random.default_rng(0)
    base = random.uniform(0, 14 * D, (1200, 3)).astype(np.float32)
    state, told = LiquidState.empty(), []
    for frame in range(12):
        jittered = base + random.normal(0, 0.3 * D, base.shape).astype(np.float32)
        state = kinds(fluid(jittered * (1.0 if frame % 3 else 0.9)), state)
        told.append(state.kind)
    told = np.stack(told)
    returns = 0
    for first in range(1, len(told)):
        left = told[first] != told[first - 1]
        not_spray = left & (told[first - 1] != LiquidKind.SPRAY) & (told[first] != LiquidKind.SPRAY)
        for later in range(first + 1, min(first + KEPT_FRAMES, len(told))):
            returns += int((not_spray & (told[later] == told[first - 1])).sum())
    assert (told[1:] != told[:-1]).any()
    assert returns == 0


def test_new_particles_and_lost_ones():
    film = lattice(12, 12, 1)
    before = kinds(fluid(film))
    kept = np.flatnonzero(np.arange(len(film)) % 7 != 0)
    later = FluidState(
        np.append(kept, 1000).astype(np.int32),
        np.concatenate([film[kept], [[1.0, 1.0, 1.0]]]).astype(np.float32),
        np.zeros((len(kept) + 1, 3), np.float32),
    )
    after = kinds(later, before)
    assert (after.particle_id == later.particle_id).all()
    assert after.kind[-1] == LiquidKind.SPRAY
    assert after.held[-1] == 255
    assert len(kinds(fluid(np.zeros((0, 3)))).kind) == 0


def test_the_threshold_of_the_crowd_lies_between_a_film_and_a_face():
    """Neighbours within two spacings, of a lattice: 12 in a film, 20 on a flat face (with those at two spacings)."""
    offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    near = offsets[(np.linalg.norm(offsets, axis=1) <= 2.0) & offsets.any(axis=1)]
    assert (near[:, 2] == 0).sum() < CROWDED <= (near[:, 2] <= 0).sum()


def test_a_puddle_that_a_floor_holds_is_no_spray_and_one_that_flies_is():
    puddle = fluid(lattice(3, 3, 1))
    assert (kinds(puddle).kind == LiquidKind.SPRAY).all()
    landed = kinds(puddle, kinds(puddle), lies=True)
    assert (landed.kind == LiquidKind.SHEET).all()


def test_fluid_lies_on_floors_and_bodies_where_it_is_near_and_slow():
    solids = Obstacles(DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0)), [], DT)
    heights, speeds = (0.5 * D, 0.5 * D, 1.5 * D, 0.3), (0.0, 2.0, 0.0, 0.0)
    state = FluidState(
        particle_id=np.arange(4, dtype=np.int32),
        position=np.array([(0.5, 0.5, z) for z in heights], np.float32),
        velocity=np.array([(v, 0.0, 0.0) for v in speeds], np.float32),
    )
    assert lie_on(solids, state, particle_radius=RADIUS, frame_dt=DT).tolist() == [True, False, False, False]


def test_one_fast_particle_costs_no_grid_as_long_as_its_way():
    """At one frame a second it would be 40 m away when its kind may change again."""
    position = np.concatenate([lattice(6, 6, 6), [[0.5, 0.5, 0.5]]])
    state = fluid(position)
    state.velocity[-1] = (1000.0, 0.0, 0.0)
    found = next_liquid(
        LiquidState.empty(),
        state,
        state.particle_id,
        particle_radius=RADIUS,
        frame_dt=1.0,
        atomizes=True,
        lies=np.zeros(len(position), bool),
    )
    assert found.kind[-1] == LiquidKind.SPRAY
    assert (found.kind[:-1] == LiquidKind.BULK).any()
