"""Films side by side, each with its name under it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, ImageOps

from render.movie import encode_frames, even, validate_movie
from render.parameters import MovieParameters
from render.pictures import read_rgb8

_QUALITY = MovieParameters(crf=18, preset="medium")
_GAP = 8
_BACKGROUND = (24, 24, 26)
_INK = (235, 235, 235)


class Film(NamedTuple):
    """One of those that are compared: the name shown under it, PNG files, one a frame, and frames a second [1/s]."""

    name: str
    pictures: Sequence[Path]
    fps: float


def compare_films(films: Sequence[Film], output: Path, *, width: int, threads: int) -> int:
    """Put films into one, side by side at equal times, as long as the shortest of them; returns the number of frames.

    Args:
        films: at least one, each with at least one picture; the first decides the proportions.
        output: the MP4 to write.
        width: of the film at most [pixels]; no picture gets more than the widest of them has.
        threads: of the encoder.

    Raises:
        InvalidFileError: a picture is damaged.
        ValueError: there are no films or pictures, or they are too many for the width.
    """
    if not films or not all(film.pictures for film in films):
        raise ValueError("there is nothing to compare: a film has no picture")
    sizes = [read_rgb8(film.pictures[0]).shape for film in films]
    first_height, first_width, _ = sizes[0]
    cell_width = min((width - (len(films) - 1) * _GAP) // len(films), max(size[1] for size in sizes))
    if cell_width < 64:
        raise ValueError(f"{len(films)} films do not fit into {width} pixels")
    cell = (cell_width, max(1, round(cell_width * first_height / first_width)))
    fps = max(film.fps for film in films)
    count = max(1, int(min(len(film.pictures) / film.fps for film in films) * fps + 1e-6))
    board = _Board([film.name for film in films], cell)
    encode_frames(board.frames(films, count, fps), board.size, output, fps=fps, parameters=_QUALITY, threads=threads)
    validate_movie(output, count)
    return count


class _Board:
    """The frame that pictures are put on, with the names drawn once."""

    def __init__(self, names: Sequence[str], cell: tuple[int, int]) -> None:
        width, height = cell
        self._cell = cell
        font_size = max(11, min(28, height // 14))
        caption = round(1.8 * font_size)
        self.size = even(len(names) * (width + _GAP) - _GAP), even(height + caption)
        self._empty = Image.new("RGB", self.size, _BACKGROUND)
        draw, font = ImageDraw.Draw(self._empty), ImageFont.load_default(size=font_size)
        for column, name in enumerate(names):
            middle = (column * (width + _GAP) + width / 2, height + caption / 2)
            draw.text(middle, _shortened(name, draw, font, width), _INK, font, anchor="mm")

    def frames(self, films: Sequence[Film], count: int, fps: float) -> Iterator[NDArray[np.uint8]]:
        """Each frame of the whole; pictures of slower films stay for several."""
        for number in range(count):
            board = self._empty.copy()
            for column, film in enumerate(films):
                index = min(int(number / fps * film.fps + 1e-6), len(film.pictures) - 1)
                picture = Image.fromarray(read_rgb8(film.pictures[index]))
                picture = ImageOps.contain(picture, self._cell, Image.Resampling.LANCZOS)
                left = column * (self._cell[0] + _GAP) + (self._cell[0] - picture.width) // 2
                board.paste(picture, (left, (self._cell[1] - picture.height) // 2))
            yield np.asarray(board)


def _shortened(
    name: str, draw: ImageDraw.ImageDraw, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: int
) -> str:
    """A name that fits, with dots for what is left out."""
    shown = name
    while len(shown) > 1 and draw.textlength(shown, font) > width:
        shown = shown.removesuffix("…")[:-1] + "…"
    return shown
