"""The fluid between two frames."""

import numpy as np

from sim.whitewater.motion import FluidMotion, FluidState

DT = 1.0 / 60.0


def state(ids, position, velocity) -> FluidState:
    return FluidState(np.array(ids, np.int32), np.array(position, np.float32), np.array(velocity, np.float32))


def test_both_frames_are_met():
    random = np.random.default_rng(0)
    begin = state(range(50), random.normal(size=(50, 3)), random.normal(size=(50, 3)))
    end = state(range(50), begin.position + DT * begin.velocity, random.normal(size=(50, 3)))
    motion = FluidMotion(begin, end, DT)
    # A cubic's weights are 0 and 1 exactly at its ends; only the sum of its four terms rounds.
    for share, frame in ((0.0, begin), (1.0, end)):
        np.testing.assert_allclose(motion.at(share).position, frame.position, atol=1e-6)
        np.testing.assert_allclose(motion.at(share).velocity, frame.velocity, atol=1e-4)


def test_a_circle_is_followed_to_fourth_order():
    omega = 10.0

    def on_circle(time: float) -> FluidState:
        c, s = np.cos(omega * time), np.sin(omega * time)
        return state([0], [[c, s, 0.0]], [[-omega * s, omega * c, 0.0]])

    middle = FluidMotion(on_circle(0.0), on_circle(DT), DT).at(0.5)
    exact = on_circle(0.5 * DT)
    # Error of cubic Hermite interpolation: (omega dt)^4 / 384 = 2e-6; a straight line errs by (omega dt)²/8 = 3e-3.
    np.testing.assert_allclose(middle.position, exact.position, atol=3e-6)
    np.testing.assert_allclose(middle.velocity, exact.velocity, atol=omega * 1e-4)


def test_particles_that_come_move_straight_and_those_that_go_are_gone():
    begin = state([1, 2], [[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]])
    end = state([2, 5], [[1, 0, 0], [3, 0, 0]], [[0, 0, 0], [6, 0, 0]])
    halfway = FluidMotion(begin, end, DT).at(0.5)
    assert halfway.particle_id.tolist() == [2, 5]
    np.testing.assert_allclose(halfway.position, [[1, 0, 0], [3 - 0.5 * DT * 6, 0, 0]], atol=1e-6)


def test_a_frame_without_fluid_has_no_speed():
    empty = state([], np.zeros((0, 3)), np.zeros((0, 3)))
    motion = FluidMotion(empty, empty, DT)
    assert motion.max_speed() == 0.0
    assert len(motion.at(0.5).position) == 0
