"""The same plume on the same grid in Blender's own smoke (Mantaflow) and in this solver: time and divergence.

    python -m benchmarks.smoke_blender [--blender PATH] [--cells 64 | --cells 72 72 128] [--frames 24] [--threads 2]
                                       [--tolerance 1e-5] [--cfl 2 | --steps 1]

Prints JSON. Needs a Blender executable: the one on the PATH unless one is named. The module bpy does not do, at least
not bpy 5.0.1, whose baking ends with an error of its own Python binding.

The box is 1 m wide, and as high as its cells make it. Steps: as each has them by default (Mantaflow 4 cells a step and
at most 4 steps a frame, here 2 cells a step and no bound), or at most `--cfl` cells a step, or `--steps` in each
frame, in both. The plumes are not equally fast, as each has its own buoyancy: times a step compare the solvers.

Times are of one frame of 1/24 s after the first: means of processor time summed over the threads, which other work on
the machine disturbs least, and medians of the clock over the second half of the frames. Blender's contain writing its
VDB files, which it cannot bake without. Here `files` is what a film writes of each frame, HDF5 and from that VDB; a
film's runs in a thread beside the simulation and in a stage after it. The divergence is max|div u| h / max|u|, of the
staggered velocity where there is smoke, which is where Blender keeps it; `--tolerance` is what this solver is asked for
in the whole box. `front_m` is how high there is a hundredth of the densest smoke at the end, `load` how many threads
wanted to run on the machine, on average of the last 1, 5 and 15 minutes.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.cache import read_smoke_in_box, write_frame
from render.parameters import VolumeParameters
from render.volume import import_openvdb, write_volume
from sim.domain import DomainParameters
from sim.runtime import initialize
from sim.smoke.parameters import SmokeParameters
from sim.world import FrameReport

if TYPE_CHECKING:
    from sim.smoke.solver import SmokeSolver

FPS = 24
SHUTTER = 0.5
BAKE = Path(__file__).with_name("smoke_blender_bake.py")


class Plume(NamedTuple):
    """What both solvers are asked for."""

    cells: tuple[int, int, int]
    frames: int
    threads: int
    cfl: float | None
    """Most cells that smoke may cross in a step; None: as each has it."""
    steps: int | None
    """In each frame; None: as many as the speed asks for."""


def bake(blender: str, plume: Plume) -> dict[str, object]:
    """Let Blender bake the plume."""
    with tempfile.TemporaryDirectory() as folder:
        # A thread of its own for objects would hide steps from the bake's watch; Mantaflow's loops keep their threads.
        command = [blender, "--background", "--debug-depsgraph-no-threads", "--python-exit-code", "1"]
        command += ["--python", str(BAKE), "--", "--cells", *map(str, plume.cells)]
        keys = {"frames": plume.frames, "fps": FPS, "threads": plume.threads, "cache": folder,
                "cfl": plume.cfl, "steps": plume.steps}  # fmt: skip
        command += [f"--{name}={value}" for name, value in keys.items() if value is not None]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        files = sorted(Path(folder).glob("data/fluid_data_*.vdb"))
        said = [line for line in answer.stdout.splitlines() if line.startswith("baked ")]
        if answer.returncode != 0 or len(files) < plume.frames or not said:
            sys.exit(
                f"Blender baked {len(files)} of {plume.frames} frames:\n{answer.stdout[-2000:]}{answer.stderr[-2000:]}"
            )
        velocity, smoke = _read_baked(files[-1])
        front_m = _baked_front(files[-1]) / plume.cells[0]
        file_bytes = files[-1].stat().st_size
    told = json.loads(said[-1].removeprefix("baked "))
    if len(told["steps"]) != plume.frames - 1 or not sum(told["steps"]):
        sys.exit(f"steps and times of {len(told['steps'])} frames were seen in Blender {told['version']}, not of "
                 f"{plume.frames - 1}: it may call its functions otherwise than {BAKE.name} expects")  # fmt: skip
    return {
        "version": told["version"],
        **_summary(told["steps"], told["processor_s"], told["clock_s"]),
        "file_bytes": file_bytes,
        "front_m": round(front_m, 3),
        "divergence": _relative_divergence(velocity, smoke),
    }


def simulate(plume: Plume, tolerance: float) -> dict[str, object]:
    """The same with this project's solver."""
    initialize("cpu", threads=plume.threads)
    from sim.smoke.solver import SmokeSolver

    nx, ny, nz = plume.cells
    cfl = SmokeParameters.model_fields["cfl"].default if plume.cfl is None else plume.cfl
    parameters = SmokeParameters.model_validate(
        {
            "name": "plume",
            "cell_size": 1.0 / nx,
            "projection_tolerance": tolerance,
            "cfl": cfl,
            "source": [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.15)}],
        }
    )
    box = DomainParameters(min=(-0.5, -0.5 * ny / nx, 0.0), max=(0.5, 0.5 * ny / nx, nz / nx))
    solver = SmokeSolver(parameters, domain=box, gravity=(0.0, 0.0, -9.81))
    # The first steps compile, which Blender has behind it.
    for _ in range(2):
        solver.substep(1.0e-3)
    solver.restore({name: np.zeros_like(array) for name, array in solver.checkpoint().items()})
    steps, seconds, processor_seconds, files_seconds = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        volume = Path(folder, "frame.vdb")
        for frame in range(plume.frames):
            start, processor_start = time.perf_counter(), time.process_time()
            solver.begin_frame(frame / FPS)
            steps.append(_advance_frame(solver, plume.steps))
            seconds.append(time.perf_counter() - start)
            processor_seconds.append(time.process_time() - processor_start)
            processor_start = time.process_time()
            _write_files(solver, frame, volume)
            files_seconds.append(time.process_time() - processor_start)
        file_bytes = volume.stat().st_size
    state = solver.checkpoint()
    u, v, w = (state[name][1:, 1:, 1:] for name in ("u_face_x", "v_face_y", "w_face_z"))
    density = state["density"][1:-1, 1:-1, 1:-1]
    front = int(np.nonzero((density > 0.01 * density.max()).any(axis=(0, 1)))[0].max()) + 1
    summary = _summary(steps[1:], processor_seconds[1:], seconds[1:])
    files = statistics.fmean(files_seconds[1:])
    return {
        **summary,
        "files_processor_s_a_frame": round(files, 4),
        "with_files_processor_s_a_frame": round(statistics.fmean(processor_seconds[1:]) + files, 4),
        "file_bytes": file_bytes,
        "front_m": round(front / nx, 3),
        "divergence": _relative_divergence(np.stack([u, v, w], axis=-1), density > 0.0),
    }


