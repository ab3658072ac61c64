"""The frames of a job that can be shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.task import ArtifactPath


@dataclass(frozen=True)
class CurrentPictures:
    """The frames that the film would be made of, as far as they are there: those of the job as it is now.

    Attributes:
        by_frame: by their numbers, rising.
        earlier: how many more are there, of an earlier version of the job.
    """

    by_frame: Mapping[int, Path]
    earlier: int

    @property
    def all(self) -> list[Path]:
        """First to last."""
        return [*self.by_frame.values()]

    @property
    def unbroken(self) -> list[Path]:
        """Those from the first frame on, up to the first one that is not there."""
        return [picture for number, (frame, picture) in enumerate(self.by_frame.items()) if number == frame]

    @property
    def others(self) -> str:
        """What to say of frames that are there and do not count; empty if there are none."""
        return f" ({self.earlier} more are of an earlier version of it)" if self.earlier else ""


def current_pictures(job: Job, layout: JobLayout, current: Set[ArtifactPath]) -> CurrentPictures:
    """The frames that count.

    Args:
        job: the job.
        layout: its folder.
        current: the files that are of the job as it is now, `JobAssessment.current`.
    """
    planned = {frame: layout.picture(frame) for frame in range(job.frame_count)}
    earlier = {layout.path(picture) for picture in planned.values() if picture not in current}
    return CurrentPictures(
        {frame: layout.path(picture) for frame, picture in planned.items() if picture in current},
        len(earlier & {*committed_pictures(layout)}),
    )


def committed_pictures(layout: JobLayout) -> list[Path]:
    """The frames that have their receipt, first to last: a file without one may be half a frame."""
    folder = layout.path(layout.picture(0)).parent
    receipts = sorted((layout.receipts / folder.name).glob("[0-9]*.png.json"))
    return [folder / receipt.name.removesuffix(".json") for receipt in receipts]


def evenly_spread(frames: Sequence[Path], count: int) -> list[Path]:
    """At most so many of the frames, the first and the last among them."""
    if len(frames) <= count:
        return [*frames]
    if count == 1:
        return [frames[-1]]
    return [frames[round(index * (len(frames) - 1) / (count - 1))] for index in range(count)]
