"""Films that run on, and films that do not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from render.continuity import Continuity, block_means

SIZE = (90, 160)


def ball(x: float, *, seed: int = 0, grain: float = 2.0) -> NDArray[np.uint8]:
    """A bright ball at x (0 to 1) on a backdrop with a gradient, with grain of so many grey levels."""
    rows, columns = np.indices(SIZE)
    shade = 60.0 + 0.5 * rows
    edge = np.hypot(rows - 45.0, columns - 160.0 * x) - 12.0
    shade += 120.0 * np.clip(0.5 - edge / 4.0, 0.0, 1.0)
    shade += np.random.default_rng(seed).normal(0.0, grain, SIZE)
    return np.clip(shade, 0, 255).astype(np.uint8)


def breaks_of(places: list[float | None]) -> list[tuple[str, int]]:
    """Of a film with the ball at these places; None: without the ball."""
    pictures = [ball(9.0 if x is None else x, seed=frame) for frame, x in enumerate(places)]
    return found_in(pictures)


def found_in(pictures: list[NDArray[np.uint8]]) -> list[tuple[str, int]]:
    film = Continuity()
    for picture in pictures:
        film.see(picture)
    return [(found.kind, found.frame) for found in film.breaks()]


SMOOTH = [0.1 + 0.015 * frame for frame in range(20)]
THROWN = [0.1 + 0.9 * (frame / 20) - 0.6 * (frame / 20) ** 2 for frame in range(20)]


@pytest.mark.parametrize(
    "places",
    [SMOOTH, THROWN, [0.5] * 20, [0.5] * 10 + SMOOTH, SMOOTH + [SMOOTH[-1]] * 10, SMOOTH[:1], SMOOTH[:2], []],
    ids=["even", "thrown", "still", "begins", "ends", "one frame", "two frames", "none"],
)
def test_motion_that_runs_on_has_no_break(places):
    assert breaks_of(places) == []


def test_a_bounce_is_no_break():
    assert breaks_of(SMOOTH + SMOOTH[::-1][1:]) == []


def test_a_ball_that_is_missing_in_one_picture_pops():
    slow = [0.1 + 0.004 * frame for frame in range(20)]
    for frame in (1, 7, 18):
        places: list[float | None] = [*slow]
        places[frame] = None
        assert breaks_of(places) == [("pop", frame)]


def test_a_picture_that_is_there_twice_repeats():
    places = [*SMOOTH]
    places[9] = places[8]
    pictures = [ball(x, grain=0.0) for x in places]
    assert found_in(pictures) == [("repeat", 9)]


def test_a_film_that_leaves_out_half_a_second_jumps():
    assert breaks_of(SMOOTH[:8] + [x + 0.4 for x in SMOOTH[8:]]) == []  # not beyond an even motion as fast as this
    slow = [0.1 + 0.001 * frame for frame in range(20)]
    assert breaks_of(slow[:8] + [x + 0.4 for x in slow[8:]]) == [("jump", 8)]


@pytest.mark.parametrize("shape", [(1080, 1920), (1920, 1080), (36, 64), (2, 3000), (1, 1)])
def test_blocks_cover_pictures_of_any_shape(shape):
    means = block_means(np.full(shape, 51, np.uint8))
    assert max(means.shape) <= 160
    assert means == pytest.approx(0.2)
