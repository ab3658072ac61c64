"""`pipeline live`, put together: the scene in this thread, its page beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.errors import PipelineError, StageUnavailableError
from pipeline.run.executors.failures import describe, is_out_of_memory
from pipeline.web.live.loop import run
from pipeline.web.live.recording import Recorder
from pipeline.web.live.requests import CannotGoOnError
from pipeline.web.live.session import Session
from pipeline.web.serving import address, page_server

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.model.job import Job


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
        loaded: the job as it was read.
        job: as it is simulated, `pipeline.web.live.admission.live_job`.
        host, port: address to listen at.
        gave_up: whether live changed the job for the sake of speed.
        longest_frame_s: a frame that takes longer counts as blown up [s].
        output: where recordings become jobs' folders.
        folder: where jobs are saved.
        threads: of the processor; all if omitted.
        paused: begin standing still.
        say: prints a line: the page's address, and the outcome of a recording that goes on at the end.
        ends: whether it is over.

    Raises:
        PipelineError: the port is taken, the scene cannot be built, or there is too little memory for it and its page.
    """
    from sim.core.runtime import DeviceUnavailableError, initialize
    from sim.shapes.solid import ShapeError

    with _memory_told(job), page_server(host=host, port=port, label=job.name) as server:
        from pipeline.web.live.page import LivePage

        try:
            device = initialize(job.device, threads=threads)
            session = Session(job, written=loaded.job, gave_up=gave_up, longest_frame_s=longest_frame_s)
            session.ends = ends
        except DeviceUnavailableError as error:
            raise StageUnavailableError(str(error)) from error
        except (ShapeError, ValueError) as error:
            raise PipelineError(f"{job.name}: {error}") from error
        session.is_paused = paused
        recorder = Recorder(loaded, session, output, device=device)
        page = LivePage(server, session, recorder, folder)
        say(f"{address(server)} runs {job.name}; Ctrl-C ends it")
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
