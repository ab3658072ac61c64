"""The order in which frames take their turns."""

from itertools import pairwise

import pytest

from pipeline.model.job import Job
from pipeline.run.plan import frame_turns, spread_turns


def in_turn(turns: list[int]) -> list[int]:
    return sorted(range(len(turns)), key=lambda frame: turns[frame])


@pytest.mark.parametrize(
    ("frames", "expected"),
    [(1, [0]), (2, [0, 1]), (3, [0, 2, 1]), (9, [0, 8, 4, 2, 6, 1, 3, 5, 7]), (6, [0, 5, 2, 1, 3, 4])],
)
def test_the_first_goes_first_then_the_last_the_middle_and_what_is_between(frames, expected):
    assert in_turn(spread_turns(frames)) == expected


@pytest.mark.parametrize("frames", [10, 120, 997])
def test_every_frame_has_a_turn_and_the_film_fills_evenly(frames):
    order = in_turn(spread_turns(frames))
    assert sorted(order) == list(range(frames))
    for count in (3, 9, frames // 2, frames):
        taken = sorted(order[:count])
        gaps = [after - before for before, after in pairwise(taken)]
        # Gaps are halved in turn, so two generations of them stand beside each other; odd ones halve unevenly.
        assert max(gaps) <= 2 * min(gaps) + 2


def test_a_job_says_how_its_frames_take_turns():
    shape = {"type": "sphere", "radius": 0.1}
    scene = {"name": "still", "frames": 3, "rigid": [{"name": "ball", "shape": shape}]}
    assert frame_turns(Job.model_validate(scene, strict=False)) is None
    spread = Job.model_validate({**scene, "render": {"order": "spread"}}, strict=False)
    assert frame_turns(spread) == [0, 2, 1]
