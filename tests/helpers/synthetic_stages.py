"""A small pipeline without physics: steps -> double -> film, whose bytes depend on the job and on nothing else.

`steps` is like the simulation: one long task, an artifact a frame, each computed from the one before, checkpoints to
continue from. `double` is like rendering: a frame each. `film` reads them all.

Faults are put into `faults.json` of the job's folder, by task id: `{"double/000003": ["segfault"]}`. Each attempt takes
the first of its list; they are no part of any fingerprint.
"""

# ruff: noqa: ARG002 - the signatures are the protocol's

from __future__ import annotations

import ctypes
import errno
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from blake3 import blake3

from pipeline.base.errors import InvalidArtifactError
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Resources, Task, TaskId
from pipeline.stages.base import Stage
from render.blender import BlenderDiedError

if TYPE_CHECKING:
    from pipeline.base.layout import JobLayout
    from pipeline.model.job import Job
    from pipeline.stages.base import TaskContext

REFERENCE = "synthetic_stages:STAGES"
CHECKPOINT_EVERY = 4
END = b"end\n"


class SimulationDivergedError(RuntimeError):
    """Named like the simulation's own: the worker goes by the name."""


def validate(path: Path) -> None:
    if not path.read_bytes().endswith(END):
        raise InvalidArtifactError(f"{path.name} is truncated")


def step_artifact(frame: int) -> ArtifactPath:
    return ArtifactPath(f"steps/{frame:06d}.bin")


def double_artifact(frame: int) -> ArtifactPath:
    return ArtifactPath(f"double/{frame:06d}.bin")


FILM = ArtifactPath("film.bin")


class StepsStage(Stage):
    name = "steps"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        return [
            Task(
                id=TaskId("steps"),
                stage=self.name,
                inputs=(),
                outputs=tuple(step_artifact(frame) for frame in range(job.frame_count)),
                parameters=ParameterSet.of(stage=self.name, version=self.version, tools={}, gravity=job.gravity),
                checkpointed=True,
            )
        ]

    def run(self, context: TaskContext) -> None:
        outputs = context.task.outputs
        state, first = b"", 0
        checkpoint = context.layout.root / "steps" / "checkpoint.json"
        if checkpoint.exists():
            saved = json.loads(checkpoint.read_text())
            if saved["fingerprint"] == context.fingerprint and all(
                context.is_committed(artifact) for artifact in outputs[: saved["frame"] + 1]
            ):
                state, first = bytes.fromhex(saved["state"]), saved["frame"] + 1
        for frame in range(first, len(outputs)):
            if context.stop_requested():
                return
            state = blake3(state + str(context.job.gravity).encode() + str(frame).encode()).digest()
            time.sleep(pause_s(context))
            apply_fault(context, at=frame)
            if not context.is_committed(outputs[frame]):
                with context.committing(outputs[frame], validate) as path:
                    path.write_bytes(state * 100 + END)
            context.progress(frame + 1, len(outputs), f"frame {frame}")
            if frame % CHECKPOINT_EVERY == CHECKPOINT_EVERY - 1:
                part = checkpoint.with_name(f".checkpoint.part.{context.attempt}")
                part.write_text(json.dumps({"frame": frame, "state": state.hex(), "fingerprint": context.fingerprint}))
                part.replace(checkpoint)


class DoubleStage(Stage):
    name = "double"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        parameters = ParameterSet.of(stage=self.name, version=self.version, tools={}, camera=job.camera)
        return [
            Task(
                id=TaskId(f"double/{frame:06d}"),
                stage=self.name,
                inputs=(step_artifact(frame),),
                outputs=(double_artifact(frame),),
                parameters=parameters,
                frame=frame,
            )
            for frame in range(job.frame_count)
        ]

    def lighter(self, job: Job) -> str:
        return "fewer frames"

    def run(self, context: TaskContext) -> None:
        time.sleep(pause_s(context))
        source = context.layout.path(context.task.inputs[0]).read_bytes()
        with context.committing(context.task.outputs[0], validate) as path:
            path.write_bytes(str(context.job.camera.focal_length_mm).encode() + source)
            apply_fault(context)
        context.progress(1, 1)


class FilmStage(Stage):
    name = "film"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        return [
            Task(
                id=TaskId("film"),
                stage=self.name,
                inputs=tuple(double_artifact(frame) for frame in range(job.frame_count)),
                outputs=(FILM,),
                parameters=ParameterSet.of(stage=self.name, version=self.version, tools={}),
                resources=Resources(cores=0),
            )
        ]

    def run(self, context: TaskContext) -> None:
        apply_fault(context)
        with context.committing(FILM, validate) as path:
            path.write_bytes(b"".join(context.layout.path(piece).read_bytes() for piece in context.task.inputs))


STAGES = (StepsStage(), DoubleStage(), FilmStage())


# --- faults ---


def write_faults(root: Path, faults: dict[str, list[str]], *, pause_s: float = 0.0) -> None:
    root.mkdir(parents=True, exist_ok=True)
    part = root / "faults.json.new"
    part.write_text(json.dumps({"faults": faults, "pause_s": pause_s}))
    part.replace(root / "faults.json")  # workers may be reading it


def pause_s(context: TaskContext) -> float:
    control = context.layout.root / "faults.json"
    return float(json.loads(control.read_text())["pause_s"]) if control.exists() else 0.0


