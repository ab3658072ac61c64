"""Small scenes that run live, their sessions, recorders and pages."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import viser
from click.testing import Result
from command_line import pipeline

from pipeline.job.loading import LoadedJob, read_job
from pipeline.web.live.admission import live_job
from pipeline.web.live.page import LivePage
from pipeline.web.live.recording import Recorder
from pipeline.web.live.session import Session
from pipeline.web.live.soundness import LONGEST_FRAME_S
from pipeline.web.serving import in_its_loop, page_server

BALL_OVER_SHEET = """\
name = "drape"
# what nobody may lose: a remark
[domain]
open_faces = ["x-", "x+", "y-", "y+", "z+"]

[[rigid]]
name = "ball"
kind = "dynamic"
density = 500.0
shape = { type = "sphere", radius = 0.08 }
position = [0.0, 0.0, 0.62]

[[rigid]]
name = "post"
shape = { type = "box", size = [0.05, 0.05, 0.1] }
position = [0.4, 0.0, 0.05]

[[cloth]]
name = "sheet"
shape = { type = "rectangle", size = [0.4, 0.4], counts = [17, 17] }
position = [0.0, 0.0, 0.5]
stretch_stiffness = 500.0   # soft
thickness = 4e-3
substeps = 8
[[cloth.pin]]
edge = "y-"
[[cloth.pin]]
edge = "y+"
"""


def loaded(folder: Path, text: str = BALL_OVER_SHEET) -> LoadedJob:
    path = folder / "drape.toml"
    path.write_text(text)
    return read_job(path)


def live(folder: Path, *options: object) -> Result:
    """What `pipeline live` of the ball over a sheet printed, and its exit code."""
    return pipeline("live", loaded(folder).path, "--port", 0, "--farm", folder, *options)


def session_of(folder: Path, text: str = BALL_OVER_SHEET) -> Session:
    return Session(live_job(loaded(folder, text).job))


def recording(folder: Path, output: Path | None = None, text: str = BALL_OVER_SHEET) -> tuple[Session, Recorder]:
    """A session and its recorder, which records into the folder itself if no other one is named."""
    read = loaded(folder, text)
    session = Session(live_job(read.job))
    recorder = Recorder(read, session, output or folder, device="cpu")
    recorder.toggle()
    return session, recorder


def page_of(server: viser.ViserServer, read: LoadedJob, session: Session, folder: Path) -> LivePage:
    """The page of a session that saves jobs and records into a folder."""
    recorder = Recorder(read, session, folder / "renders", device="cpu")
    return in_its_loop(server, LivePage, server, session, recorder, folder)


@contextmanager
def served(
    folder: Path, text: str, *, longest_frame_s: float = LONGEST_FRAME_S
) -> Iterator[tuple[Session, LivePage, viser.ViserServer]]:
    """A session that stands still, its page and the server."""
    read = loaded(folder, text)
    session = Session(live_job(read.job), longest_frame_s=longest_frame_s)
    session.advance()  # kernels
    session.reset()
    session.is_paused = True
    with page_server() as server:
        yield session, page_of(server, read, session, folder), server
