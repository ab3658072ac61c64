"""`pipeline live`, put together: the scene in this thread, its page beside it, and the loop between them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.errors import PipelineError, StageUnavailableError
from pipeline.job.loading import LoadedJob
from pipeline.model.job import Job
from pipeline.run.executors.failures import describe, is_out_of_memory
from pipeline.web.live.recording import Recorder
from pipeline.web.live.requests import CannotGoOnError
from pipeline.web.live.session import Session
from pipeline.web.serving import address, in_its_loop, page_server

if TYPE_CHECKING:
    from pipeline.web.live.page import LivePage

SHOWN_EVERY_S = 1.0 / 30.0
"""Least time between two pictures of a page, on average."""
TOLD_EVERY_S = 0.2
BUILDING = "**The scene is being built: some seconds, the first time on a machine up to a minute.**"
LONGEST_WAIT_S = 0.05
"""Longest wait for requests and the end, while time stands still or is slow."""


def show_live(
    loaded: LoadedJob,
    job: Job,
    *,
    host: str,
    port: int,
    gave_up: bool,
    longest_frame_s: float,
    output: Path,
    folder: Path,
    threads: int | None,
    paused: bool,
    say: Callable[[str], None],
    ends: Callable[[], bool],
) -> None:
    """Run a scene until it `ends`, and show it.

    Args:
        loaded, job: the job as it was read, and as it is simulated (`live_job`).
        gave_up: whether live changed the job for the sake of speed.
        longest_frame_s: a frame that takes longer counts as blown up [s].
        output, folder: where recordings become jobs' folders, and where jobs are saved.
        threads: of the processor; None for all.
        paused: begin standing still.
        say: prints a line: the page's address, and the outcome of a recording that goes on at the end.
        ends: whether it is over.

    Raises:
        PipelineError: the port is taken, the scene cannot be built, or there is too little memory for it and its page.
    """
    from sim.core.runtime import DeviceUnavailableError, initialize
    from sim.shapes.solid import ShapeError

    with _memory_told(job), page_server(host=host, port=port, label=job.name) as server:
        say(f"{address(server)} runs {job.name}; Ctrl-C ends it")
        waiting = in_its_loop(server, server.gui.add_markdown, BUILDING)
        from pipeline.web.live.page import LivePage

        try:
            device = initialize(job.chosen_device, threads=threads)
            session = Session(job, written=loaded.job, gave_up=gave_up, longest_frame_s=longest_frame_s)
            session.ends = ends
        except DeviceUnavailableError as error:
            raise StageUnavailableError(str(error)) from error
        except (ShapeError, ValueError) as error:
            raise PipelineError(f"{job.name}: {error}") from error
        session.is_paused = paused
        recorder = Recorder(loaded, session, output, device=device)
        in_its_loop(server, waiting.remove)
        page = in_its_loop(server, LivePage, server, session, recorder, folder)
        try:
            with _memory_told(job):
                run(session, page, ends=ends)
        except CannotGoOnError as error:
            recorder.stop()
            if recorder.became:
                raise CannotGoOnError(f"{error}; {recorder.became}") from error
            raise
        finally:
            if recorder.is_recording:
                recorder.stop()
                say(session.message)


@contextmanager
def _memory_told(job: Job) -> Iterator[None]:
    """Tell too little memory as a line. Raises CannotGoOnError then."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise CannotGoOnError(f"{job.name} cannot go on, as no memory is left: {describe(error)}") from error


# --- the loop ---


def run(session: Session, page: LivePage, *, ends: Callable[[], bool]) -> None:
    """Run a session until it `ends`: in real time, or as fast as it gets where that is slower.

    Lost time is not made up for. Where there is no memory to meet a request or to show the scene, the scene goes back;
    a second time, before the page was told, that would help no more.

    Raises:
        CannotGoOnError: there is no memory for the scene.
        MemoryError, RuntimeError: there is none for the page, or what was asked for, either.
    """
    due = show_due = told_at = time.perf_counter()
    shown, was_told, trouble = (-1, -1), True, ""
    while not ends():
        if trouble:  # not within the handler: an error's traceback would keep the old scene
            session.free_memory(trouble)
            was_told, trouble = False, ""
        try:
            now = time.perf_counter()
            session.meet_requests(0.0 if not session.is_paused and now >= due else _wait(session, now, due))
            now = time.perf_counter()
            if not session.is_paused and now >= due:
                session.advance()
                due = max(due + session.dt / session.speed, time.perf_counter())
            now = time.perf_counter()
            moment = (session.revision, session.world.frame)
            if moment != shown and now >= show_due:
                page.show()
                # Not so long after this: of frames that take two thirds of that time, only every other would be seen.
                shown, show_due = moment, max(show_due + SHOWN_EVERY_S, now)
            if now - told_at >= TOLD_EVERY_S:
                page.tell()
                told_at, was_told = now, True
        except (MemoryError, RuntimeError) as error:
            if not (was_told and is_out_of_memory(error)):
                raise
            trouble = describe(error)


def _wait(session: Session, now: float, due: float) -> float:
    return LONGEST_WAIT_S if session.is_paused else min(LONGEST_WAIT_S, max(due - now, 1e-4))
