"""Simulate: the world, frame by frame, into the HDF5 cache, with checkpoints to continue from.

Frames and checkpoints are written while the next frame is computed; see docs/decisions/0015-asynchronous-frames.md.
"""

import json
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pipeline.base.content import tool_version
from pipeline.base.errors import InvalidArtifactError, StageUnavailableError
from pipeline.base.files import make_folder, sync
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.kinds.base import Work
from pipeline.kinds.table import KINDS, bodies, world_of
from pipeline.model.job import Job
from pipeline.stages.base import FileWork, Stage, TaskContext
from pipeline.stages.inputs import by_content
from pipeline.stages.ordered_writer import WAITING, OrderedWriter
from pipeline.store.cache import (
    Checkpoint,
    read_checkpoint,
    read_numbers,
    validate_frame,
    write_checkpoint,
    write_frame,
)
from pipeline.store.provenance import read_text
from pipeline.store.receipts import read_receipt
from sim.core.runtime import DeviceUnavailableError, initialize, resolve_device
from sim.core.snapshots import Snapshot
from sim.core.solver import Grows, OutgrownError
from sim.core.world import FrameReport
from sim.scene import SceneParameters

CHECKPOINT_INTERVAL_S = 30.0
"""Wall time between checkpoints: what a crash costs at most, against well under 1 % of the time spent writing."""

CHECKPOINTS_KEPT = 2

SNAPSHOTS_AT_ONCE = 5 + WAITING
"""The one that is written, its file in memory and a copy of that, or what is read back of it, the ones that wait for
that, the newest before it finds a place in the queue, and what goes into its making."""
WORKER_BYTES = 800_000_000
"""Interpreter, compiler and the driver's share of the host's memory; an estimate, on the safe side."""

CPU_WORKER_BYTES = 360_000_000
"""The same of a simulation on the CPU, as measured without any body."""
COMPILER_BYTES_PER_S = 4e6
"""Memory of compiling, over the time that it takes."""
START_S = 5.0
"""Time of a worker's start, of building the world and of loading its kernels [s]."""


class SimulateStage(Stage):
    """One task for the whole job: it commits a frame at a time and continues where it stopped."""

    name = "simulate"
    about = "the physics, frame by frame"
    version = 29

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """The one task. The number of frames is not in its fingerprint: a longer film continues a shorter one."""
        return [
            Task(
                id=TaskId("simulate"),
                stage=self.name,
                inputs=(),
                outputs=tuple(layout.frame_cache(frame) for frame in range(job.frame_count)),
                parameters=self._parameters(job),
                resources=_resources(job),
                checkpointed=True,
                lowest_gpu=True,
            )
        ]

    def _parameters(self, job: Job) -> ParameterSet:
        """What decides the frames; a live recording was made once, by hand, and nothing makes another one of it."""
        if job.recorded is not None:
            return ParameterSet.of(stage=self.name, version=0, tools={}, fps=job.fps, recorded=job.recorded)
        # Jobs without joints or forces keep the frames that they had before there were any.
        later = {name for name in ("joint", "force") if not getattr(job, name)}
        scene = {name: getattr(job, name) for name in SceneParameters.model_fields if name not in later}
        bodies_by_content = {kind.name: [by_content(body) for body in kind.bodies(job)] for kind in KINDS.values()}
        tools = {name: tool_version(name) for name in ("taichi", "libigl", "numpy", "scipy", "trimesh")}
        return ParameterSet.of(
            scene | bodies_by_content, stage=self.name, version=self.version, tools=tools, fps=job.fps
        )

    def preflight(self, job: Job) -> list[str]:
        """A device that does not work here."""
        try:
            resolve_device(job.chosen_device)
        except DeviceUnavailableError as error:
            return [str(error)]
        return []

    def lighter(self, job: Job) -> str:
        """What every kind of body in the job says."""
        return " or ".join(kind.lighter for kind in KINDS.values() if kind.lighter and kind.bodies(job))

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:
        """What every kind of body in the job says."""
        there = [kind for kind in KINDS.values() if kind.bodies(job)]
        work, memory = Work(), float(WORKER_BYTES if on_gpu else CPU_WORKER_BYTES)
        for kind in there:
            count = elements.get(kind.name, 0.0)
            work = work.plus(kind.work(job, count, on_gpu))
            memory += 0.0 if on_gpu else kind.solver_bytes * count + COMPILER_BYTES_PER_S * kind.compiling_s
        what = "+".join(sorted({kind.method(body) or kind.name for kind in there for body in kind.bodies(job)}))
        return FileWork(what, work, START_S, max((kind.compiling_s for kind in there), default=0.0), memory)

    def run(self, context: TaskContext) -> None:
        """Compute the frames that are not committed yet.

        Raises:
            SimulationDivergedError: the state became unphysical; the last good checkpoint is kept.
            OutgrownError: a body grows beyond memory; a checkpoint of the last frame is kept.
            StageUnavailableError: the frames so far come from another kind of device, or from a recording.
        """
        missing = [k for k, output in enumerate(context.task.outputs) if not context.is_committed(output)]
        if missing and context.job.recorded is not None:
            raise _no_recording_anew(context, missing[0])
        if missing:
            _Simulation(context).run(missing)