def _advance_frame(solver: SmokeSolver, steps: int | None) -> int:
    """Go on by a frame, in so many steps or in as many as air needs; returns how many it took."""
    if steps is not None:
        for _ in range(steps):
            solver.substep(1.0 / FPS / steps)
        return steps
    left, taken = 1.0 / FPS, 0
    while left > 1.0e-9:
        count = math.ceil(left / solver.stable_dt() - 1.0e-9)
        solver.substep(left / count)
        left -= left / count
        taken += 1
    return taken


def _write_files(solver: SmokeSolver, frame: int, volume: Path) -> None:
    """Write the frame as a film does: HDF5, and VDB of what is read from that."""
    cached = volume.with_suffix(".h5")
    report = FrameReport(frame, frame / FPS, {}, {}, {"plume": solver.diagnostics()})
    write_frame(cached, solver.snapshots(), report, device="cpu", longest_shutter_s=1.0 / FPS)
    write_volume(
        volume, **vars(read_smoke_in_box(cached, "plume")), parameters=VolumeParameters(), fps=FPS, shutter=SHUTTER
    )


def _summary(steps: list[int], processor_seconds: list[float], seconds: list[float]) -> dict[str, object]:
    """Of all frames but the first."""
    return {
        "steps_a_frame": round(statistics.fmean(steps), 2),
        "processor_s_a_frame": round(statistics.fmean(processor_seconds), 4),
        "processor_s_a_step": round(sum(processor_seconds) / sum(steps), 4),
        "clock_s_a_frame_median": round(statistics.median(seconds[len(seconds) // 2 :]), 4),
        "clock_s_a_step": round(sum(seconds) / sum(steps), 4),
    }


def _baked_front(path: Path) -> int:
    """Cells from the lower end of the box up to the front of the smoke."""
    grid = import_openvdb().read(str(path), "density")
    low, high = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    density = np.zeros(high - low + 1, np.float32)
    grid.copyToArray(density, ijk=tuple(int(n) for n in low))
    return int(low[2] + np.nonzero((density > 0.01 * density.max()).any(axis=(0, 1)))[0].max()) + 1


def _read_baked(path: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Staggered velocity, (nx + 1, ny + 1, nz + 1, 3), in any unit, and where all faces of a cell are kept."""
    grid = import_openvdb().read(str(path), "velocity")
    low, high = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    velocity = np.zeros((*(high - low + 2), 3), np.float32)
    grid.copyToArray(velocity, ijk=tuple(int(n) for n in low))
    # A face of exactly zero in all components is one that was left out.
    kept = velocity.any(axis=-1)
    complete = kept[:-1, :-1, :-1] & kept[1:, :-1, :-1] & kept[:-1, 1:, :-1] & kept[:-1, :-1, 1:]
    return velocity, complete


def _relative_divergence(velocity: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
    """max|div u| h / max|u| over cells, from velocities at lower faces, one more along each axis than cells."""
    u, v, w = np.moveaxis(velocity.astype(np.float64), -1, 0)
    flux = np.diff(u, axis=0)[:, :-1, :-1] + np.diff(v, axis=1)[:-1, :, :-1] + np.diff(w, axis=2)[:-1, :-1]
    return float(np.abs(flux[where]).max() / np.abs(velocity).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", default="blender")
    parser.add_argument("--cells", type=int, nargs="+", default=[64], help="along every axis, or along x, y and z")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tolerance", type=float, default=SmokeParameters.model_fields["projection_tolerance"].default)
    stepping = parser.add_mutually_exclusive_group()
    stepping.add_argument("--cfl", type=float)
    stepping.add_argument("--steps", type=int)
    arguments = parser.parse_args()
    if arguments.frames < 4:
        parser.error("--frames must be at least 4: the first is taken off, and half of the others are timed")
    if len(arguments.cells) not in (1, 3):
        parser.error("--cells takes one number or three")
    blender = shutil.which(arguments.blender)
    if blender is None:
        sys.exit(f'no executable "{arguments.blender}" was found; name one with --blender PATH')
    nx, ny, nz = arguments.cells * 3 if len(arguments.cells) == 1 else arguments.cells
    plume = Plume((nx, ny, nz), arguments.frames, arguments.threads, arguments.cfl, arguments.steps)
    results = {"blender": bake(blender, plume), "this": simulate(plume, arguments.tolerance)}
    load = [round(each, 1) for each in os.getloadavg()]
    print(json.dumps({**plume._asdict(), "tolerance": arguments.tolerance, **results, "load": load}, indent=2))


if __name__ == "__main__":
    main()
