"""The same plume on the same grid in Blender's own smoke (Mantaflow) and in this solver: time and divergence.

    python -m benchmarks.smoke_blender [--blender PATH] [--cells 64] [--frames 24] [--threads 2] [--tolerance 1e-5]

Prints JSON. Needs a Blender executable: the one on the PATH unless one is named. The module bpy does not do, at least
not bpy 5.0.1, whose baking ends with an error of its own Python binding.

Times are of one frame of 1/24 s: processor time summed over the threads, which other work on the machine disturbs
least, and the median of wall-clock time over the second half of the frames. Blender's contain writing its cache, which
it cannot bake without. The divergence is max|div u| h / max|u|, of the staggered velocity where there is smoke, which
is where Blender keeps it; `--tolerance` is what this solver is asked for in the whole box.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from render.volume import import_openvdb
from sim.domain import DomainParameters
from sim.runtime import initialize
from sim.smoke.parameters import SmokeParameters

FPS = 24
BAKE = Path(__file__).with_name("smoke_blender_bake.py")


def bake(blender: str, cells: int, frames: int, threads: int) -> dict[str, object]:
    """Let Blender bake the plume; what a bake of one frame takes, its start above all, is taken off."""
    start_s, _, _, _ = _bake_once(blender, cells, 1, threads)
    spent_s, ends, (velocity, smoke), version = _bake_once(blender, cells, frames, threads)
    times = np.diff(ends)[len(ends) // 2 :]
    return {
        "version": version,
        "processor_s_a_frame": round((spent_s - start_s) / (frames - 1), 4),
        "frame_s_median": round(float(statistics.median(times)), 4),
        "divergence": _relative_divergence(velocity, smoke),
    }


def _bake_once(
    blender: str, cells: int, frames: int, threads: int
) -> tuple[float, list[float], tuple[NDArray[np.float32], NDArray[np.bool_]], str]:
    """Processor time [s], when each frame was written [s], the last frame as `_read_baked`, and Blender's version."""
    with tempfile.TemporaryDirectory() as folder:
        spent = -_children_seconds()
        command = [blender, "--background", "--python-exit-code", "1", "--python", str(BAKE), "--"]
        command += [f"--{name}={value}" for name, value in (("cells", cells), ("frames", frames), ("fps", FPS))]
        answer = subprocess.run(
            [*command, f"--threads={threads}", f"--cache={folder}"], capture_output=True, text=True, check=False
        )
        spent += _children_seconds()
        files = sorted(Path(folder).glob("data/fluid_data_*.vdb"))
        if answer.returncode != 0 or len(files) < frames:
            sys.exit(f"Blender baked {len(files)} of {frames} frames:\n{answer.stdout[-2000:]}{answer.stderr[-2000:]}")
        ends = [path.stat().st_mtime for path in files]
        last = _read_baked(files[-1])
        version = next(line for line in answer.stdout.splitlines() if line.startswith("version")).split()[1]
    return spent, ends, last, version


def simulate(cells: int, frames: int, threads: int, tolerance: float) -> dict[str, object]:
    """The same with this project's solver."""
    initialize("cpu", threads=threads)
    from sim.smoke.solver import SmokeSolver

    parameters = SmokeParameters.model_validate(
        {
            "name": "plume",
            "cell_size": 1.0 / cells,
            "projection_tolerance": tolerance,
            "source": [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.15)}],
        }
    )
    box = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
    solver = SmokeSolver(parameters, domain=box, gravity=(0.0, 0.0, -9.81))
    # The first steps compile, which Blender has behind it.
    for _ in range(2):
        solver.substep(1.0e-3)
    solver.restore({name: np.zeros_like(array) for name, array in solver.checkpoint().items()})
    seconds, processor_start, steps = [], time.process_time(), 0
    for frame in range(frames):
        start = time.perf_counter()
        solver.begin_frame(frame / FPS)
        left = 1.0 / FPS
        while left > 1.0e-9:
            count = math.ceil(left / solver.stable_dt() - 1.0e-9)
            solver.substep(left / count)
            left -= left / count
            steps += 1
        seconds.append(time.perf_counter() - start)
    spent = time.process_time() - processor_start
    state = solver.checkpoint()
    u, v, w = (state[name][1:, 1:, 1:] for name in ("u_face_x", "v_face_y", "w_face_z"))
    smoke = state["density"][1:-1, 1:-1, 1:-1] > 0.0
    return {
        "steps_a_frame": round(steps / frames, 2),
        "processor_s_a_frame": round(spent / frames, 4),
        "frame_s_median": round(statistics.median(seconds[frames // 2 :]), 4),
        "divergence": _relative_divergence(np.stack([u, v, w], axis=-1), smoke),
    }


def _children_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


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
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--tolerance", type=float, default=SmokeParameters.model_fields["projection_tolerance"].default)
    arguments = parser.parse_args()
    if arguments.frames < 4:
        parser.error("--frames must be at least 4: the first is taken off, and half of the others are timed")
    blender = shutil.which(arguments.blender)
    if blender is None:
        sys.exit(f'no executable "{arguments.blender}" was found; name one with --blender PATH')
    results = {
        "blender": bake(blender, arguments.cells, arguments.frames, arguments.threads),
        "this": simulate(arguments.cells, arguments.frames, arguments.threads, arguments.tolerance),
    }
    print(
        json.dumps(
            {"cells": arguments.cells, "frames": arguments.frames, "tolerance": arguments.tolerance, **results},
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
