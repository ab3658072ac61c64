"""Takes: what happens in a session, as the simulated frames of a job of its own, which then is rendered as any other.

The job's file names the take in `recorded`, and its simulation's fingerprint is the take's. So frames are receipted
as simulated ones are, every later stage finds them, and nothing ever simulates over them or claims that it could.
"""

from __future__ import annotations

import json
import shlex
import sqlite3
import uuid
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.artifacts import committing
from pipeline.cache import validate_frame, write_frame
from pipeline.errors import LeaseLostError, PipelineError
from pipeline.executors.failures import describe, is_out_of_memory
from pipeline.files import replace_durably
from pipeline.fingerprint import task_fingerprint
from pipeline.job.loading import job_of_text
from pipeline.job.overrides import Override
from pipeline.layout import JobLayout
from pipeline.lease import Lease
from pipeline.live.knobs import Value
from pipeline.live.saving import bodies_led_before, numbered_paths, text_with_values
from pipeline.live.session import Session
from pipeline.manifest import Manifest
from pipeline.provenance import maker
from pipeline.reconcile import reconcile
from pipeline.stages.ordered_writer import OrderedWriter
from pipeline.stages.simulate import SimulateStage
from sim.world import FrameReport

if TYPE_CHECKING:
    from pipeline.job.loading import LoadedJob
    from sim.snapshots import Snapshot

_TROUBLES = (OSError, PipelineError, MemoryError, RuntimeError, sqlite3.Error)
"""What writing a take may meet: the disk, a folder that somebody else uses, too little memory, HDF5, a lost writer, the
record."""


