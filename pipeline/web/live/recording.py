"""Recordings: frames of a running scene as the simulated frames of a job of its own, rendered as any other.

The job's file names the recording in `recorded`, which its simulation's fingerprint depends on alone. So frames are
receipted as simulated ones are, every later stage finds them, and nothing ever simulates over them or claims to.
"""

import json
import shlex
import sqlite3
import uuid
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipeline.base.errors import LeaseLostError, PipelineError
from pipeline.base.files import replace_durably
from pipeline.base.layout import JobLayout
from pipeline.base.lease import Lease
from pipeline.base.task import task_fingerprint
from pipeline.job.loading import LoadedJob, job_of_text
from pipeline.job.overrides import Override
from pipeline.kinds.live_parameters import Value
from pipeline.record.manifest import Manifest
from pipeline.record.reconcile import reconcile
from pipeline.run.executors.failures import describe, is_out_of_memory
from pipeline.stages.ordered_writer import OrderedWriter
from pipeline.stages.simulate import SimulateStage
from pipeline.store.artifacts import committing
from pipeline.store.cache import validate_frame, write_frame
from pipeline.store.provenance import maker
from pipeline.web.live.saving import bodies_led_before, numbered_paths, text_with_values
from pipeline.web.live.session import Session
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

_TROUBLES = (OSError, PipelineError, MemoryError, RuntimeError, sqlite3.Error)
"""Errors of writing a recording: the disk, a folder that another process uses, too little memory, HDF5, a lost writer,
the record."""


