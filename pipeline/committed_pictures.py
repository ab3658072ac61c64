"""The frames of a job that can be shown."""

from __future__ import annotations

from pathlib import Path

from pipeline.layout import JobLayout


def committed_pictures(layout: JobLayout) -> list[Path]:
    """The frames that have their receipt, first to last: a file without one may be half a frame."""
    folder = layout.path(layout.picture(0)).parent
    receipts = sorted((layout.receipts / folder.name).glob("[0-9]*.png.json"))
    return [folder / receipt.name.removesuffix(".json") for receipt in receipts]


def evenly_spread(frames: list[Path], count: int) -> list[Path]:
    """At most so many of the frames, the first and the last among them."""
    if len(frames) <= count:
        return frames
    if count == 1:
        return frames[-1:]
    return [frames[round(index * (len(frames) - 1) / (count - 1))] for index in range(count)]
