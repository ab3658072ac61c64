"""The film of a job as the report holds it: itself where it is small enough and browsers play it, else a small loop."""

from base64 import b64encode
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from pipeline.base.errors import PipelineError
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.model.job import Job
from pipeline.show.picture_set import evenly_spread
from pipeline.store.receipts import read_receipt
from render.errors import InvalidFileError
from render.loop import write_loop
from render.temporary_folder import temporary_folder

MOST_BYTES = 24 << 20  # of a film that is put into the page: a browser holds the page in memory, a third larger as text
PLAYABLE = frozenset({"h264", "av1"})  # codecs that the usual browsers play; H.265 and ProRes are not among them
LOOP_PICTURES, LOOP_WIDTH, LOOP_FPS = 90, 640, 15.0


@dataclass(frozen=True)
class ReportFilm:
    """A film as the report shows it."""

    content: bytes
    mime: str
    width: int
    height: int
    remark: str = ""  # why it is not the film itself, or not that of the job as it is now; empty if it is


def as_address(content: bytes, mime: str) -> str:
    """An address that holds a picture or a film."""
    return f"data:{mime};base64,{b64encode(content).decode()}"


def film_of(
    layout: JobLayout, job: Job, *, current: Set[ArtifactPath] | None, pictures: Sequence[Path]
) -> ReportFilm | None:
    """The film that was committed; None before there is one.

    `current` are the files of the job as it is now (None: that cannot be told); of `pictures`, frames that were made
    alike, from the first on, a loop is made where one is needed. Raises PipelineError if one of them is damaged then.
    """
    path = layout.film
    artifact = ArtifactPath(path.relative_to(layout.root).as_posix())
    if read_receipt(layout, artifact) is None or not path.is_file():
        return None
    remark = ""
    if current is None:
        remark = f"Whether {path.name} is of the job as it is now cannot be told."
    elif artifact not in current:
        remark = f"{path.name} is of an earlier version of the job."
    width, height = job.render.resolution
    size = path.stat().st_size
    if job.movie.codec in PLAYABLE and size <= MOST_BYTES:
        return ReportFilm(path.read_bytes(), "video/mp4", width, height, remark)
    why = f"too large for this page, {size / 1e6:.0f} MB" if job.movie.codec in PLAYABLE else "not played by browsers"
    told = f"{path.name} is {why}; this is a small loop of the job's frames."
    return _loop(layout, job, pictures, " ".join(filter(None, [remark, told])))


def _loop(layout: JobLayout, job: Job, pictures: Sequence[Path], remark: str) -> ReportFilm | None:
    if not pictures:
        return None
    chosen = evenly_spread(pictures, LOOP_PICTURES)
    fps = (job.movie.playback_fps or job.fps) * len(chosen) / len(pictures)
    width = min(LOOP_WIDTH, job.render.resolution[0])
    with temporary_folder("report") as folder:
        path = folder / "film.webp"
        try:
            write_loop(chosen, path, fps=fps, width=width, loop_fps=min(fps, LOOP_FPS))
        except (InvalidFileError, ValueError) as error:
            raise PipelineError(f"cannot make a loop of the frames of {layout.root}: {error}") from error
        height = round(width * job.render.resolution[1] / job.render.resolution[0])
        return ReportFilm(path.read_bytes(), "image/webp", width, height, remark)
