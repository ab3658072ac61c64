"""Grains of soft matter as they are drawn."""

import numpy as np
import pytest

from render.grains import GRAINS_A_PARTICLE, PACKING, grains_of


def test_grains_fill_their_share_and_stay_with_their_particle():
    rng = np.random.default_rng(4)
    n, radius = 5000, 0.005
    position, velocity = rng.uniform(size=(n, 3)), rng.normal(size=(n, 3))
    ids = np.arange(n)
    cloud = grains_of(position, velocity, ids, radius=radius)
    assert len(cloud.position) == n * GRAINS_A_PARTICLE
    volume = (4.0 / 3.0 * np.pi * cloud.radius.astype(np.float64) ** 3).sum()
    assert volume == pytest.approx(PACKING * n * (2.0 * radius) ** 3, rel=0.02)
    own = cloud.position.reshape(n, GRAINS_A_PARTICLE, 3) - position[:, None]
    assert np.abs(own).max() <= radius * (1.0 + 1e-4)
    assert cloud.radius.std() > 0.1 * cloud.radius.mean()
    # Without half of the particles the others keep theirs.
    half = grains_of(position[::2], velocity[::2], ids[::2], radius=radius)
    np.testing.assert_array_equal(half.position, cloud.position.reshape(n, -1, 3)[::2].reshape(-1, 3))
    np.testing.assert_array_equal(half.radius, cloud.radius.reshape(n, -1)[::2].ravel())


def test_grains_have_the_dye_of_their_particle():
    position, dye = np.zeros((3, 3)), np.array([0.0, 0.5, 1.0], np.float32)
    cloud = grains_of(position, position, np.arange(3), dye, radius=0.005)
    np.testing.assert_array_equal(cloud.dye, np.repeat(dye, GRAINS_A_PARTICLE))
