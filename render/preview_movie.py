"""A small film of the pictures that are there, at the length and rate of the whole, for those who wait for it.

A frame that is not drawn yet shows the nearest drawn one before it, or the first one drawn. A strip below the picture
tells which parts of the film are drawn, and a mark on it where the film is: white on a drawn frame, amber on one that
another stands in for.
"""

from __future__ import annotations

import os
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from render.movie import encode_frames, even, validate_movie
from render.parameters import MovieParameters
from render.pictures import read_image

LARGEST_WIDTH = 640  # of the film [pixels]; pictures are never enlarged

_QUALITY = MovieParameters(crf=25, preset="veryfast")
_COPY_QUALITY = 92  # of the small copies, which are JPEG: they are encoded once more

_GROUND = np.array([18, 18, 20], np.float64)
_MISSING = np.array([46, 46, 50], np.float64)
_DRAWN = np.array([150, 156, 164], np.float64)
_MARK = (245, 245, 245)
_MARK_OF_STAND_IN = (255, 176, 48)


def write_preview_movie(pictures: Mapping[int, Path], frames: int, output: Path, *, fps: float, copies: Path) -> None:
    """Encode the preview movie as H.264, and decode it.

    Args:
        pictures: PNG files by frame; at least one.
        frames: how many the whole film has.
        output: the MP4 to write.
        fps: frames a second [1/s].
        copies: folder of small copies of pictures, `000042.jpg`, which are made where they are missing and used where
            they are there: no picture is decoded twice.

    Raises:
        InvalidFileError: a picture is damaged.
        ValueError: there are no pictures, or one of a frame that the film does not have.
        OSError: a file cannot be read or written.
    """
    drawn = sorted(pictures)
    if not drawn or drawn[0] < 0 or drawn[-1] >= frames:
        raise ValueError(f"a film of {frames} frames cannot be shown by pictures of the frames {drawn}")
    for frame in drawn:
        _make_copy(pictures[frame], _copy_of(frame, copies))
    with Image.open(_copy_of(drawn[0], copies)) as first:
        size = even(first.width), even(first.height)
    strip = _Strip(drawn, frames, width=size[0], height=max(4, even(size[1] // 45)))
    whole = (size[0], size[1] + strip.height)
    encode_frames(_frames(drawn, frames, copies, size, strip), whole, output, fps=fps, parameters=_QUALITY)
    validate_movie(output, frames)


def _copy_of(frame: int, copies: Path) -> Path:
    return copies / f"{frame:06d}.jpg"


def _make_copy(picture: Path, copy: Path) -> None:
    if copy.exists():
        return
    image = read_image(picture, LARGEST_WIDTH, reducing_gap=3.0)
    part = copy.with_suffix(f".{os.getpid()}")
    image.save(part, format="JPEG", quality=_COPY_QUALITY, subsampling=0)
    part.replace(copy)


def _frames(
    drawn: list[int], frames: int, copies: Path, size: tuple[int, int], strip: _Strip
) -> Iterator[NDArray[np.uint8]]:
    """Each frame of the film; one picture is held at a time."""
    shown, pixels = -1, np.empty(0, np.uint8)
    for frame in range(frames):
        nearest = drawn[max(0, bisect_right(drawn, frame) - 1)]
        if nearest != shown:
            with Image.open(_copy_of(nearest, copies)) as copy:
                image = copy.convert("RGB")
            shown, pixels = nearest, np.asarray(image if image.size == size else image.resize(size))
        yield np.concatenate([pixels, strip.at(frame, stands_in=nearest != frame)])


class _Strip:
    """What of the film is drawn, from its beginning on the left to its end on the right, drawn once."""

    def __init__(self, drawn: list[int], frames: int, *, width: int, height: int) -> None:
        self.height = height
        self._frames = frames
        there = np.zeros(frames)
        there[drawn] = 1.0
        # The share of each column's stretch of film that is drawn: a film has more frames than a strip has pixels.
        edges = np.linspace(0.0, frames, width + 1)
        done = np.interp(edges, np.arange(frames + 1), np.concatenate([[0.0], np.cumsum(there)]))
        share = (np.diff(done) * width / frames)[:, None]
        pixels = np.empty((height, width, 3))
        pixels[:] = _GROUND
        pixels[1:-1] = _MISSING + share * (_DRAWN - _MISSING)
        self._empty = np.round(pixels).astype(np.uint8)

    def at(self, frame: int, *, stands_in: bool) -> NDArray[np.uint8]:
        """The strip while a frame is shown, (height, width, 3)."""
        strip = self._empty.copy()
        width = strip.shape[1]
        # Two or four pixels from an even one on: colours of the film have half its resolution.
        thickness = min(width, 4 if width >= LARGEST_WIDTH // 2 else 2)
        left = 2 * int((frame + 0.5) / self._frames * width / 2 - thickness / 4 + 0.5)
        left = min(max(0, left), width - thickness)
        strip[:, left : left + thickness] = _MARK_OF_STAND_IN if stands_in else _MARK
        return strip
