"""Time of a smoke step with a sphere in the plume: none, a static one, one that could move, and one that does.

    python -m benchmarks.smoke_obstacles [--cells 64] [--steps 12] [--threads N] [--device cpu]

Prints JSON. The four worlds take their steps in turn, so that other work on the machine disturbs all of them alike;
times are processor time, summed over the threads, and include the rigid body's own steps.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import TYPE_CHECKING

from sim.runtime import initialize
from sim.scene import SceneParameters

if TYPE_CHECKING:
    from sim.world import World

DEVELOPED_FRAMES = 25
"""By then the plume has reached the sphere."""

SPHERE = {"name": "ball", "shape": {"type": "sphere", "radius": 0.15}, "position": (0.3, 0.5, 0.6)}
SPHERES = {
    "none": [],
    "static": [SPHERE],
    "kinematic at rest": [{**SPHERE, "kind": "kinematic"}],
    "kinematic at 0.6 m/s": [{**SPHERE, "kind": "kinematic", "velocity": (0.6, 0.0, 0.0)}],
}


def build(cells: int, bodies: list[dict[str, object]]) -> World:
    """A cubic metre of so many cells a side, with a plume and bodies in it."""
    from sim.build import build_world

    source = {"shape": {"type": "sphere", "radius": 0.1}, "position": (0.5, 0.5, 0.15)}
    scene = {
        "domain": {"min": (0.0, 0.0, 0.0), "max": (1.0, 1.0, 1.0)},
        "rigid": bodies,
        "smoke": [{"name": "plume", "cell_size": 1.0 / cells, "source": [source]}],
    }
    return build_world(SceneParameters.model_validate(scene), frames_per_second=60.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    device = initialize(arguments.device, threads=arguments.threads)
    import taichi as ti

    worlds = {name: build(arguments.cells, bodies) for name, bodies in SPHERES.items()}
    for world in worlds.values():
        for _ in range(DEVELOPED_FRAMES):
            world.advance_frame()
    seconds: dict[str, list[float]] = {name: [] for name in worlds}
    iterations: dict[str, list[float]] = {name: [] for name in worlds}
    for _ in range(arguments.steps):
        for name, world in worlds.items():
            ti.sync()
            start = time.process_time()
            report = world.advance_frame()
            ti.sync()
            substeps = report.substeps["plume"]
            seconds[name].append((time.process_time() - start) / substeps)
            iterations[name].append(report.diagnostics["plume"]["iterations"] / substeps)
    results = {
        name: {
            "processor_s_min": round(min(seconds[name]), 4),
            "processor_s_median": round(statistics.median(seconds[name]), 4),
            "projection_iterations": round(statistics.mean(iterations[name]), 2),
        }
        for name in worlds
    }
    print(json.dumps({"device": device, "cells": arguments.cells, "sphere": results}, indent=2))


if __name__ == "__main__":
    main()
