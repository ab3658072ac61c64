"""Philox4x32-10 against the known answers of its authors' library, Random123."""

import numpy as np
import pytest

from sim.core.hashed_numbers import philox, uniforms

ONES = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("counter", "key", "answer"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((ONES, ONES, ONES, ONES), (ONES, ONES), (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_the_known_answers_come_out(counter, key, answer):
    assert tuple(philox(counter, key)[:, 0]) == answer


def test_numbers_do_not_depend_on_what_is_drawn_beside_them():
    ids = np.arange(100)
    together = uniforms((ids, 3, 7, 1), (5, 0))
    alone = uniforms((ids[42:43], 3, 7, 1), (5, 0))
    np.testing.assert_array_equal(together[:, 42:43], alone)


def test_they_are_uniform_and_below_one():
    numbers = uniforms((np.arange(100_000), 0, 0, 0), (1, 2))
    assert numbers.min() >= 0.0
    assert numbers.max() < 1.0
    # 400,000 in 20 bins of 20,000: four standard deviations of a bin are 4 sqrt(19,000) = 551.
    counts = np.histogram(numbers, bins=20, range=(0, 1))[0]
    assert np.abs(counts - 20_000).max() < 551
