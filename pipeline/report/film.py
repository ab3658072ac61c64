"""The film of a job as the report holds it: itself where it is small enough and browsers play it, else a small loop."""

from __future__ import annotations

import tempfile
from base64 import b64encode
from dataclasses import dataclass
from pathlib import Path

from pipeline.committed_pictures import committed_pictures, evenly_spread
from pipeline.errors import PipelineError
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.receipts import read_receipt
from pipeline.task import ArtifactPath

MOST_BYTES = 24 << 20
"""Of a film that is put into the page: a browser holds the page in memory, a third larger as text."""
PLAYABLE = frozenset({"h264", "av1"})
"""Codecs that the usual browsers play; H.265 and ProRes are not among them."""
LOOP_PICTURES, LOOP_WIDTH, LOOP_FPS = 90, 640, 15.0


@dataclass(frozen=True)
class ReportFilm:
    """A film as the report shows it.

    Attributes:
        content: its bytes.
        mime: what they are.
        width, height: of its picture [pixels].
        remark: why it is not the film itself; empty if it is.
    """

    content: bytes
    mime: str
    width: int
    height: int
    remark: str = ""

    @property
    def address(self) -> str:
        """An address that holds it."""
        return f"data:{self.mime};base64,{b64encode(self.content).decode()}"


def film_of(layout: JobLayout, job: Job) -> ReportFilm | None:
    """The film that was committed; None before there is one.

    Raises:
        PipelineError: a loop is needed, and a picture is damaged.
        OSError: a file cannot be read.
    """
    path = layout.film
    if read_receipt(layout, ArtifactPath(path.relative_to(layout.root).as_posix())) is None or not path.is_file():
        return None
    width, height = job.render.resolution
    size = path.stat().st_size
    if job.movie.codec in PLAYABLE and size <= MOST_BYTES:
        return ReportFilm(path.read_bytes(), "video/mp4", width, height)
    why = f"too large for this page, {size / 1e6:.0f} MB" if job.movie.codec in PLAYABLE else "not played by browsers"
    return _loop(layout, job, f"{path.name} is {why}; this is a small loop of it.")


def _loop(layout: JobLayout, job: Job, remark: str) -> ReportFilm | None:
    from render.errors import InvalidFileError
    from render.loop import write_loop

    whole = [path for number, path in enumerate(committed_pictures(layout)) if int(path.stem) == number]
    pictures = whole[: job.frame_count]
    if not pictures:
        return None
    chosen = evenly_spread(pictures, LOOP_PICTURES)
    fps = (job.movie.playback_fps or job.fps) * len(chosen) / len(pictures)
    width = min(LOOP_WIDTH, job.render.resolution[0])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "film.webp")
        try:
            write_loop(chosen, path, fps=fps, width=width, loop_fps=min(fps, LOOP_FPS))
        except (InvalidFileError, ValueError) as error:
            raise PipelineError(f"cannot make a loop of the frames of {layout.root}: {error}") from error
        height = round(width * job.render.resolution[1] / job.render.resolution[0])
        return ReportFilm(path.read_bytes(), "image/webp", width, height, remark)
