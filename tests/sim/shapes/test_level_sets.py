"""Distances sampled on grids."""

import numpy as np
import pytest

from sim.shapes.level_set import LevelSet
from sim.shapes.parameters import Placement
from sim.shapes.placement import build_solid
from sim.shapes.solid import ShapeError

BALL = build_solid(Placement(shape={"type": "sphere", "radius": 0.25}, position=(0.1, 0.2, 0.3)))


def points_near_surface(count=5000):
    rng = np.random.default_rng(2)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return BALL.position + direction * rng.uniform(0.23, 0.27, (count, 1))


def test_error_stays_under_the_stated_bound_and_falls_with_second_order():
    points = points_near_surface()
    errors = []
    for spacing in (0.02, 0.01):
        level_set = LevelSet.sample(BALL, spacing, padding=0.05)
        error = np.abs(level_set.signed_distance(points) - BALL.signed_distance(points)).max()
        assert error < spacing**2 / (4.0 * 0.23) * 1.05  # 5 % for third-order terms and float32
        errors.append(error)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.2)


def test_gradient_is_the_normal():
    points = points_near_surface()
    normal = (points - BALL.position) / np.linalg.norm(points - BALL.position, axis=1, keepdims=True)
    level_set = LevelSet.sample(BALL, 0.01, padding=0.05)
    # Slopes of the linear pieces: off by spacing/(2 R) = 0.02 at most per axis.
    np.testing.assert_allclose(level_set.gradient(points), normal, atol=0.02)


class Counted:
    """A solid that counts the distances that it is asked for."""

    def __init__(self, solid):
        self.solid, self.bounds, self.count = solid, solid.bounds, 0

    def signed_distance(self, points):
        self.count += len(points)
        return self.solid.signed_distance(points)


def test_distances_far_from_the_surface_may_be_coarse_but_have_the_right_sign_and_cost_little():
    spacing, exact_within = 0.005, 0.01
    exact = LevelSet.sample(BALL, spacing)
    counted = Counted(BALL)
    banded = LevelSet.sample(counted, spacing, exact_within=exact_within)
    near = np.abs(exact.values) <= exact_within
    np.testing.assert_array_equal(banded.values[near], exact.values[near])
    np.testing.assert_array_equal(np.sign(banded.values), np.sign(exact.values))
    # Coarse cells of 2 and 4 spacings (of 26 cells along an edge), and the ball's centre, where its distance has a tip.
    assert np.abs(banded.values - exact.values).max() <= 0.87 * 4.0 * spacing
    assert counted.count < 0.5 * exact.values.size


def test_outside_of_the_grid_the_distance_is_an_upper_bound_and_positive():
    level_set = LevelSet.sample(BALL, 0.02)
    points = BALL.position + np.array([[1.0, 0.0, 0.0], [0.0, -2.0, 1.0], [3.0, 3.0, 3.0]])
    exact = BALL.signed_distance(points)
    assert np.all(level_set.signed_distance(points) >= exact - 1e-3)  # the grid's own error, below spacing²/R
    assert np.all(level_set.signed_distance(points) < 1.2 * exact)


def test_grid_that_would_not_fit_is_refused():
    with pytest.raises(ShapeError, match="is too large; use a larger spacing"):
        LevelSet.sample(BALL, 1.0e-4)
