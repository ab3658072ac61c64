"""Steps of their own for fast bodies, and sleep for those that rest."""

import math

import numpy as np
import pytest
from rigid_scenes import advance, ball, body, cube, in_room, in_space
from thread_counts import digest_of, result_on_any_threads

from sim.build import build_world
from sim.core.domain import DomainParameters
from sim.rigid.solver import LARGEST_DT, RigidSolver
from sim.scene import SceneParameters

SCATTERED = [
    body(f"b{k}", cube(0.1), (0.08 * (k % 3) - 0.1, 0.05 * (k % 2), 0.1 + 0.13 * k), rotation_deg=(40 * k, 25 * k, 0))
    for k in range(6)
]


def run(solver: RigidSolver, duration_s: float) -> RigidSolver:
    """As a world does whose bodies nothing is coupled to: frames, cut into equal steps."""
    solver.has_own_steps = True
    for frame in range(round(60 * duration_s)):
        solver.begin_frame(frame / 60)
        steps = math.ceil(1 / 60 / solver.stable_dt() * (1 - 1e-9))
        for _ in range(steps):
            solver.substep(1 / 60 / steps)
    return solver


def test_a_fast_body_elsewhere_takes_steps_of_its_own_and_changes_not_a_bit_of_the_others():
    # It meets the floor, at 120 m/s and thus in steps of 20 us, and flies back up.
    bullet = body("bullet", ball(0.01), (-1.5, -1.5, 1.0), velocity=(0.0, 0.0, -120.0), restitution=1.0)
    alone, together = run(in_room(*SCATTERED), 0.4), run(in_room(*SCATTERED, bullet), 0.4)
    np.testing.assert_array_equal(together.bodies.position[:-1], alone.bodies.position)
    np.testing.assert_array_equal(together.bodies.velocity[:-1], alone.bodies.velocity)
    assert together.bodies.velocity[-1, 2] == pytest.approx(120.0, rel=0.05)


def test_a_fast_ball_bounces_between_walls_without_steps_of_its_own():
    """It passes a quarter of its radius in a 26th of a step."""
    ball_between = body("ball", ball(0.02), (0.0, 0.1, 2.0), velocity=(0.0, 70.0, 0.0), friction=0.0, restitution=1.0)
    still = body("still", cube(0.2), (1.0, 0.0, 0.1))
    domain = DomainParameters(min=(-2.0, -0.5, 0.0), max=(2.0, 0.5, 4.0))
    solver = RigidSolver([still, ball_between], domain=domain, gravity=(0.0, 0.0, 0.0))
    solver.has_own_steps = True
    room, dt = 1.0 - 2.0 * 0.02, 1.0 / 540.0
    for step in range(1, 101):
        awake = ~solver.bodies.is_asleep
        assert [count for count, _ in solver._chooser.divided(solver.poses(), dt, awake)] == [1]
        solver.substep(dt)
        way = (0.1 + 0.5 * room + 70.0 * step * dt) % (2.0 * room)
        assert solver.bodies.position[1, 1] == pytest.approx(min(way, 2.0 * room - way) - 0.5 * room, abs=1e-6)
    assert abs(solver.bodies.velocity[1, 1]) == pytest.approx(70.0, rel=1e-9)


def test_the_step_of_all_is_that_of_a_stack_however_fast_a_body_is():
    near = body("bullet", ball(0.01), (0.0, 0.0, 0.02), velocity=(100.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 900.0))
    solver = in_room(near)
    assert solver.stable_dt() < 0.1 * LARGEST_DT
    solver.has_own_steps = True
    assert solver.stable_dt() == LARGEST_DT


@pytest.mark.parametrize("speed", [30.0, 200.0])
def test_a_fast_body_passes_neither_a_thin_plate_nor_a_body_in_a_step(speed):
    plate = body("plate", {"type": "box", "size": (1.0, 1.0, 0.004)}, (0, 0, 1.0), kind="static")
    bullet = body("bullet", ball(0.02), (0, 0, 2.0), velocity=(0.1, 0, -speed))
    solver = run(in_room(bullet, obstacles=[plate]), 2.0 / speed + 0.1)
    assert solver.bodies.position[0, 2] > 1.0 + 0.02
    target = body("target", cube(0.04), (0, 0, 1.0), density=5e4)
    solver = run(in_space(bullet, target), 2.0 / speed + 0.1)
    assert solver.bodies.velocity[1, 2] < -0.01
    assert solver.bodies.position[0, 2] > solver.bodies.position[1, 2]


def stack(*more, **surroundings) -> RigidSolver:
    return in_room(*(body(f"box{k}", cube(0.2), (0, 0, 0.2 * (k + 0.5))) for k in range(3)), *more, **surroundings)


def test_a_stack_falls_asleep_and_stays_where_it_is_to_the_bit():
    solver = run(stack(), 1.0)
    assert solver.bodies.is_asleep.all()
    assert solver.max_surface_speed() == 0.0
    position, orientation = solver.bodies.position.copy(), solver.bodies.orientation.copy()
    run(solver, 0.5)
    np.testing.assert_array_equal(solver.bodies.position, position)
    np.testing.assert_array_equal(solver.bodies.orientation, orientation)


def test_what_hits_one_of_a_sleeping_stack_wakes_all_of_it_and_nobody_else():
    aside = body("aside", cube(0.2), (1.0, 0.0, 0.1))
    solver = run(stack(aside, body("stone", ball(0.05), (0.0, 0.0, 3.5), velocity=(0, 0, 4.9))), 1.0)
    assert solver.bodies.is_asleep.tolist() == [True, True, True, True, False]  # the stone is on its way
    while solver.bodies.is_asleep[:3].all():
        assert solver.bodies.position[4, 2] > 0.6
        run(solver, 1.0 / 60.0)
    assert solver.bodies.is_asleep.tolist() == [False, False, False, True, False]
    assert solver.bodies.position[4, 2] < 0.9  # a sleeping body is woken a step before it is hit