def _no_recording_anew(context: TaskContext, frame: int) -> StageUnavailableError:
    job = context.job
    recorded_fps = _recorded_fps(context.layout, context.task.outputs[frame])
    if recorded_fps not in (None, job.fps):
        return StageUnavailableError(
            f"the recording {job.recorded} was recorded at {recorded_fps} frames a second, and the job asks for "
            f"{job.fps}: write fps = {recorded_fps} again; no computation can make other frames of a recording"
        )
    return StageUnavailableError(
        f"frame {frame} of the recording {job.recorded} is not there as it was recorded, and no computation can make "
        "it anew: bring its file and receipt back, or ask for fewer frames. To simulate the scene as it is written, "
        'remove "recorded" in a copy of the job file under another name; here that would overwrite the recording'
    )


def _recorded_fps(layout: JobLayout, frame: ArtifactPath) -> int | None:
    """Frames a second of what a frame's file was recorded with; None if nothing tells."""
    receipt = read_receipt(layout, frame)
    text = None if receipt is None else read_text(layout.parameters_text(receipt.parameters))
    return None if text is None else json.loads(text).get("fps")


class _Simulation:
    """One attempt at the simulation of a job."""

    def __init__(self, context: TaskContext) -> None:
        from sim.core.launch import on_compiled  # it loads Taichi, which plans need not

        self._context = context
        on_compiled(self._tell_compiling)
        self._folder = context.layout.checkpoints
        make_folder(self._folder, within=context.layout.root)
        self._device = initialize(context.job.chosen_device, threads=context.threads, gpu=context.gpu)
        self._world = world_of(context.job)
        for _, kind, body in bodies(context.job):
            if kind.growth is not None and isinstance(solver := self._world.solvers[body.name], Grows):
                solver.refusal = kind.growth(context.job)
        self._checkpointed_at = time.monotonic()
        self._last_checkpoint = -1

    def run(self, missing: Sequence[int]) -> None:
        """Advance to the last missing frame, and commit those that are missing on the way."""
        wanted, last = frozenset(missing), missing[-1]
        self._require_device_of_committed_frames(wanted)
        self._continue_from_checkpoint(before=missing[0])
        print(f"device {self._device}, starting at frame {self._world.frame}", flush=True)
        with OrderedWriter() as writer:
            if self._world.frame == 0:
                # Measured even where its file is there: the search for neighbours that this takes is not frame 1's.
                first = FrameReport(0, 0.0, {}, {}, self._world.diagnostics())
                if 0 in wanted:
                    writer.submit(partial(self._commit, first, self._world.snapshots()))
            while self._world.frame < last:
                if self._context.stop_requested():
                    break
                try:
                    report = self._world.advance_frame()
                except OutgrownError:  # the world is as it was, and goes on from here where there is more memory
                    self._hand_in_checkpoint(writer)
                    raise
                if report.frame in wanted:
                    writer.submit(partial(self._commit, report, self._world.snapshots()))
                self._context.progress(report.frame + 1, last + 1, _describe(report))
                if time.monotonic() - self._checkpointed_at > CHECKPOINT_INTERVAL_S:
                    self._hand_in_checkpoint(writer)
            self._hand_in_checkpoint(writer)

    def _tell_compiling(self, name: str, seconds: float) -> None:
        print(f"compiled {name} in {seconds:.1f} s", flush=True)
        self._context.progress(0, 1, "compiling kernels, once on this machine", preparing=True)

    def _commit(self, report: FrameReport, bodies: Mapping[str, Snapshot]) -> None:
        with (
            _saying(f"while frame {report.frame} was written"),
            self._context.committing(self._context.task.outputs[report.frame], validate_frame) as path,
        ):
            write_frame(path, bodies, report, device=self._device, longest_shutter_s=1.0 / self._context.job.fps)

    def _require_device_of_committed_frames(self, missing: Collection[int]) -> None:
        """Devices differ in their rounding, and the flow amplifies that: their frames do not fit together."""
        outputs = self._context.task.outputs
        first = next((output for frame, output in enumerate(outputs) if frame not in missing), None)
        if first is not None:
            device = read_numbers(self._context.layout.path(first), only=()).device
            if device != self._device:
                raise self._another_device(device)

    def _another_device(self, device: str) -> StageUnavailableError:
        return StageUnavailableError(
            f"this job was simulated on {device} so far, and this machine offers {self._device}; "
            f'continue where {device} is, or set device = "{self._device}" to start anew'
        )

    def _continue_from_checkpoint(self, *, before: int) -> None:
        """Restore the newest checkpoint of this fingerprint from before a frame; else start at frame 0."""
        for path in sorted(self._folder.glob("[0-9]*.h5"), reverse=True):
            try:
                checkpoint = read_checkpoint(path)
            except InvalidArtifactError as error:
                print(f"ignoring a damaged checkpoint: {error}", flush=True)
                path.unlink()
                continue
            if checkpoint.fingerprint != self._context.fingerprint:
                path.unlink()
                continue
            if checkpoint.device != self._device:
                raise self._another_device(checkpoint.device)
            if checkpoint.frame < before:
                self._world.restore(checkpoint.frame, checkpoint.arrays)
                self._last_checkpoint = checkpoint.frame
                return

    def _hand_in_checkpoint(self, writer: OrderedWriter) -> None:
        """Have the present state saved, after all frames so far: one that was ahead of them would lose them."""
        self._checkpointed_at = time.monotonic()
        frame = self._world.frame
        if frame not in (0, self._last_checkpoint):
            self._last_checkpoint = frame
            writer.submit(partial(self._save_checkpoint, frame, self._world.checkpoint()))

    def _save_checkpoint(self, frame: int, arrays: Mapping[str, NDArray[np.generic]]) -> None:
        """Write aside, decode, rename; then drop older ones but the newest two.

        Later ones, left by a run that had come further, stay: they are of the same fingerprint.
        """
        path = self._folder / f"{frame:06d}.h5"
        part = self._folder / f".{path.name}.part.{self._context.attempt}"
        try:
            with _saying(f"while the checkpoint of frame {frame} was written"):
                write_checkpoint(part, Checkpoint(frame, self._context.fingerprint, self._device, arrays))
                read_checkpoint(part)
                sync(part)
            part.replace(path)
            sync(self._folder)
        finally:
            # Half a checkpoint would keep a full disk full.
            part.unlink(missing_ok=True)
        so_far = sorted(each for each in self._folder.glob("[0-9]*.h5") if each.name <= path.name)
        for old in so_far[:-CHECKPOINTS_KEPT]:
            old.unlink()


@contextmanager
def _saying(note: str) -> Iterator[None]:
    """Give errors a note: by the time that the computing thread raises them it is some frames ahead."""
    try:
        yield
    except Exception as error:
        error.add_note(note)
        raise


def _resources(job: Job) -> Resources:
    """All cores where the CPU computes, so that it runs alone; where the GPU does, that, one core and the frames' room.

    A device that does not work here is planned all the same; preflight reports it.
    """
    chosen = job.chosen_device
    device = resolve_device(chosen) if chosen == "auto" else chosen
    memory_bytes = WORKER_BYTES + SNAPSHOTS_AT_ONCE * _snapshot_bytes(job)
    return Resources(cores=0) if device == "cpu" else Resources(cores=1, memory_bytes=memory_bytes, gpus=1)


def _snapshot_bytes(job: Job) -> int:
    """What a snapshot or a checkpoint takes: an upper bound."""
    return ceil(sum(kind.snapshot_bytes[0] * kind.elements(job, body) for _, kind, body in bodies(job)))


def _describe(report: FrameReport) -> str:
    substeps = ", ".join(f"{name} {count} substeps" for name, count in report.substeps.items())
    return f"frame {report.frame}: {substeps}"
