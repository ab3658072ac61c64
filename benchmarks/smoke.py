"""Time and memory of smoke: steps of a developed plume, and what a process takes for each cell; JSON.

    python -m benchmarks.smoke [--cells 64 128] [--steps 7] [--threads N] [--device cpu]
    python -m benchmarks.smoke --memory [--cells 96 128] [--with gusts ball fluid cloth] [--frames 3]
    python -m benchmarks.smoke --window 256 64 64 [--frames 96] [--moments 4] [--only-window] [--device cuda]

Times are of whole substeps, after the plume has risen through the box: MacCormack, confinement and projection. The
fastest is the one that other work on the machine disturbed least, and processor time, summed over the threads, tells
what contention hides. Iterations are of one projection to the default tolerance.

`--window`: a plume in a wind along a long box of so many cells, by a window that follows it. At some moments a frame is
computed from the same state in the window, with its fitting, in a box cut to fit the smoke, and in the whole box.

`--memory`: each grid is simulated on a CPU by a process of its own, which writes as the stage does, in a thread beside
the simulation; it takes a checkpoint with every frame, which is oftener than a job does. `bytes_per_cell` is how much
the most memory of the processes grows from the first grid to the last, so that what does not grow with cells, above all
compiled kernels, does not count. It is to be below what `check` counts (`pipeline.kinds.checks.smoke`).
"""

from __future__ import annotations

import math
import resource
import statistics
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.compare import arguments_of, array_bytes, child, machine, run, start_taichi, timed
from pipeline.kinds.checks.smoke import BYTES_PER_CELL
from pipeline.model.job import Job
from render.smoke_region import bounding_box
from sim.core.domain import DomainParameters
from sim.core.runtime import initialize
from sim.smoke.grid import Index3, Window
from sim.smoke.parameters import SmokeParameters

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sim.core.snapshots import Snapshot
    from sim.core.world import FrameReport
    from sim.smoke.solver import SmokeSolver

BOX = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
DEVELOPED_S = 0.7
"""By then the cap of the plume has reached the upper half of the box."""

FPS = 60
WIND, FRAME_S = (1.0, 0.0, 0.0), 1.0 / 24.0
BALL = {"name": "ball", "kind": "dynamic", "density": 100.0, "shape": {"type": "sphere", "radius": 0.15}}
WATER = {"shape": {"type": "box", "size": (0.3, 0.3, 0.2)}, "position": (0.3, 0.3, 0.1)}
FLAG = {"name": "flag", "shape": {"type": "rectangle", "size": (0.2, 0.2), "counts": (17, 17)}}
COMPANY: dict[str, dict[str, Any]] = {
    "gusts": {},
    "ball": {"rigid": [{**BALL, "position": (0.0, 0.0, 0.6), "velocity": (0.1, 0.0, 0.0)}]},
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


def measure(cells: int, steps: int) -> dict[str, object]:
    """One cubic grid of `cells` a side."""
    import taichi as ti

    from sim.smoke.solver import SmokeSolver

    source = {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.15)}
    parameters = SmokeParameters.model_validate({"name": "plume", "cell_size": 1.0 / cells, "source": [source]})
    start = time.perf_counter()
    solver = SmokeSolver(parameters, domain=BOX, gravity=(0.0, 0.0, -9.81))

    def step() -> float:
        dt = min(solver.stable_dt(), 1 / 60)
        solver.substep(dt)
        ti.sync()
        return dt

    step()
    compiled_s, time_s = time.perf_counter() - start, 0.0
    while time_s < DEVELOPED_S:
        time_s += step()
    times, iterations, residuals = [], [], []
    for _ in range(steps):
        solver.begin_frame(time_s)
        ti.sync()
        times.append(timed(step))
        numbers = solver.diagnostics()
        iterations.append(numbers["iterations"])
        residuals.append(numbers["residual"])
    seconds, processor_seconds = zip(*times, strict=True)
    return {
        "cells": list(solver.grid.cells),
        "step_s_median": round(statistics.median(seconds), 4),
        "step_s_min": round(min(seconds), 4),
        "processor_s_median": round(statistics.median(processor_seconds), 4),
        "million_cells_per_s": round(cells**3 / min(seconds) / 1.0e6, 1),
        "projection_iterations": max(iterations),
        "projection_residual": max(residuals),
        "bytes_per_cell": round(array_bytes() / cells**3, 1),
        "first_step_s": round(compiled_s, 2),
    }


