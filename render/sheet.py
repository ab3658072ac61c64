"""Contact sheets: many frames in one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from render.pictures import read_rgb8

_GAP = 4
_BACKGROUND = (24, 24, 26)
_INK = (235, 235, 235)
_SHADE = (0, 0, 0)


def contact_sheet(
    pictures: Sequence[Path],
    output: Path,
    *,
    columns: int = 6,
    width: int = 1440,
    labels: Sequence[str] | None = None,
) -> None:
    """Draw pictures side by side, each with its frame number in the lower left corner, or with a label.

    Args:
        pictures: PNG files, row by row; each is fitted into a cell of the first one's proportions.
        output: the picture to write; its suffix names the format.
        columns: how many in a row; fewer when there are fewer pictures.
        width: of the sheet [pixels], at most: pictures are never enlarged.
        labels: one for each picture, of several lines where it has some; frame numbers if omitted.

    Raises:
        InvalidFileError: a picture is damaged.
        ValueError: there are no pictures, or there is too little room.
    """
    if not pictures:
        raise ValueError("a contact sheet needs at least one picture")
    columns = min(columns, len(pictures))
    cell_width = (width - (columns + 1) * _GAP) // columns if columns > 0 else 0
    if cell_width < 8:
        raise ValueError(f"{columns} columns do not fit into {width} pixels")

    first_height, first_width, _ = read_rgb8(pictures[0]).shape
    cell_width = min(cell_width, first_width)
    width = columns * (cell_width + _GAP) + _GAP
    cell_height = max(1, round(cell_width * first_height / first_width))
    rows = math.ceil(len(pictures) / columns)
    sheet = Image.new("RGB", (width, rows * (cell_height + _GAP) + _GAP), _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    font_size = max(9, min(18, cell_height // 9))
    font = ImageFont.load_default(size=font_size)
    for index, path in enumerate(pictures):
        row, column = divmod(index, columns)
        x, y = _GAP + column * (cell_width + _GAP), _GAP + row * (cell_height + _GAP)
        thumbnail = Image.fromarray(read_rgb8(path))
        thumbnail.thumbnail((cell_width, cell_height), Image.Resampling.LANCZOS)
        sheet.paste(thumbnail, (x, y))
        label = frame_label(path) if labels is None else labels[index]
        for line, text in enumerate(reversed(label.split("\n"))):
            place = (x + _GAP, y + cell_height - _GAP - line * round(1.2 * font_size))
            draw.text(place, text, _INK, font, anchor="ls", stroke_width=1, stroke_fill=_SHADE)
    sheet.save(output)


def frame_label(path: Path) -> str:
    """Label of a picture: its frame number without leading zeros, or its name where that is not a number."""
    return str(int(path.stem)) if path.stem.isdecimal() else path.stem
