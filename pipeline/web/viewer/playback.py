"""Playback: the frame to be seen at a time. Pure: the caller brings the clock."""

import bisect
from collections.abc import Sequence


class Playback:
    """A playhead over the frames that are there, which may become more, at a rate of the film's frames a second.

    Frames are chosen by the clock: a page that is too slow for the rate misses some, and the film keeps its pace.
    Behind the last frame it `repeats`, or stays there.
    """

    def __init__(self, *, rate: float, repeats: bool = True) -> None:
        self.rate = rate
        self.repeats = repeats
        self._frames: tuple[int, ...] = ()
        self._index = 0
        self._since: float | None = None

    @property
    def plays(self) -> bool:
        """Whether it moves by itself."""
        return self._since is not None

    @property
    def frame(self) -> int | None:
        """The frame to be seen; None before there are any."""
        return self._frames[self._index] if self._frames else None

    def offer(self, frames: Sequence[int], *, follow: bool = False) -> None:
        """Tell the frames that there are now, ascending; `follow`: go to the newest."""
        before = self.frame
        self._frames = tuple(frames)
        self._index = 0
        if self._frames and follow and not self.plays:
            self._index = len(self._frames) - 1
        elif before is not None:
            self._index = self._nearest(before)

    def seek(self, frame: int) -> None:
        """Stop at a frame, or at the last one before it that is there."""
        self._since = None
        self._index = self._nearest(frame)

    def step(self, count: int) -> None:
        """Stop so many frames further on; never beyond the ends."""
        self._since = None
        self._index = min(max(self._index + count, 0), max(len(self._frames) - 1, 0))

    def play(self, now: float) -> None:
        """Go on from the frame that is seen at a time [s]; from the first one at the end of a film that stays there."""
        if not self.repeats and self._index + 1 >= len(self._frames):
            self._index = 0
        self._since = now

    def pause(self, now: float) -> None:
        """Stop at the frame that is to be seen at a time [s]."""
        self.advance(now)
        self._since = None

    def set_rate(self, rate: float, now: float) -> None:
        """Change the rate without a jump."""
        self.advance(now)
        self.rate = rate
        if self._since is not None:
            self._since = now

    def advance(self, now: float) -> int | None:
        """Move on; returns the frame to be seen at a time [s], None before there are any."""
        if self._since is None or not self._frames:
            return self.frame
        count = int((now - self._since) * self.rate)
        if count <= 0:
            return self.frame
        self._since += count / self.rate
        index = self._index + count
        if index >= len(self._frames):
            if self.repeats:
                index %= len(self._frames)
            else:
                index, self._since = len(self._frames) - 1, None
        self._index = index
        return self.frame

    def wait(self, now: float) -> float | None:
        """Time until the next frame is due [s]; None while nothing moves."""
        return None if self._since is None else max(0.0, self._since + 1.0 / self.rate - now)

    def _nearest(self, frame: int) -> int:
        return max(0, bisect.bisect_right(self._frames, frame) - 1)
