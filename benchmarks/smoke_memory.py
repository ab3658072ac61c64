"""Memory that a process takes for each cell of smoke on a CPU while it simulates and writes frames and checkpoints.

    python -m benchmarks.smoke_memory [--cells 96 128] [--with gusts ball fluid cloth] [--frames 3] [--threads 2]

Prints JSON. Each grid is simulated by a process of its own, which writes as the stage does, in a thread beside the
simulation; it takes a checkpoint with every frame, which is oftener than a job does. `bytes_per_cell` is how much the
most memory of the processes grows from the first grid to the last, so that what does not grow with cells, above all
compiled kernels, does not count. It is to be below what `check` counts (`pipeline.job.smoke_checks`).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from pipeline.cache import Checkpoint, read_checkpoint, validate_frame, write_checkpoint, write_frame
from pipeline.job.models import Job
from pipeline.job.smoke_checks import BYTES_PER_CELL
from pipeline.stages.ordered_writer import OrderedWriter
from sim.build import build_world
from sim.runtime import initialize
from sim.snapshots import Snapshot
from sim.world import FrameReport

FPS = 60
BALL = {"name": "ball", "kind": "kinematic", "shape": {"type": "sphere", "radius": 0.15}, "position": (0.0, 0.0, 0.6)}
WATER = {"shape": {"type": "box", "size": (0.3, 0.3, 0.2)}, "position": (0.3, 0.3, 0.1)}
FLAG = {"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (17, 17)}}
COMPANY: dict[str, dict[str, Any]] = {
    "gusts": {},
    "ball": {"rigid": [{**BALL, "velocity": (0.1, 0.0, 0.0)}]},
    "fluid": {"fluid": [{"name": "water", "particle_radius": 0.02, "block": [WATER]}]},
    "cloth": {"cloth": [{**FLAG, "position": (-0.3, 0.0, 0.5)}]},
}
"""What may be in the box, as keys of a job; gusts are a key of the smoke."""


def job_of(cells: int, company: list[str]) -> Job:
    """A plume in a box of 1 m, so many cells across, with what is to be in it."""
    smoke: dict[str, Any] = {"name": "fog", "cell_size": 1.0 / cells, "min": (-0.5, -0.5, 0.0), "max": (0.5, 0.5, 1.0)}
    smoke["source"] = [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.2)}]
    if "gusts" in company:
        smoke["turbulence"] = {"strength": 1.0, "size": 2.0 / cells}
    keys: dict[str, Any] = {"name": "memory", "frames": 2, "smoke": [smoke]}
    for name in company:
        keys |= COMPANY[name]
    return Job.model_validate(keys)


def peak_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def simulate(cells: int, company: list[str], frames: int, threads: int) -> int:
    """Most memory that this process had when it had written so many frames [bytes]."""
    initialize("cpu", threads=threads)
    world = build_world(job_of(cells, company), frames_per_second=FPS)
    with tempfile.TemporaryDirectory() as folder:

        def commit(report: FrameReport, bodies: dict[str, Snapshot]) -> None:
            path = Path(folder, f"{report.frame}.h5")
            write_frame(path, bodies, report, device="cpu", longest_shutter_s=1.0 / FPS)
            validate_frame(path)

        def save(frame: int, arrays: dict[str, Any]) -> None:
            path = Path(folder, "checkpoint.h5")
            write_checkpoint(path, Checkpoint(frame, "memory", "cpu", arrays))
            read_checkpoint(path)

        with OrderedWriter() as writer:
            for frame in range(frames):
                report = world.advance_frame()
                writer.submit(partial(commit, report, world.snapshots()))
                writer.submit(partial(save, frame, world.checkpoint()))
    return peak_bytes()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[96, 128])
    parser.add_argument("--with", dest="company", nargs="*", choices=list(COMPANY), default=list(COMPANY))
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.alone:
        print(simulate(arguments.cells[0], arguments.company, arguments.frames, arguments.threads))
        return
    if len(arguments.cells) < 2:
        parser.error("--cells takes two numbers or more: the growth from the first to the last is told")
    peaks = {}
    for cells in arguments.cells:
        command = [sys.executable, "-m", "benchmarks.smoke_memory", "--alone", "--cells", str(cells)]
        command += ["--frames", str(arguments.frames), "--threads", str(arguments.threads), "--with"]
        answer = subprocess.run([*command, *arguments.company], check=True, stdout=subprocess.PIPE, text=True)
        peaks[cells] = int(answer.stdout.split()[-1])
    first, last = arguments.cells[0], arguments.cells[-1]
    grown = (peaks[last] - peaks[first]) / (last**3 - first**3)
    print(
        json.dumps(
            {
                "with": arguments.company,
                "peak_bytes": peaks,
                "bytes_per_cell": round(grown, 1),
                "bytes_per_cell_of_check": BYTES_PER_CELL,
            },
            indent=2,
        )
    )


if __name__ == "__main__":
    main()
