"""Time and memory of a smoke step: MacCormack, confinement and projection of a developed plume.

    python -m benchmarks.smoke [--cells 64 128] [--steps 7] [--threads N] [--device cpu]
    python -m benchmarks.smoke --iterations --cells 32 64 128 256

Prints JSON. Times are of whole substeps, after the plume has risen through the box; the fastest is the one that other
work on the machine disturbed least, and processor time, summed over the threads, tells what contention hides.
Iterations are of one projection to the default tolerance.

`--iterations` counts those of one projection of a jet with noise instead, as the validation's `smoke-projection` does:
in a box whose sides are all open but the floor, or all closed, without and with a ball.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

from benchmarks.validation.smoke_projection import SIDES, count_iterations
from sim.domain import DomainParameters
from sim.runtime import initialize
from sim.smoke.parameters import SmokeParameters

BOX = DomainParameters(min=(-0.5, -0.5, 0.0), max=(0.5, 0.5, 1.0))
DEVELOPED_S = 0.7
"""By then the cap of the plume has reached the upper half of the box."""


def measure(cells: int, steps: int) -> dict[str, object]:
    """One cubic grid of `cells` a side."""
    import taichi as ti

    from sim.smoke.solver import SmokeSolver

    parameters = SmokeParameters.model_validate(
        {
            "name": "plume",
            "cell_size": 1.0 / cells,
            "source": [{"shape": {"type": "sphere", "radius": 0.1}, "position": (0.0, 0.0, 0.15)}],
        }
    )
    start = time.perf_counter()
    solver = SmokeSolver(parameters, domain=BOX, gravity=(0.0, 0.0, -9.81))
    solver.substep(min(solver.stable_dt(), 1 / 60))
    compiled_s = time.perf_counter() - start
    time_s = 0.0
    while time_s < DEVELOPED_S:
        dt = min(solver.stable_dt(), 1 / 60)
        solver.substep(dt)
        time_s += dt
    seconds, processor_seconds, iterations, residuals = [], [], [], []
    for _ in range(steps):
        solver.begin_frame(time_s)
        ti.sync()
        start, processor_start = time.perf_counter(), time.process_time()
        solver.substep(min(solver.stable_dt(), 1 / 60))
        ti.sync()
        seconds.append(time.perf_counter() - start)
        processor_seconds.append(time.process_time() - processor_start)
        numbers = solver.diagnostics()
        iterations.append(numbers["iterations"])
        residuals.append(numbers["residual"])
    return {
        "cells": list(solver.grid.cells),
        "step_s_median": round(statistics.median(seconds), 4),
        "step_s_min": round(min(seconds), 4),
        "processor_s_median": round(statistics.median(processor_seconds), 4),
        "million_cells_per_s": round(cells**3 / min(seconds) / 1.0e6, 1),
        "projection_iterations": max(iterations),
        "projection_residual": max(residuals),
        "bytes_per_cell": round(solver.device_bytes / cells**3, 1),
        "first_step_s": round(compiled_s, 2),
    }


def measure_iterations(cells: int) -> dict[str, object]:
    """Of one projection in each kind of box of `cells` a side, and max|div u| h / max|u| that is left."""
    found: dict[str, object] = {"cells": cells}
    for sides in SIDES:
        for ball in (False, True):
            iterations, left = count_iterations(cells, sides, ball=ball)
            name = f"{sides} with a ball" if ball else sides
            found[name] = {"iterations": iterations, "divergence": float(f"{left:.3g}")}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--steps", type=int, default=7)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--iterations", action="store_true", help="count those of one projection; nothing is timed")
    arguments = parser.parse_args()
    device = initialize(arguments.device, threads=arguments.threads)
    if arguments.iterations:
        results = [measure_iterations(cells) for cells in arguments.cells]
    else:
        results = [measure(cells, arguments.steps) for cells in arguments.cells]
    print(json.dumps({"device": device, "results": results}, indent=2))


if __name__ == "__main__":
    main()