class Recorder:
    """Records a session, take after take, each into a folder NAME-take, NAME-take-2, ... of its own.

    Attributes:
        became: what became of the last take that has ended, "" before.

    Args:
        loaded: the job that is played with, as it was read.
        session: the scene.
        output: where jobs' folders lie.
        device: that computes the frames.
    """

    def __init__(self, loaded: LoadedJob, session: Session, output: Path, *, device: str) -> None:
        self._loaded, self._session, self._output, self._device = loaded, session, output, device
        self._take: _Take | None = None
        self.became = ""
        session.on_jump = self.stop

    @property
    def is_recording(self) -> bool:
        """Whether a take is being made."""
        return self._take is not None

    def toggle(self) -> bool:
        """Begin a take with the frame that is there now, or end it; returns whether one is being made.

        Raises:
            PipelineError, OSError: its folder cannot be made.
        """
        if self._take is not None:
            self.stop()
            return False
        world = self._session.world
        self._take = _Take(self._loaded, self._session, self._output, device=self._device)
        self._session.message = f"recording into {self._take.layout.root}"
        now = FrameReport(world.frame, world.time_s, {}, {}, world.diagnostics())
        self._session.on_frame = self._add
        self._add(now, self._session.bodies())
        return self.is_recording

    def stop(self) -> None:
        """End the take, if one is being made, and say how to go on with it."""
        self._stop(trouble="")

    def _stop(self, *, trouble: str) -> None:
        """As `stop`; `trouble` is why the take ends before anybody wants it, "" if it does not.

        What writing meets is told instead: it is the same, or where the trouble comes from.
        """
        take, self._take = self._take, None
        self._session.on_frame = None
        is_taken_over = False
        if take is None:
            return
        try:
            take.end()
        except _TROUBLES as error:
            trouble, is_taken_over = _told(error), isinstance(error, LeaseLostError) and not take.is_told
        frames = "1 frame" if take.frames == 1 else f"{take.frames} frames"
        if take.frames and is_taken_over:
            # What becomes of them is for whoever has the folder now: they may have been taken over before the last.
            folder = take.layout.path(take.layout.frame_cache(0)).parent
            became = f"{frames} {'is' if take.frames == 1 else 'are'} in {folder}"
        elif take.frames and not take.is_told and take.frames != 1:
            # Which submitting finds, as after a crash.
            became = f"{take.layout.job_file} has 1 frame yet; submitting it takes over what is there, {frames}"
        elif take.frames:
            became = f"{frames}: pipeline submit {shlex.quote(str(take.layout.job_file))}"
        else:
            became = f"none of its frames is in {take.layout.root}"
        self.became = f"the take ends early: {trouble}; {became}" if trouble else became
        self._session.message = self.became

    def _add(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        if self._take is None:
            return
        try:
            self._take.add(report, bodies)
        except _TROUBLES as error:
            self._stop(trouble=_told(error))


class _Take:
    """One take on its way to the disk. It holds its folder's lease: nobody runs a job whose frames are still to come.

    Attributes:
        layout: its folder.
        frames: how many are committed; the writer's thread counts them.
        is_told: whether its job file has them all: not until the end, nor where nothing could be written then.
    """

    def __init__(self, loaded: LoadedJob, session: Session, output: Path, *, device: str) -> None:
        self._loaded, self._session, self._device = loaded, session, device
        self._name = f"live-{uuid.uuid4().hex[:12]}"
        self.layout = JobLayout(_new_folder(output, f"{loaded.job.name}-take"))
        self.frames = self._handed_in = 0
        self.is_told = False
        self._values = dict(session.values)
        with ExitStack() as held:
            self._lease = held.enter_context(Lease.acquire(self.layout.lease))
            self._write_job(frames=1)
            self._write_story(frames=None, last=None)
            Manifest(self.layout.manifest).close()  # without a record, commands take the folder for none of a job's
            job = job_of_text(self._text(frames=1), self.layout.job_file)
            self._dt = 1.0 / job.fps
            (self._task,) = SimulateStage().plan(job, self.layout)
            self._fingerprint = task_fingerprint(self._task, {})
            self._writer = OrderedWriter()
            self._writer.__enter__()
            self._held = held.pop_all()

    def add(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        """Have a frame written; waits while another one waits.

        Raises:
            LeaseLostError: the folder is another process's now.
        """
        self._lease.check()
        mine = replace(report, frame=self._handed_in, time_s=self._handed_in * self._dt)
        self._writer.submit(partial(self._commit, mine, bodies))
        self._handed_in += 1

    def end(self) -> None:
        """Wait for all frames, and write what the take is: of those that were committed, also if one could not be.

        A lease that did not answer for long may be ours still: the frames are named then, and the loss is told.

        Raises:
            OSError, PipelineError, RuntimeError, sqlite3.Error: something of it could not be written.
        """
        with self._held:
            try:
                self._writer.__exit__(None, None, None)
            finally:
                self._write_what_it_is()
            self._lease.check()

    def _write_what_it_is(self) -> None:
        self._lease.heartbeat()  # raises if the folder is not ours any more
        self._write_job(frames=max(1, self.frames))  # no job has none
        self.is_told = True
        self._write_story(frames=self.frames, last=dict(self._session.values))
        with Manifest(self.layout.manifest) as manifest:
            reconcile(manifest, self.layout, clean=False)

    def _write_story(self, *, frames: int | None, last: dict[str, Value] | None) -> None:
        """Tell what the take is; None while it is recorded, and for good if this process crashes."""
        story = {
            "take": self._name,
            "job": self._loaded.job.name,
            "frames": frames,
            "device": self._device,
            "maker": maker(),
            "values": {"first": self._values, "last": last},
            "led": self._led(),
            "note": "Steered by hand: no job file makes these frames again.",
        }
        replace_durably(self.layout.take_story, json.dumps(story, indent=2, ensure_ascii=False) + "\n")

    def _led(self) -> list[str]:
        """Bodies that the job has at rest, and that could be led here."""
        lived = zip(self._loaded.job.rigid, self._session.job.rigid, strict=True)
        here = [written.name for written, led in lived if written.kind != led.kind]
        return [*(bodies_led_before(self._loaded) or ()), *here]

    def _commit(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        """Write a frame into the folder, if that is ours: its frames may have been counted by another process.

        Raises:
            LeaseLostError: it is another process's now.
        """
        self._lease.heartbeat()  # which asks now, as this process may have stood still since the last time
        commit = committing(
            self.layout,
            self.layout.frame_cache(report.frame),
            task=self._task,
            attempt=1,
            fingerprint=self._fingerprint,
            validate=validate_frame,
        )
        with commit:
            write_frame(commit.path, bodies, report, device=self._device)
        self.frames += 1

    def _write_job(self, *, frames: int) -> None:
        replace_durably(self.layout.job_file, self._text(frames=frames))

    def _text(self, *, frames: int) -> str:
        """The job with the present values, and bodies as they could be moved: the renderer asks the frames for them."""
        job = self._loaded.job
        length = ("duration", frames / job.fps) if job.duration is not None else ("frames", frames)
        changes: list[tuple[tuple[str | int, ...], object]] = [
            (("name",), self.layout.root.name),
            (("recorded",), self._name),
            ((length[0],), length[1]),
        ]
        for number, (written, lived) in enumerate(zip(job.rigid, self._session.job.rigid, strict=True)):
            if written.kind != lived.kind:
                changes.append((("rigid", number, "kind"), lived.kind))
        overrides = [Override(path, value, "live") for path, value in changes]
        return text_with_values(self._loaded, self._session.values, overrides)


def _told(error: BaseException) -> str:
    """An error in a few words: what is no sentence by itself, such as a lack of memory, with its name."""
    return describe(error) if is_out_of_memory(error) else str(error)


def _new_folder(output: Path, stem: str) -> Path:
    """A folder that nobody has, made.

    Raises:
        OSError: it cannot be made.
    """
    for folder in numbered_paths(output, stem):
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise AssertionError("numbers do not end")
