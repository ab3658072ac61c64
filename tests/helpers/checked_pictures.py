"""Pictures in files, decoded and checked as those that a renderer has just drawn."""

from __future__ import annotations

from pathlib import Path

from render.pictures import PictureStatistics, check_pixels, read_picture


def validate_picture(path: Path, resolution: tuple[int, int], *, may_be_empty: bool = False) -> PictureStatistics:
    return check_pixels(path, read_picture(path), resolution, may_be_empty=may_be_empty)