def measure_window(counts: Index3, frames: int, moments: int, *, only_window: bool) -> Iterator[dict[str, object]]:
    """Frames of a plume in a window that follows it, and at some moments in other boxes as well."""
    from sim.smoke.solver import SmokeSolver
    from sim.smoke.window import LEAST_DENSITY

    size = 1.0 / counts[2]
    source = {"shape": {"type": "sphere", "radius": 0.08}, "position": (0.15, 0.0, 0.3), "temperature": 310.0}
    low = (0.0, -0.5 * counts[1] * size, 0.0)
    high = (counts[0] * size, 0.5 * counts[1] * size, 1.0)
    keys = {"name": "plume", "cell_size": size, "source": [source], "wind": WIND, "min": low, "max": high}
    parameters = SmokeParameters.model_validate({**keys, "grid": "window"})
    solver = SmokeSolver(parameters, domain=BOX, gravity=(0.0, 0.0, -9.81), frame_s=FRAME_S)
    for number in range(frames):
        begun = time.perf_counter()
        _frame(solver, number, fits=True)
        seconds = time.perf_counter() - begun
        if (number + 1) % max(1, frames // moments) != 0:
            continue
        found: dict[str, object] = {"frame": number + 1, "last_frame_ms": round(1e3 * seconds, 1)}
        state, window = solver.checkpoint(), solver.grid.window
        boxes = {"window": window, "fit": _box_of_smoke(state["density"] > LEAST_DENSITY, window)}
        boxes |= {} if only_window else {"whole": Window((0, 0, 0), counts)}
        for name, box in boxes.items():
            solver.restore(state if name == "window" else _resized(state, window, box))
            begun = time.perf_counter()
            _frame(solver, number + 1, fits=name == "window")
            found[name] = {"cells": list(box.cells), "frame_ms": round(1e3 * (time.perf_counter() - begun), 1)}
        ratio = math.prod(window.cells) / math.prod(boxes["fit"].cells)
        yield {**found, "cells_over_fit": round(ratio, 2), "numbers": dict(solver.diagnostics())}
        solver.restore(state)


def _frame(solver: SmokeSolver, number: int, *, fits: bool) -> None:
    import taichi as ti

    if fits:
        solver.begin_frame(number * FRAME_S)
    left = FRAME_S
    while left > 0.0:
        steps = math.ceil(left / solver.stable_dt())
        solver.substep(left / steps)
        left = left - left / steps if steps > 1 else 0.0
    ti.sync()


def _box_of_smoke(is_smoke: NDArray[np.bool_], window: Window) -> Window:
    """The smallest box around the smoke in a window, whose cells come with ghosts."""
    box = bounding_box(is_smoke[1:-1, 1:-1, 1:-1])
    assert box is not None, "there is no smoke"
    a, b, c = (first + side.start for first, side in zip(window.first, box, strict=True))
    x, y, z = (side.stop - side.start for side in box)
    return Window((a, b, c), (x, y, z))


def _resized(state: dict[str, Any], old: Window, new: Window) -> dict[str, Any]:
    """A checkpoint in another window; fresh air moves with the wind."""
    resized = {"clock": state["clock"], "window": np.array([new.first, new.cells])}
    shift = np.subtract(new.first, old.first)
    low = np.maximum(0, shift)
    high = np.minimum(np.add(old.cells, 2), shift + np.add(new.cells, 2))
    for name, values in state.items():
        if name not in resized:
            fresh = WIND[0] if name == "u_face_x" else 0.0
            resized[name] = np.full(np.add(new.cells, 2), fresh, np.float32)
            into = tuple(map(slice, low - shift, high - shift))
            resized[name][into] = values[tuple(map(slice, low, high))]
    return resized


def simulate(cells: int, company: list[str], frames: int, threads: int) -> int:
    """Most memory that this process had when it had written so many frames [bytes]."""
    from pipeline.stages.ordered_writer import OrderedWriter
    from pipeline.store.cache import Checkpoint, read_checkpoint, validate_frame, write_checkpoint, write_frame
    from sim.build import build_world

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
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def measure_memory(counts: list[int], company: list[str], frames: int, threads: int) -> dict[str, Any]:
    """How the most memory of processes grows with their grids, so many cells across."""
    peaks = {}
    for cells in counts:
        command = ["-m", "benchmarks.smoke", "--alone", "--cells", str(cells), "--frames", str(frames)]
        peaks[cells] = child([*command, "--threads", str(threads), "--with", *company])["peak_bytes"]
    first, last = counts[0], counts[-1]
    return {
        "with": company,
        "peak_bytes": peaks,
        "bytes_per_cell": round((peaks[last] - peaks[first]) / (last**3 - first**3), 1),
        "bytes_per_cell_of_check": BYTES_PER_CELL,
    }


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--cells", type=int, nargs="+")
    parser.add_argument("--steps", type=int, default=7)
    parser.add_argument("--memory", action="store_true", help="of processes that simulate and write; nothing is timed")
    parser.add_argument("--with", dest="company", nargs="*", choices=list(COMPANY), default=list(COMPANY))
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--window", type=int, nargs=3, help="cells of the box of a plume that a window follows")
    parser.add_argument("--moments", type=int, default=4)
    parser.add_argument("--only-window", action="store_true", help="the whole box is too large to be computed")
    parser.add_argument("--alone", action="store_true", help="the memory of one such process")
    asked, _ = parser.parse_known_args()
    if asked.window:
        arguments = start_taichi(parser)
        given = tuple(arguments.window), arguments.frames, arguments.moments
        return {**machine(arguments.device), "results": list(measure_window(*given, only_window=arguments.only_window))}
    if not asked.memory and not asked.alone:
        arguments = start_taichi(parser)
        results = [measure(cells, arguments.steps) for cells in arguments.cells or (64, 128)]
        return {**machine(arguments.device), "results": results}
    parser.add_argument("--threads", type=int, default=2)
    arguments = parser.parse_args()
    cells = arguments.cells or [96, 128]
    if arguments.alone:
        return {"peak_bytes": simulate(cells[0], arguments.company, arguments.frames, arguments.threads)}
    if len(cells) < 2:
        parser.error("--cells takes two numbers or more: the growth from the first to the last is told")
    return measure_memory(cells, arguments.company, arguments.frames, arguments.threads)


if __name__ == "__main__":
    run(main)
