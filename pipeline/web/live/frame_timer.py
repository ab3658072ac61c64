"""Longest time of a frame: requests are met between frames, so a page answers no sooner."""

from __future__ import annotations

from collections.abc import Callable

LONGEST_FRAME_S = 5.0
"""A frame that takes longer counts as blown up [s]."""

LONGEST_SUBSTEP_S = 0.5
"""A substep counts for no more: kernels compile, and machines sleep, within a few of them, and that passes."""


class FrameTimer:
    """A timer that looks at the clock after every substep of a frame.

    Attributes:
        longest_s: longest time that a frame may take [s]; infinite where people asked for slow frames.

    Args:
        clock: tells the time [s].
    """

    def __init__(self, longest_s: float, *, clock: Callable[[], float]) -> None:
        self.longest_s, self._clock = longest_s, clock
        self.begin_frame()

    def begin_frame(self) -> None:
        """A frame begins now."""
        self._spent_s, self._seen_s = 0.0, self._clock()

    @property
    def is_too_slow(self) -> bool:
        """Whether the frame has taken too long."""
        return self._spent_s > self.longest_s

    def after_substep(self) -> str | None:
        """Fault of the frame, if it has taken too long."""
        now = self._clock()
        self._spent_s += min(now - self._seen_s, LONGEST_SUBSTEP_S)
        self._seen_s = now
        return f"a frame takes longer than {self.longest_s:g} s" if self.is_too_slow else None
