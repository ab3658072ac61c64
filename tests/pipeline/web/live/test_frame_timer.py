"""When a frame takes too long for a page, by a clock of its own; minutes in which kernels compile are no slow frame."""

import math

import pytest

from pipeline.web.live.soundness import FrameTimer


class Clock:
    """Shows what time it is told to be [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def substeps_borne(watch: FrameTimer, clock: Clock, substep_s: float, most: int) -> int:
    """How many substeps of a frame are borne."""
    watch.begin_frame()
    for count in range(most):
        clock.now += substep_s
        if watch.after_substep() is not None:
            return count
    return most


@pytest.mark.parametrize(("substep_s", "borne"), [(0.03125, 160), (0.25, 20), (0.5, 10), (30.0, 10), (0.02, 200)])
def test_a_frame_of_slow_substeps_is_borne_for_so_long_and_the_next_again(substep_s, borne):
    clock = Clock()
    watch = FrameTimer(5.0, clock=clock)
    assert [substeps_borne(watch, clock, substep_s, 200) for _ in range(2)] == [borne, borne]
    watch.longest_s = math.inf
    assert substeps_borne(watch, clock, substep_s, 1000) == 1000
