"""What a kernel costs on a CPU besides its work: being traced, being launched, and handing loops to threads.

    python -m benchmarks.kernel_costs [--threads 1 2] [--cells 16] [--repeats 3]

Prints JSON. Launches are of kernels with one and with four loops over 8 numbers, parallel and serial: what a further
loop costs is a third of the difference; the median of a thousand calls, wall clock. `first step` is the time from a
smoke solver's construction to the end of its first step, in a box of cells^3 and in a process of its own, whose kernels
another one has compiled and kept: with positions told as this project does (`sim.tracing`), and as Taichi does. Of
the repeats, in turns, the least counts: wall and processor time, and processor time of the tracing in it.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from sim.domain import DomainParameters
from sim.runtime import import_taichi, initialize
from sim.smoke.parameters import SmokeParameters

CALLS = 1000


def launches(threads: int) -> dict[str, float]:
    """Microseconds of a call, and of a further loop in it; call it in a fresh process."""
    initialize("cpu", threads=threads)
    import taichi as ti

    from benchmarks import kernel_loops as loops

    numbers = ti.ndarray(ti.f32, 8)

    def median_us(kernel: Callable[[Any], None]) -> float:
        kernel(numbers)
        times = []
        for _ in range(CALLS):
            begin = time.perf_counter()
            kernel(numbers)
            times.append(time.perf_counter() - begin)
        return 1e6 * statistics.median(times)

    found: dict[str, float] = {}
    for name, one, four in (
        ("parallel", loops.one_parallel_loop, loops.four_parallel_loops),
        ("serial", loops.one_serial_loop, loops.four_serial_loops),
    ):
        single, several = median_us(one), median_us(four)
        found |= {f"call, one {name} loop [us]": single, f"further {name} loop [us]": (several - single) / 3.0}
    return {name: round(value, 1) for name, value in found.items()}


def first_step(cells: int, *, as_taichi: bool) -> list[float]:
    """Time of a smoke solver's construction and first step [s]; call it in a fresh process.

    Returns:
        Wall and processor time, and processor time of the tracing in it.
    """
    import_taichi()
    from taichi.lang import kernel_impl
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

    wrapped = ASTTransformerContext.get_pos_info
    initialize("cpu", threads=1)
    from sim.smoke.solver import SmokeSolver

    if as_taichi:
        ASTTransformerContext.get_pos_info = wrapped
    tracing, trace = 0.0, kernel_impl.Kernel.materialize

    def timed(*arguments: Any, **named: Any) -> Any:
        nonlocal tracing
        begin = time.process_time()
        result = trace(*arguments, **named)
        tracing += time.process_time() - begin
        return result

    kernel_impl.Kernel.materialize = timed
    source = {"shape": {"type": "sphere", "radius": 0.2}, "position": (0.5, 0.5, 0.3)}
    smoke = SmokeParameters.model_validate({"name": "plume", "cell_size": 1.0 / cells, "source": [source]})
    box = DomainParameters(min=(0.0, 0.0, 0.0), max=(1.0, 1.0, 1.0))
    begin, begin_processor = time.perf_counter(), time.process_time()
    solver = SmokeSolver(smoke, domain=box, gravity=(0.0, 0.0, -9.81))
    solver.begin_frame(0.0)
    solver.substep(0.01)
    times = time.perf_counter() - begin, time.process_time() - begin_processor, tracing
    return [round(each, 2) for each in times]


def in_a_process_of_its_own(*arguments: str) -> Any:
    command = [sys.executable, "-m", "benchmarks.kernel_costs", *arguments]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--cells", type=int, default=16, help="along each edge of the box of smoke")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--only", choices=["launches", "first-step"], help=argparse.SUPPRESS)
    parser.add_argument("--as-taichi", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only == "launches":
        print(json.dumps(launches(options.threads[0])))
        return
    if options.only == "first-step":
        print(json.dumps(first_step(options.cells, as_taichi=options.as_taichi)))
        return
    result: dict[str, Any] = {"cores": os.cpu_count(), "load_average": os.getloadavg()[0], "cells": options.cells}
    for threads in options.threads:
        result[f"{threads} threads"] = in_a_process_of_its_own("--only", "launches", "--threads", str(threads))
    step = ("--only", "first-step", "--cells", str(options.cells))
    in_a_process_of_its_own(*step)  # compiles and keeps the kernels
    pairs = [
        (in_a_process_of_its_own(*step), in_a_process_of_its_own(*step, "--as-taichi")) for _ in range(options.repeats)
    ]
    for name, column in zip(
        ("first step", "first step, positions as Taichi tells them"), zip(*pairs, strict=True), strict=True
    ):
        result[f"{name} [wall, processor, tracing s]"] = [min(times) for times in zip(*column, strict=True)]
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