class Recorder:
    """A recorder of a session: each recording has a folder NAME-take, NAME-take-2, ... of its own.

    `became` is the outcome of the last one that has ended, "" before.
    """

    def __init__(self, loaded: LoadedJob, session: Session, output: Path, *, device: str) -> None:
        self.loaded, self._session, self._output, self._device = loaded, session, output, device
        self._recording: _Recording | None = None
        self.became = ""
        session.on_jump = self.stop

    @property
    def is_recording(self) -> bool:
        """Whether it records."""
        return self._recording is not None

    def toggle(self) -> bool:
        """Begin a recording with the present frame, or end it; returns whether it records.

        Raises PipelineError, OSError: its folder cannot be made.
        """
        if self._recording is not None:
            self.stop()
            return False
        world = self._session.world
        self._recording = _Recording(self.loaded, self._session, self._output, device=self._device)
        self._session.message = f"recording into {self._recording.layout.root}"
        now = FrameReport(world.frame, world.time_s, {}, {}, world.diagnostics())
        self._session.on_frame = self._add
        self._add(now, self._session.bodies())
        return self.is_recording

    def stop(self) -> None:
        """End the recording, if there is one, and say how to go on with it."""
        self._stop(trouble="")

    def _stop(self, *, trouble: str) -> None:
        """As `stop`; `trouble` is why it ends before anybody wants it, "" if it does not.

        An error of writing is told instead: it is the same, or where the trouble comes from.
        """
        recording, self._recording = self._recording, None
        self._session.on_frame = None
        is_taken_over = False
        if recording is None:
            return
        try:
            recording.end()
        except _TROUBLES as error:
            trouble, is_taken_over = _told(error), isinstance(error, LeaseLostError) and not recording.is_told
        frames = "1 frame" if recording.frames == 1 else f"{recording.frames} frames"
        if recording.frames and is_taken_over:
            # Their fate is for whoever has the folder now, which may have been taken over before the last.
            folder = recording.layout.path(recording.layout.frame_cache(0)).parent
            became = f"{frames} {'is' if recording.frames == 1 else 'are'} in {folder}"
        elif recording.frames and not recording.is_told and recording.frames != 1:
            # Submitting finds them, as after a crash.
            became = f"{recording.layout.job_file} has 1 frame yet; submitting it takes over what is there, {frames}"
        elif recording.frames:
            became = f"{frames}: pipeline submit {shlex.quote(str(recording.layout.job_file))}"
        else:
            became = f"none of its frames is in {recording.layout.root}"
        self.became = f"the recording ends early: {trouble}; {became}" if trouble else became
        self._session.message = self.became

    def _add(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        if self._recording is None:
            return
        try:
            self._recording.add(report, bodies)
        except _TROUBLES as error:
            self._stop(trouble=_told(error))


class _Recording:
    """A recording on its way to the disk. It holds its folder's lease: nobody runs a job whose frames still come.

    Attributes:
        frames: number of committed ones; the writer's thread counts them.
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
            Manifest(self.layout.manifest).close()  # without a record, commands do not know the folder as a job's
            job = job_of_text(self._text(frames=1), self.layout.job_file)
            self._dt = 1.0 / job.fps
            (self._task,) = SimulateStage().plan(job, self.layout)
            self._fingerprint = task_fingerprint(self._task, {})
            self._writer = OrderedWriter()
            self._writer.__enter__()
            self._held = held.pop_all()

    def add(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        """Have a frame written; waits while another one waits. Raises LeaseLostError."""
        self._lease.check()
        mine = replace(report, frame=self._handed_in, time_s=self._handed_in * self._dt)
        self._writer.submit(partial(self._commit, mine, bodies))
        self._handed_in += 1

    def end(self) -> None:
        """Wait for all frames, and write the job of those that were committed, also if one could not be.

        A lease that did not answer for long may be ours still: the frames are named then, and the loss is told.

        Raises OSError, PipelineError, RuntimeError, sqlite3.Error: something of it could not be written.
        """
        with self._held:
            try:
                self._writer.__exit__(None, None, None)
            finally:
                self._write_result()
            self._lease.check()

    def _write_result(self) -> None:
        self._lease.heartbeat()  # raises if the folder is not ours any more
        self._write_job(frames=max(1, self.frames))  # no job has none
        self.is_told = True
        self._write_story(frames=self.frames, last=dict(self._session.values))
        with Manifest(self.layout.manifest) as manifest:
            reconcile(manifest, self.layout, clean=False)

    def _write_story(self, *, frames: int | None, last: dict[str, Value] | None) -> None:
        """Write the recording's story; None while it goes on, and for good if this process crashes."""
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
        replace_durably(self.layout.recording_story, json.dumps(story, indent=2, ensure_ascii=False) + "\n")

    def _led(self) -> list[str]:
        """Bodies that the job has at rest, and that could be led here."""
        lived = zip(self._loaded.job.rigid, self._session.job.rigid, strict=True)
        here = [written.name for written, led in lived if written.kind != led.kind]
        return [*(bodies_led_before(self._loaded) or ()), *here]

    def _commit(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        """Write a frame into the folder. Raises LeaseLostError: it is another process's, which counts its frames."""
        self._lease.heartbeat()  # which asks now, as this process may have stood still since the last time
        with committing(
            self.layout,
            self.layout.frame_cache(report.frame),
            task=self._task,
            attempt=1,
            fingerprint=self._fingerprint,
            validate=validate_frame,
        ) as commit:
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
        both = zip(job.rigid, self._session.job.rigid, strict=True)
        led = {written.table: lived.kind for written, lived in both if written.kind != lived.kind}
        changes += [(("rigid", table, "kind"), kind) for table, kind in led.items()]
        overrides = [Override(path, value, "live") for path, value in changes]
        return text_with_values(self._loaded, self._session.values, overrides)


def _told(error: BaseException) -> str:
    """An error in a few words: what is no sentence by itself, such as a lack of memory, with its name."""
    return describe(error) if is_out_of_memory(error) else str(error)


def _new_folder(output: Path, stem: str) -> Path:
    """A folder that nobody has, made. Raises OSError: it cannot be made."""
    for folder in numbered_paths(output, stem):
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise AssertionError("numbers do not end")
