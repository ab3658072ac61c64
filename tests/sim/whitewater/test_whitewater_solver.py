"""How spray, foam and bubbles move, age and are bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from thread_counts import digest_of, result_on_any_threads
from whitewater_scenes import (
    ALL_FACES,
    BOX,
    FPS,
    GRAVITY,
    NO_FLUID,
    RADIUS,
    SPACING,
    cloud,
    fluid,
    jets,
    lattice,
    solver,
)

from sim.core.domain import DomainParameters
from sim.whitewater.cloud import WhitewaterCloud, WhitewaterKind
from sim.whitewater.fluid_field import FluidField
from sim.whitewater.generation import generation_rate
from sim.whitewater.motion import FluidMotion, FluidState
from sim.whitewater.parameters import WhitewaterParameters

DT = 1.0 / FPS
VACUUM = WhitewaterParameters(air_density=0.0)


def advance(cloud_now, begin, end, *, frame=1, using=None, **options):
    return (using or solver()).advance_frame(cloud_now, begin, end, frame=frame, particle_radius=RADIUS, **options)[0]


def made(begin, end, parameters: WhitewaterParameters | None = None, *, frame=1, domain=BOX, **options):
    """What two frames of fluid make of an empty cloud, and the report."""
    using = solver(parameters or WhitewaterParameters(), domain=domain)
    return using.advance_frame(WhitewaterCloud.empty(), begin, end, frame=frame, particle_radius=RADIUS, **options)


def test_spray_flies_on_a_parabola_in_a_vacuum(taichi_cpu):
    wide = DomainParameters(min=(-10.0, -10.0, -10.0), max=(10.0, 10.0, 10.0), open_faces=ALL_FACES)
    start, throw = np.array([0.1, -0.2, 0.3]), np.array([1.5, -0.5, 4.0])
    flying = cloud(start, throw)
    for frame in range(1, 31):
        flying = advance(flying, NO_FLUID, NO_FLUID, frame=frame, using=solver(VACUUM, domain=wide))
    time = 30 * DT
    assert flying.kind.tolist() == [WhitewaterKind.SPRAY]
    # Each of 30 frames rounds to float32, at most 1.2e-7 of some 2 m and, over the rest of the flight, of 4 m/s.
    np.testing.assert_allclose(flying.position[0], start + time * throw + 0.5 * time**2 * np.array(GRAVITY), atol=1e-5)
    np.testing.assert_allclose(flying.velocity[0], throw + time * np.array(GRAVITY), atol=2e-5)


@pytest.mark.parametrize(("diameter", "speed"), [(1e-3, 4.03), (2e-3, 6.49), (3e-3, 8.06)])
def test_drops_fall_as_fast_as_those_of_rain(taichi_cpu, diameter, speed):
    """Terminal speeds of water drops that Gunn & Kinzer 1949 measured; the coefficients are good to some 7 %."""
    deep = DomainParameters(min=(-1.0, -1.0, -100.0), max=(1.0, 1.0, 1.0), open_faces=ALL_FACES)
    falling = cloud((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    falling = replace(falling, radius=np.full(1, diameter / 2.0, np.float32))
    for frame in range(1, round(4 * FPS) + 1):
        falling = advance(falling, NO_FLUID, NO_FLUID, frame=frame, using=solver(domain=deep))
    assert -falling.velocity[0, 2] == pytest.approx(speed, rel=0.07)


def test_foam_turns_with_a_vortex(taichi_cpu):
    """Once around, on a disc of fluid that turns as a whole."""
    disc = lattice((-0.3, -0.3, 0.1), (0.3, 0.3, 0.2))
    disc = disc[np.hypot(disc[:, 0], disc[:, 1]) < 0.28].astype(np.float64)
    frames = 60
    omega = 2.0 * np.pi * FPS / frames

    def turned(points: np.ndarray, frame: int) -> np.ndarray:
        c, s = np.cos(omega * frame * DT), np.sin(omega * frame * DT)
        return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])

    def at(frame: int) -> FluidState:
        now = turned(disc, frame)
        return fluid(now, np.cross([0.0, 0.0, omega], now))

    start = np.array([[0.15, 0.0, 0.2], [0.0, 0.1, 0.2], [-0.12, -0.12, 0.2]])
    floating = cloud(start, np.cross([0.0, 0.0, omega], start), kind=WhitewaterKind.FOAM)
    using = solver(gravity=(0.0, 0.0, 0.0))
    for frame in range(1, frames + 1):
        floating = advance(floating, at(frame - 1), at(frame), frame=frame, using=using)
        assert (floating.kind == WhitewaterKind.FOAM).all()
    # The fluid's velocity at a point is a weighted mean over particles, whose centre of weight is off the point by a
    # small share of the spacing. Explicit Euler would end 2 to 3 spacings further out: by (1 + (omega dt)²)^30.
    np.testing.assert_allclose(floating.position, turned(start, frames), atol=0.5 * SPACING)


def test_a_bubble_rises_and_reaches_its_speed(taichi_cpu):
    pool = fluid(lattice((-0.15, -0.15, 0.0), (0.15, 0.15, 0.4)))
    parameters = WhitewaterParameters(bubble_rise_speed=0.25, bubble_buoyancy=2.0)
    rising = cloud((0.0, 0.0, 0.1), kind=WhitewaterKind.BUBBLE)
    frames = 30
    for frame in range(1, frames + 1):
        rising = advance(rising, pool, pool, frame=frame, using=solver(parameters))
    time, tau = frames * DT, 0.25 / (2.0 * 9.81)
    assert rising.kind.tolist() == [WhitewaterKind.BUBBLE]
    # The equation is solved exactly in still fluid; what is left is rounding to float32 at every frame.
    assert rising.position[0, 2] == pytest.approx(0.1 + 0.25 * (time - tau * (1 - np.exp(-time / tau))), abs=1e-6)
    assert rising.velocity[0, 2] == pytest.approx(0.25 * (1 - np.exp(-time / tau)), rel=1e-5)


def test_a_bubble_becomes_foam_at_the_surface_and_stays_there(taichi_cpu):
    pool = fluid(lattice((-0.15, -0.15, 0.0), (0.15, 0.15, 0.2)))
    rising = cloud((0.0, 0.0, 0.15), kind=WhitewaterKind.BUBBLE)
    for frame in range(1, 41):
        rising = advance(rising, pool, pool, frame=frame)
    assert rising.kind.tolist() == [WhitewaterKind.FOAM]
    # The surface of the lattice is a radius above its last layer, at 0.2 m; foam begins half a spacing below.
    assert rising.position[0, 2] == pytest.approx(0.2, abs=SPACING)


def test_a_bubble_beside_the_bottom_is_no_foam(taichi_cpu):
    pool = fluid(lattice((-0.15, -0.15, 0.0), (0.15, 0.15, 0.4)))
    places = [(0.0, 0.0, 0.001), (0.0, 0.0, 0.2), (0.0, 0.0, 0.4), (0.0, 0.0, 0.46)]
    after = advance(cloud(places), pool, pool, using=solver(gravity=(0.0, 0.0, 0.0)))
    bubble, foam, spray = WhitewaterKind.BUBBLE, WhitewaterKind.FOAM, WhitewaterKind.SPRAY
    assert after.kind.tolist() == [bubble, bubble, foam, spray]


def test_only_foam_ages_and_is_gone_when_its_time_is_up(taichi_cpu):
    pool = fluid(lattice((-0.15, -0.15, 0.0), (0.15, 0.15, 0.4)))
    places = [(0.0, 0.0, 0.2), (0.0, 0.0, 0.4), (0.0, 0.0, 0.8)]
    now = cloud(places, lifetime=2.5 * DT)
    still = solver(gravity=(0.0, 0.0, 0.0))
    left = []
    for frame in range(1, 4):
        now = advance(now, pool, pool, frame=frame, using=still)
        left.append(len(now))
    assert left == [3, 3, 2]
    np.testing.assert_array_equal(now.lifetime, np.float32(2.5 * DT))


def test_spray_that_lies_on_the_floor_dries_up(taichi_cpu):
    lying = cloud((0.3, 0.3, 0.001), lifetime=2.5 * DT)
    for frame in range(1, 5):
        lying = advance(lying, NO_FLUID, NO_FLUID, frame=frame)
    assert len(lying) == 0


@pytest.mark.parametrize("speed", [0.0, 0.5])
def test_a_still_tank_makes_nothing(taichi_cpu, speed):
    """Not even where particles fall over each other, as long as they are slower than `min_speed`."""
    rest = lattice((-0.2, -0.2, 0.0), (0.2, 0.2, 0.2))
    random = np.random.default_rng(1)
    direction = random.normal(size=rest.shape)
    trembling = fluid(rest, speed * direction / np.linalg.norm(direction, axis=1, keepdims=True))
    after, report = made(trembling, trembling)
    assert (len(after), report.generated, report.not_generated) == (0, 0, 0)


def test_as_many_are_made_as_the_potentials_say(taichi_cpu):
    begin, end = jets()
    parameters = WhitewaterParameters(max_speed=2.5)
    wide = DomainParameters(min=(-2.0, -2.0, -2.0), max=(2.0, 2.0, 2.0))
    after, report = made(begin, end, parameters, frame=7, domain=wide)
    motion = FluidMotion(begin, end, DT)
    field = FluidField(motion.bounds(), RADIUS, len(begin.position))
    expected = rounding_variance = 0.0
    for substep in range(report.substeps):
        now = motion.at((substep + 1) / report.substeps)
        field.update(now)
        means = generation_rate(now.velocity, *field.potentials(parameters.min_speed), parameters) * (
            DT / report.substeps
        )
        expected += means.sum()
        rounding_variance += (means % 1 * (1 - means % 1)).sum()
    assert expected > 300
    # Each mean is rounded up with the probability of its fraction: four standard deviations.
    assert report.generated == pytest.approx(expected, abs=4.0 * np.sqrt(rounding_variance))
    assert len(after) == report.generated


def test_the_cap_holds_and_what_had_no_room_is_counted(taichi_cpu):
    begin, end = jets()
    _, free = made(begin, end)
    cloud_then, capped = made(begin, end, WhitewaterParameters(max_particles=100))
    assert len(cloud_then) == 100
    assert capped.generated + capped.not_generated == free.generated


def test_two_fluids_of_a_tank_share_out_what_the_tank_makes(taichi_cpu):
    """Each feels the other, so the halves are those of the whole, particle by particle."""
    begin, end = jets()
    half = len(begin.particle_id) // 2
    (whole, report), (left, of_left), (right, of_right) = (
        made(begin, end, sources=sources) for sources in (None, begin.particle_id[:half], begin.particle_id[half:])
    )
    assert min(of_left.generated, of_right.generated) > 20
    assert of_left.generated + of_right.generated == report.generated
    both = np.concatenate([left.position, right.position])
    np.testing.assert_array_equal(np.sort(both, axis=0), np.sort(whole.position, axis=0))


def test_the_same_frame_gives_the_same_bits_and_another_seed_does_not(taichi_cpu):
    begin, end = jets()
    first, again, *others = (
        made(begin, end, WhitewaterParameters(seed=seed), frame=frame)[0]
        for seed, frame in ((0, 1), (0, 1), (1, 1), (0, 2))
    )
    for name in ("position", "velocity", "radius", "lifetime", "kind"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    for other in others:
        shared = min(len(first), len(other))
        assert not np.array_equal(first.position[:shared], other.position[:shared])


def cloud_of_jets() -> tuple[int, str]:
    using, cloud = solver(WhitewaterParameters()), WhitewaterCloud.empty()
    begin, end = jets()
    for frame in (1, 2, 3):
        cloud, _ = using.advance_frame(cloud, begin, end, frame=frame, particle_radius=RADIUS)
    return len(cloud), digest_of({"position": cloud.position, "velocity": cloud.velocity})


@pytest.mark.slow
def test_threads_do_not_change_a_bit(taichi_cpu):
    count, _ = result_on_any_threads(cloud_of_jets)
    assert count > 300
