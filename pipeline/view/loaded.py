"""Frames that were shown, kept in bounded memory so that a film that repeats itself is not read again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

from pipeline.view.frames import ShownFrame


class LoadedFrames:
    """The frames that were used last, as many as fit.

    Args:
        most_bytes: of all frames together; the one that is shown is kept in any case.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._frames: OrderedDict[int, tuple[Hashable, ShownFrame]] = OrderedDict()
        self._bytes = 0

    @property
    def bytes(self) -> int:
        """What the frames take now."""
        return self._bytes

    def __len__(self) -> int:
        return len(self._frames)

    def get(self, frame: int, state: Hashable) -> ShownFrame | None:
        """A frame, if it was read from files in this state."""
        kept = self._frames.get(frame)
        if kept is None or kept[0] != state:
            return None
        self._frames.move_to_end(frame)
        return kept[1]

    def put(self, frame: int, state: Hashable, shown: ShownFrame) -> None:
        """Keep a frame instead of those that were not used for the longest time."""
        before = self._frames.pop(frame, None)
        self._bytes += shown.bytes - (before[1].bytes if before is not None else 0)
        self._frames[frame] = (state, shown)
        while self._bytes > self._most_bytes and len(self._frames) > 1:
            _, (_, dropped) = self._frames.popitem(last=False)
            self._bytes -= dropped.bytes

    def clear(self) -> None:
        """Forget all frames."""
        self._frames.clear()
        self._bytes = 0
