"""Time of soft matter: steps of a falling cube, beside the example of MLS-MPM that Taichi ships; JSON.

    python -m benchmarks.soft [--particles 100000 1000000] [--materials jelly sand] [--steps 30] [--peer]

Of each material and number of particles: medians of whole steps, the host's waits included, and memory of a particle
with its share of the grid. `--peer` takes the same cube, cells and steps with `mpm3d_ggui.py` of Taichi's examples
(Apache License 2.0), whose step is below as it stands there for jelly; it adds by atomic operations into a dense grid.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Any

from benchmarks.compare import arguments_of, array_bytes, machine, run, start_taichi
from sim.core.domain import DomainParameters
from sim.soft.parameters import SoftParameters

CELL = 0.01
WARM_UP = 5


def main() -> None:
    parser = arguments_of(__doc__)
    parser.add_argument("--particles", type=int, nargs="+", default=[100_000])
    parser.add_argument("--materials", nargs="+", default=["jelly", "sand"])
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--peer", action="store_true")
    arguments = start_taichi(parser)
    run(lambda: measured(arguments))


def measured(arguments: Any) -> dict[str, Any]:
    """All numbers."""
    results: dict[str, Any] = {"machine": machine(arguments.device)}
    for wanted in arguments.particles:
        cells = round((wanted / 8) ** (1.0 / 3.0))
        count = 8 * cells**3
        for material in arguments.materials:
            results[f"{material} {count}"] = ours(material, cells, arguments.steps)
        if arguments.peer:
            results[f"example of Taichi {count}"] = times(peer(cells), count, arguments.steps)
    return results


def times(step: Callable[[], None], count: int, steps: int) -> dict[str, float]:
    """Medians of a step."""
    import taichi as ti

    for _ in range(WARM_UP):
        step()
    ti.sync()
    taken = []
    for _ in range(steps):
        start = time.perf_counter()
        step()
        ti.sync()
        taken.append(time.perf_counter() - start)
    median = statistics.median(taken)
    return {"step_ms": 1e3 * median, "worst_ms": 1e3 * max(taken), "particle_steps_per_s": count / median}


def ours(material: str, cells: int, steps: int) -> dict[str, float]:
    """A cube of so many cells along an edge, above the floor of a box twice as wide."""
    from sim.soft.solver import SoftSolver

    edge = cells * CELL
    domain = DomainParameters(min=(-edge, -edge, 0.0), max=(edge, edge, 2.0 * edge))
    block = {"shape": {"type": "box", "size": (edge, edge, edge)}, "position": (0.0, 0.0, 0.5 * edge)}
    soft = SoftParameters.model_validate({"name": "it", "material": material, "cell_size": CELL, "block": [block]})
    before = array_bytes()
    solver = SoftSolver([soft], domain=domain, gravity=(0.0, 0.0, -9.81))
    found = times(lambda: solver.substep(solver.stable_dt()), 8 * cells**3, steps)
    return {**found, "bytes_per_particle": (array_bytes() - before) / (8 * cells**3)}


def peer(cells: int) -> Callable[[], None]:
    """A step of Taichi's example, of the same cube in a grid twice as wide."""
    import numpy as np
    import taichi as ti

    from benchmarks.soft_peer import Example

    edge = np.arange(2 * cells) / (4.0 * cells) + 1.0 / (8.0 * cells)
    places = np.stack(np.meshgrid(edge + 0.25, edge + 0.05, edge + 0.25, indexing="ij"), axis=-1).reshape(-1, 3)
    example = Example(places.astype(np.float32), 2 * cells)
    ti.sync()
    return example.step


if __name__ == "__main__":
    main()
