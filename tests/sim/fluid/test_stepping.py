import numpy as np
import pytest
import taichi as ti

from sim.fluid.stepping import Box, MotionSummary, ParticleStepper

FAR = 1.0e30
DT = 1.0e-3


def device(rows: list[list[float]]) -> ti.Ndarray:
    array = ti.Vector.ndarray(3, ti.f32, len(rows))
    array.from_numpy(np.array(rows, dtype=np.float32))
    return array


def advance(position: ti.Ndarray, velocity: ti.Ndarray, acceleration: ti.Ndarray) -> MotionSummary:
    """One step in the box 0 ... 1 m, open at the upper end of z."""
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, FAR), (-FAR, -FAR, -FAR), (FAR, FAR, 1.0))
    return ParticleStepper(box).advance(position, velocity, acceleration, position.shape[0], DT)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_non_finite_particle_counts_as_bad_and_not_as_one_that_left(taichi_cpu, value, axis):
    force = [0.0, 0.0, 0.0]
    force[axis] = value
    position = device([[0.5, 0.5, 0.5], [0.2, 0.2, 0.2]])
    motion = advance(position, device([[0.0] * 3] * 2), device([force, [0.0] * 3]))
    assert (motion.non_finite, motion.left) == (1, 0)
    np.testing.assert_array_equal(position.to_numpy()[1], np.float32([0.2, 0.2, 0.2]))


def test_a_finite_particle_beyond_an_open_face_counts_as_one_that_left(taichi_cpu):
    motion = advance(device([[0.5, 0.5, 0.999]]), device([[0.0, 0.0, 8.0]]), device([[0.0] * 3]))
    assert (motion.non_finite, motion.left, motion.touched) == (0, 1, 0)


def test_a_particle_that_a_wall_stops_shows_the_speed_and_the_way_it_came_with(taichi_cpu):
    position, velocity = device([[0.995, 0.5, 0.5]]), device([[8.0, 0.0, 0.0]])
    motion = advance(position, velocity, device([[0.0] * 3]))
    assert motion.touched == 1
    np.testing.assert_array_equal(position.to_numpy(), np.float32([[1.0, 0.5, 0.5]]))
    np.testing.assert_array_equal(velocity.to_numpy(), 0.0)
    assert motion.max_speed == 8.0
    # Positions near 1 m are float32 numbers, 6e-8 m apart, of a way of 5e-3 m.
    assert motion.max_displacement == pytest.approx(0.005, rel=1e-4)


@pytest.mark.parametrize("count", [1, 255, 256, 257, 5000])
def test_every_particle_is_advanced_once_and_counted_once_whatever_their_number(taichi_cpu, count):
    rng = np.random.default_rng(count)
    start = rng.uniform(0.2, 0.8, (count, 3)).astype(np.float32)
    speed = rng.normal(size=(count, 3)).astype(np.float32)
    speed[rng.integers(count)] *= 50.0
    position, velocity = device(start.tolist()), device(speed.tolist())
    motion = advance(position, velocity, device(np.zeros((count, 3)).tolist()))
    np.testing.assert_allclose(position.to_numpy(), start + np.float32(DT) * speed, atol=1e-6)  # two roundings
    assert motion.max_speed == pytest.approx(np.linalg.norm(speed, axis=1).max(), rel=1e-6)
    assert (motion.left, motion.touched, motion.non_finite) == (0, 0, 0)
