"""`pipeline live`, put together: the scene in this thread, its page beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pipeline.errors import PipelineError, StageUnavailableError
from pipeline.executors.failures import describe, is_out_of_memory
from pipeline.live.loop import run
from pipeline.live.saving import save_job
from pipeline.live.session import CannotGoOnError, Session
from pipeline.live.take import Recorder
from pipeline.view.serving import address as address_of
from pipeline.view.serving import page_server

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from pipeline.job.models import Job


class Address(NamedTuple):
    """Where a page is."""

    host: str
    port: int


def show_live(
    loaded: LoadedJob,
    job: Job,
    address: Address,
    *,
    gave_up: bool,
    patience_s: float,
    output: Path,
    folder: Path,
    threads: int | None,
    paused: bool,
    say: Callable[[str], None],
    tell: Callable[[str], None],
    ends: Callable[[], bool],
) -> None:
    """Run a scene until it `ends`, and show it.

    Args:
        loaded: the job as it was read.
        job: as it is simulated, `pipeline.live.scene.live_job`.
        address: to listen at.
        gave_up: whether live changed the job for the sake of speed.
        patience_s: a frame that takes longer counts as blown up [s].
        output: where recordings become jobs' folders.
        folder: where jobs are saved.
        threads: of the processor; all if omitted.
        paused: begin standing still.
        say: is told the page's address.
        tell: is told what became of a take that was being made at the end.
        ends: whether it is over.

    Raises:
        PipelineError: the port is taken, the scene cannot be built, or there is too little memory for it and its page.
    """
    from sim.runtime import DeviceUnavailableError, initialize
    from sim.shapes.solid import ShapeError

    with _memory_told(job), page_server(host=address.host, port=address.port, label=job.name) as server:
        from pipeline.live.page import LivePage

        try:
            device = initialize(job.device, threads=threads)
            session = Session(job, written=loaded.job, gave_up=gave_up, patience_s=patience_s)
            session.ends = ends
        except DeviceUnavailableError as error:
            raise StageUnavailableError(str(error)) from error
        except (ShapeError, ValueError) as error:
            raise PipelineError(f"{job.name}: {error}") from error
        session.is_paused = paused
        recorder = Recorder(loaded, session, output, device=device)
        page = LivePage(
            server,
            session,
            save=lambda: save_job(loaded, session.values, folder),
            recorder=recorder,
            written=loaded.job,
        )
        say(address_of(server))
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
                tell(session.message)


@contextmanager
def _memory_told(job: Job) -> Iterator[None]:
    """Too little memory as a line. Raises CannotGoOnError then."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise CannotGoOnError(f"{job.name} cannot go on, as no memory is left: {describe(error)}") from error