@pytest.mark.parametrize("how", ["impulse", "gravity", "mass", "surface", "support"])
def test_impulses_changes_and_supports_that_leave_wake_a_stack(how):
    lift = [{"time_s": 1.0, "position": (0, 0, -0.1)}, {"time_s": 1.2, "position": (0, 0, -0.5)}]
    support = {"type": "box", "size": (1.0, 1.0, 0.2)}
    pit = DomainParameters(min=(-2.0, -2.0, -2.0), max=(2.0, 2.0, 4.0))
    solver = run(stack(body("lift", support, kind="kinematic", keyframe=lift), domain=pit), 1.0)
    assert solver.bodies.is_asleep.tolist() == [True, True, True, False]
    if how == "impulse":
        solver.push("box2", np.array([0.0, 0.1, 0.0]))
        assert not solver.bodies.is_asleep[2]
    elif how == "gravity":
        solver.set_gravity((0.0, 1.0, -9.0))
    elif how == "mass":
        solver.scale_mass("box1", 2.0)
    elif how == "surface":
        solver.set_surface("lift", friction=0.0)
    else:
        solver.substep(LARGEST_DT)
        solver.substep(LARGEST_DT)
    assert not solver.bodies.is_asleep[0] or how == "impulse"
    solver.substep(LARGEST_DT)
    assert not solver.bodies.is_asleep[:3].any()


def test_a_stack_on_a_lift_that_creeps_stays_awake_and_rides_on():
    support = {"type": "box", "size": (1.0, 1.0, 0.2)}
    pit = DomainParameters(min=(-2.0, -2.0, -2.0), max=(2.0, 2.0, 4.0))
    lift = body("lift", support, (0, 0, -0.1), kind="kinematic", velocity=(0.001, 0.0, 0.0))
    solver = run(stack(lift, domain=pit), 1.0)
    assert not solver.bodies.is_asleep.any()
    np.testing.assert_allclose(solver.bodies.position[:3, 0], 0.001, rtol=0.01)  # it starts at rest: some slip


def test_a_slow_body_without_gravity_goes_on_for_ever():
    solver = run(in_space(body("slow", cube(0.2), (0, 0, 1), velocity=(1e-4, 0.0, 0.0))), 2.0)
    assert not solver.bodies.is_asleep.any()
    assert solver.bodies.position[0, 0] == pytest.approx(2e-4, rel=1e-9)


def sleepers() -> SceneParameters:
    """Boxes that sleep after a second, and are hit later, beside others that move; and one that is far too fast."""
    boxes = [body(f"box{k}", cube(0.2), (0, 0, 0.2 * (k + 0.5))) for k in range(3)]
    late = body("late", ball(0.05), (0.0, 0.05, 3.2), velocity=(0.0, 0.0, 5.0))
    fast = body("fast", ball(0.02), (1.5, 1.0, 0.5), velocity=(-3.0, 0.0, 30.0), restitution=0.9)
    room = {"min": (-2, -2, 0), "max": (2, 2, 4)}
    return SceneParameters(rigid=(*boxes, late, fast), domain=room)


def test_a_run_that_continues_among_sleepers_equals_the_uninterrupted_one_to_the_bit():
    straight, interrupted, continued = (build_world(sleepers(), frames_per_second=60) for _ in range(3))
    for _ in range(85):
        straight.advance_frame()
    for _ in range(62):
        interrupted.advance_frame()
    checkpoint = interrupted.checkpoint()
    assert checkpoint["rigid/is_asleep"].tolist() == [True, True, True, False, False]
    continued.restore(62, checkpoint)
    for _ in range(23):
        continued.advance_frame()
    expected, found = straight.checkpoint(), continued.checkpoint()
    assert not expected["rigid/is_asleep"].any()  # the ball has hit them
    for key, array in expected.items():
        np.testing.assert_array_equal(found[key], array, err_msg=key)


def test_who_sleeps_while_something_is_led_far_away_rests_on_the_same_contacts_after_a_restart():
    def resting() -> RigidSolver:
        path = ({"time_s": 1.2, "position": (1.5, 1.5, 1.0)}, {"time_s": 2.2, "position": (-1.5, 1.5, 1.0)})
        return stack(body("led", cube(0.1), kind="kinematic", keyframe=path))

    straight, continued = run(resting(), 1.8), resting()
    assert straight.bodies.is_asleep[:-1].all()
    continued.restore(straight.checkpoint())
    for solver in (straight, continued):
        solver.set_gravity((0.0, 0.0, -10.0))
        advance(solver, 0.02, 2e-3)
    assert straight.diagnostics()["contacts"] > 0
    expected, found = straight.checkpoint(), continued.checkpoint()
    for name, array in expected.items():
        np.testing.assert_array_equal(array, found[name], err_msg=name)


def digest_of_many() -> str:
    """Of two heaps and a fast body."""
    heaps = [
        body(f"b{k}{name}", shape, (side, 0.05 * (k % 2), 0.1 + 0.13 * k), rotation_deg=(40 * k, 25 * k, 0))
        for name, side in (("left", -0.5), ("right", 0.5))
        for k, shape in enumerate([cube(0.1), ball(0.06), {"type": "cylinder", "radius": 0.05, "height": 0.1}] * 2)
    ]
    return digest_of(run(in_room(*heaps, body("fast", ball(0.02), (0, 0, 2), velocity=(0, 60, 0))), 0.5).checkpoint())


def test_any_number_of_threads_gives_the_same_bits():
    assert result_on_any_threads(digest_of_many)
