"""Continuity of a film: finds pictures that pop up for one frame, repeat, or jump.

How two pictures differ is the root mean square of the difference of their luma, in means over blocks: noise averages
out, and what is as large as a block counts. Why not FLIP: docs/decisions/0030-checks-of-pictures.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BLOCKS_ACROSS = 160  # blocks along the longer side, at most: 12 pixels of a picture in full HD

VISIBLE = 0.01
"""Difference of luma [-], of 1 for black against white, over the whole picture, from which a pop or a jump counts: a
twentieth of the picture that changes by 0.045, or all of it by two or three grey levels of 255."""
MOVING = 0.004
"""Difference from which neighbours count as moving: a grey level. Where a segment of the film begins, a still differs
by up to 0.0035, as its pictures are encoded anew (crf 16)."""
RETURNS = 0.5
"""A picture pops if those beside it differ from each other by less than this share of what it differs from each ..."""
POPS = 2.5  # ... and if that is more than the differences around by this factor: at a bounce, too, a motion returns
STANDS_STILL = 0.25
"""A picture repeats if it differs from the one before by less than this share of the differences around; by nothing
where it was drawn, but a new segment of the film makes it a fifth of those of a slow motion."""
JUMPS = 5.0  # a jump is larger than the two differences before and the two after by this factor


@dataclass(frozen=True)
class Break:
    """A break in a film's continuity: a `pop`, a `repeat` of the frame before, or a `jump` to this frame.

    Attributes:
        difference: from the frame before [-].
        usual: difference that it is held against: between the frames beside a pop, of the neighbours otherwise [-].
    """

    kind: str
    frame: int
    difference: float
    usual: float

    def __str__(self) -> str:
        what = {
            "pop": "differs from both frames beside it, which are alike",
            "repeat": "repeats the frame before it in the middle of a motion",
            "jump": "differs far more from the frame before it than its neighbours do from theirs",
        }[self.kind]
        return f"frame {self.frame} {what} ({self.difference:.4f} against {self.usual:.4f})"


def block_means(luma: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Means over square blocks of a picture, 0 to 1.

    Args:
        luma: (height, width).
    """
    height, width = luma.shape
    edge = max(1, -(-max(height, width) // BLOCKS_ACROSS))
    rows, columns = max(1, height // edge), max(1, width // edge)
    whole = luma[: rows * edge, : columns * edge].reshape(rows, min(edge, height), columns, min(edge, width))
    means: NDArray[np.float32] = whole.mean(axis=(1, 3), dtype=np.float32) / np.float32(255.0)
    return means


class Continuity:
    """Looks at the frames of a film, one after the other, and finds where it does not run on.

    A still is no break, nor is a motion that begins or ends, nor a film that differs much from frame to frame all the
    time. A frame that is missing from an even motion is not found: a motion twice as fast for one frame may be meant.
    """

    def __init__(self) -> None:
        self._ones: list[float] = []
        self._twos: list[float] = []
        self._before: list[NDArray[np.float32]] = []

    def see(self, luma: NDArray[np.uint8]) -> None:
        """The next frame, (height, width)."""
        picture = block_means(luma)
        if self._before:
            self._ones.append(_difference(picture, self._before[-1]))
        if len(self._before) > 1:
            self._twos.append(_difference(picture, self._before[-2]))
        self._before = [*self._before[-1:], picture]

    def breaks(self) -> list[Break]:
        """The breaks among the frames seen so far."""
        found = (self._break_at(frame) for frame in range(1, len(self._ones) + 1))
        return [each for each in found if each is not None]

    def _break_at(self, frame: int) -> Break | None:
        ones, come = self._ones, self._ones[frame - 1]
        before = ones[max(0, frame - 3) : frame - 1]
        if frame < len(ones):
            go, across = ones[frame], self._twos[frame - 1]
            if _pops(come, go, across, calm=[*before, *ones[frame + 1 : frame + 3]]):
                return Break("pop", frame, come, across)
            if before and min(before[-1], go) > MOVING and come < STANDS_STILL * min(before[-1], go):
                return Break("repeat", frame, come, min(before[-1], go))
        around = [*before, *ones[frame : frame + 2]]
        if len(around) == 4 and come > VISIBLE and come > JUMPS * max(*around, MOVING):
            return Break("jump", frame, come, max(around))
        return None


def _pops(come: float, go: float, across: float, *, calm: list[float]) -> bool:
    """Whether a picture pops that differs so from the one before, the one behind, and these from each other."""
    least = min(come, go)
    return least > VISIBLE and across < RETURNS * least and least > POPS * max([*calm, MOVING])


def _difference(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean(np.square(a - b, dtype=np.float64))))
