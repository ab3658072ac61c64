"""Which cells smoke is drawn in."""

from __future__ import annotations

import numpy as np
import pytest

from render.smoke_region import blur_reach, bounding_box, grown


@pytest.mark.parametrize("reach", [0, 1, 2, 3, 5, 12])
def test_a_mask_grows_by_its_reach_on_all_sides(reach):
    mask = np.random.default_rng(reach).random((9, 1, 6)) < 0.05
    cells = np.argwhere(np.ones(np.array(mask.shape) + 2 * reach, bool)) - reach
    steps = np.abs(cells[:, None] - np.argwhere(mask)).max(axis=2)
    near = (steps <= reach).any(axis=1)
    assert near.any()
    np.testing.assert_array_equal(grown(mask, reach).ravel(), near)


def test_the_bounding_box_holds_all_that_is_marked_and_no_more():
    mask = np.zeros((7, 8, 9), bool)
    assert bounding_box(mask) is None
    mask[2, 3, 4] = mask[5, 3, 8] = True
    assert bounding_box(mask) == (slice(2, 6), slice(3, 4), slice(4, 9))


def test_the_reach_is_what_the_fastest_smoke_crosses_in_half_the_shutter():
    velocity = np.zeros((70, 4, 4, 3), np.float32)
    velocity[66, 1, 1] = (3.0, 0.0, 4.0)  # beyond the first slab of cells
    velocity[1, 1, 1] = 100.0  # where there is no smoke
    mask = np.zeros((70, 4, 4), bool)
    mask[60:68] = True
    # 5 m/s for 1/100 s are 2.5 cells, and one is for interpolation.
    assert blur_reach(velocity, mask, shutter_s=0.02, cell_size=0.02) == 3 + 1
    assert blur_reach(velocity, mask, shutter_s=0.0, cell_size=0.02) == 1
    assert blur_reach(velocity, mask, shutter_s=10.0, cell_size=0.02) == 70