def apply_fault(context: TaskContext, at: int | None = None) -> None:
    control = context.layout.root / "faults.json"
    if not control.exists():
        return
    faults = json.loads(control.read_text())["faults"].get(context.task.id, [])
    used = context.layout.root / "used_faults" / context.task.id.replace("/", "_")
    count = len(used.read_text()) if used.exists() else 0
    if count >= len(faults):
        return
    name, _, frame = faults[count].partition("@")
    if frame and int(frame) != at:
        return
    used.parent.mkdir(exist_ok=True)
    used.write_text("x" * (count + 1))
    FAULTS[name](context)


def _fail(context: TaskContext) -> None:
    raise ValueError("a fault of the task's own")


def _diverge(context: TaskContext) -> None:
    raise SimulationDivergedError('"water" diverged at frame 3')


def _fill_disk(context: TaskContext) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _fill_temporary_disk(_context: TaskContext) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/temporary/file")


def _run_out_of_memory(context: TaskContext) -> None:
    bytearray(1 << 62)


def _segfault(context: TaskContext) -> None:
    ctypes.string_at(0)


def _exit(context: TaskContext) -> None:
    os._exit(7)


def _kill(context: TaskContext) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _half_a_message(context: TaskContext) -> None:
    """Die in the middle of a message: a header that promises more than follows."""
    for link in list(Path("/proc/self/fd").iterdir()):
        if os.path.lexists(link) and str(link.readlink()).startswith("socket:"):
            os.write(int(link.name), (1000).to_bytes(8, "big") + b"half")
    os._exit(1)


def _hang(context: TaskContext) -> None:
    time.sleep(600)


def _prepare(context: TaskContext) -> None:
    """As one that compiles: silent for longer than tests allow a task to take."""
    context.progress(0, 1, "compiling", preparing=True)
    time.sleep(3.0)
    context.progress(0, 1)


def _prepare_and_hang(context: TaskContext) -> None:
    context.progress(0, 1, "compiling", preparing=True)
    context.progress(0, 1)
    time.sleep(600)


def _wait_for_stop(context: TaskContext) -> None:
    while not context.stop_requested():
        time.sleep(0.01)


def _wait_for_reader(context: TaskContext) -> None:
    """Go on only when somebody has read the first frame."""
    until = time.monotonic() + 30.0
    while not context.layout.path(double_artifact(0)).exists():
        if time.monotonic() > until:
            raise TimeoutError("nobody reads the first frame")
        time.sleep(0.01)


def _leave_child(context: TaskContext) -> None:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (context.layout.root / "child.pid").write_text(str(child.pid))


def _start_large_child(context: TaskContext) -> None:
    """Small itself; what it started holds 400 MB."""
    command = "import sys, time; held = bytearray(b'x') * 400_000_000; time.sleep(600)"
    child = subprocess.Popen([sys.executable, "-c", command])
    (context.layout.root / "child.pid").write_text(str(child.pid))
    time.sleep(600)


def _take_memory_at_once(_context: TaskContext) -> None:
    bytearray(os.urandom(2**20) * 2_000)


def _lose_blender(context: TaskContext) -> None:
    raise BlenderDiedError(3, -9, "(it wrote nothing)")


GPU_WORDS = (
    "[cuda_driver.h:operator()@92] CUDA Error CUDA_ERROR_ILLEGAL_ADDRESS: an illegal memory access was encountered"
)


def _lose_gpu(context: TaskContext) -> None:
    raise RuntimeError(GPU_WORDS)


def _lose_gpu_and_abort(context: TaskContext) -> None:
    """As a driver that ends the process."""
    print(GPU_WORDS, flush=True)
    os.abort()


def _start_child_and_hang(context: TaskContext) -> None:
    _leave_child(context)
    time.sleep(600)


def _write_temporary_files(context: TaskContext) -> None:
    """As Blender and Taichi do, which remove them only where they end by themselves."""
    folder = Path(tempfile.mkdtemp(prefix="blender_"))
    (folder / "picture").write_bytes(b"pixels")
    (context.layout.root / "temporary").write_text(str(folder))


def _write_temporary_files_and_die(context: TaskContext) -> None:
    _write_temporary_files(context)
    _kill(context)


def _write_temporary_files_and_hang(context: TaskContext) -> None:
    _write_temporary_files(context)
    _start_child_and_hang(context)


def _print_from_c(context: TaskContext) -> None:
    ctypes.CDLL(None).puts(b"a line from C")


FAULTS = {
    "fail": _fail,
    "diverge": _diverge,
    "disk full": _fill_disk,
    "temporary disk full": _fill_temporary_disk,
    "memory error": _run_out_of_memory,
    "segfault": _segfault,
    "exit": _exit,
    "kill": _kill,
    "half a message": _half_a_message,
    "hang": _hang,
    "prepare": _prepare,
    "prepare and hang": _prepare_and_hang,
    "wait for stop": _wait_for_stop,
    "child": _start_child_and_hang,
    "wait for reader": _wait_for_reader,
    "leave child": _leave_child,
    "puts": _print_from_c,
    "temporary files": _write_temporary_files,
    "temporary files and kill": _write_temporary_files_and_die,
    "temporary files and hang": _write_temporary_files_and_hang,
    "large child": _start_large_child,
    "take memory at once": _take_memory_at_once,
    "lose Blender": _lose_blender,
    "lose GPU": _lose_gpu,
    "lose GPU and abort": _lose_gpu_and_abort,
}
