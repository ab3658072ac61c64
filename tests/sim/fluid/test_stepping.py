import numpy as np
import pytest
import taichi as ti

from sim.fluid.stepping import advance_particles

FAR = 1.0e30
DT = 1.0e-3


def device(rows: list[list[float]]) -> ti.Ndarray:
    array = ti.Vector.ndarray(3, ti.f32, len(rows))
    array.from_numpy(np.array(rows, dtype=np.float32))
    return array


def advance(position: ti.Ndarray, velocity: ti.Ndarray, acceleration: ti.Ndarray):
    """One step in the box 0 ... 1 m, open at the upper end of z."""
    wall_low, wall_high = ti.math.vec3(0.0, 0.0, 0.0), ti.math.vec3(1.0, 1.0, FAR)
    keep_low, keep_high = ti.math.vec3(-FAR, -FAR, -FAR), ti.math.vec3(FAR, FAR, 1.0)
    return advance_particles(
        position, velocity, acceleration, position.shape[0], DT, wall_low, wall_high, keep_low, keep_high
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_non_finite_particle_counts_as_bad_and_not_as_one_that_left(taichi_cpu, value, axis):
    force = [0.0, 0.0, 0.0]
    force[axis] = value
    position = device([[0.5, 0.5, 0.5], [0.2, 0.2, 0.2]])
    motion = advance(position, device([[0.0] * 3] * 2), device([force, [0.0] * 3]))
    assert (motion.bad, motion.left) == (1, 0)
    np.testing.assert_array_equal(position.to_numpy()[1], np.float32([0.2, 0.2, 0.2]))


def test_a_finite_particle_beyond_an_open_face_counts_as_one_that_left(taichi_cpu):
    motion = advance(device([[0.5, 0.5, 0.999]]), device([[0.0, 0.0, 8.0]]), device([[0.0] * 3]))
    assert (motion.bad, motion.left, motion.touched) == (0, 1, 0)


def test_a_particle_that_a_wall_stops_shows_the_speed_and_the_way_it_came_with(taichi_cpu):
    position, velocity = device([[0.995, 0.5, 0.5]]), device([[8.0, 0.0, 0.0]])
    motion = advance(position, velocity, device([[0.0] * 3]))
    assert motion.touched == 1
    np.testing.assert_array_equal(position.to_numpy(), np.float32([[1.0, 0.5, 0.5]]))
    np.testing.assert_array_equal(velocity.to_numpy(), 0.0)
    assert motion.max_speed_squared == 64.0
    # Positions near 1 m are float32 numbers, 6e-8 m apart, of a way of 5e-3 m.
    assert motion.max_displacement_squared == pytest.approx(0.005**2, rel=1e-4)
