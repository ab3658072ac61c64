"""What cloth does under heavy bodies and strong wind; JSON on the standard output.

    python -m benchmarks.cloth_loads [--only layers wind] [--threads 2]

`layers`: a steel ball, and lighter ones of its size, on cloth that lies on the floor, in one layer and in several, and
on one layer on a box that moves as well. Told are how far the ball stands over what is below the cloth, in the
thickness of all layers, and how much the cloth is strained, both for frames over the run. 1 and a small strain: it
rests on the cloth; less, and a large strain: it sinks through, or squeezes the cloth out.

`wind`: a loose silk sheet that falls on its edge before a wind straight down, which presses it into a heap on the
floor. Told are the processor times of frames in the air and in the heap, which other programs on the same cores hardly
enter.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from sim.runtime import initialize
from sim.scene import SceneParameters

FRAMES_PER_SECOND = 60.0

SIDE, NODES, THICKNESS = 0.4, 21, 3.0e-3
"""Length of the sides [m], nodes along each and distance of layers [m] of the cloths below the ball, of denim."""

BALL_RADIUS = 0.1
BALL_DENSITIES = (7.8, 78.0, 7800.0)
"""Of the ball [kg/m³]: 0.033, 0.33 and 33 kg; the last is steel."""

BOX, BOX_DENSITY = (0.6, 0.6, 0.1), 7800.0
"""Sizes [m] and density [kg/m³] of the box that moves."""

LAYERS_FRAMES, TOLD_EVERY = 120, 20
"""Frames of a run with a ball, and of how many one is told."""

HEAP_NODES, HEAP_FRAMES = 21, 40
"""Nodes along each side of a square metre of silk, and frames of a run in wind."""

WINDS, SUBSTEPS, HEAP_THICKNESSES = (10.0, 40.0), (20, 60), (0.2e-3, 5.0e-3)
"""Winds [m/s], steps a frame and thicknesses [m] of the runs in wind; the first thickness is that of silk."""

FALLING, LYING = slice(1, 6), slice(-10, None)
"""Frames in which the sheet is in the air, after the first, which compiles, and in which it lies as a heap."""


def ball_on_cloth(layers: int, density: float, *, box_moves: bool) -> SceneParameters:
    """A ball on cloths that lie on the floor, or on a box that moves."""
    top = BOX[2] if box_moves else 0.0
    cloths = [
        {
            "name": f"layer{k}",
            "material": "denim",
            "shape": {"type": "rectangle", "size": (SIDE, SIDE), "counts": (NODES, NODES)},
            # Nodes of the next layer stand over the squares of this one.
            "position": (0.3 * k * SIDE / NODES, 0.2 * k * SIDE / NODES, top + (0.6 + k) * THICKNESS),
            "thickness": THICKNESS,
            "air_density": 0.0,
        }
        for k in range(layers)
    ]
    ball = {
        "name": "ball",
        "kind": "dynamic",
        "density": density,
        "shape": {"type": "sphere", "radius": BALL_RADIUS},
        "position": (0.0, 0.0, top + BALL_RADIUS + (layers + 1.0) * THICKNESS),
    }
    box = {
        "name": "box",
        "kind": "dynamic",
        "density": BOX_DENSITY,
        "shape": {"type": "box", "size": BOX},
        "position": (0.0, 0.0, 0.5 * BOX[2]),
    }
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-1.0, -1.0, 0.0), "max": (1.0, 1.0, 2.0)},
            "cloth": cloths,
            "rigid": [ball, box] if box_moves else [ball],
        }
    )


def rest_on_cloth(layers: int, density: float, *, box_moves: bool = False) -> dict[str, Any]:
    """How a ball stands on cloth, over a run."""
    from sim.build import build_world
    from sim.cloth.solver import ClothSolver
    from sim.rigid.solver import RigidSolver

    world = build_world(ball_on_cloth(layers, density, box_moves=box_moves), frames_per_second=FRAMES_PER_SECOND)
    cloth, rigid = world.solvers["cloth"], world.solvers["rigid"]
    assert isinstance(cloth, ClothSolver)
    assert isinstance(rigid, RigidSolver)
    gaps, strains = [], []
    for frame in range(1, LAYERS_FRAMES + 1):
        world.advance_frame()
        if frame % TOLD_EVERY == 0:
            height = rigid.bodies.position[:, 2]
            top = height[1] + 0.5 * BOX[2] if box_moves else 0.0
            gaps.append(float(height[0] - BALL_RADIUS - top) / (layers * THICKNESS))
            strains.append(cloth.diagnostics()["max_strain"])
    mass_of_node = cloth.diagnostics()["mass"] / cloth.state.vertex_count
    return {
        "layers": layers,
        "on": "a box that moves" if box_moves else "the floor",
        "ball_kg": float(rigid.bodies.mass[0]),
        "ball_over_node": float(rigid.bodies.mass[0]) / mass_of_node,
        "frames": list(range(TOLD_EVERY, LAYERS_FRAMES + 1, TOLD_EVERY)),
        "gap_in_thicknesses": gaps,
        "max_strain": strains,
    }


def measure_layers() -> list[dict[str, Any]]:
    """Balls on one, two and three layers on the floor, and on one on a box that moves."""
    ways: Sequence[tuple[int, bool]] = ((1, False), (2, False), (3, False), (1, True))
    return [rest_on_cloth(layers, density, box_moves=moves) for layers, moves in ways for density in BALL_DENSITIES]


def heap_in_wind(wind: float, substeps: int, thickness: float) -> dict[str, Any]:
    """A sheet before a wind straight down [m/s], at so many steps a frame."""
    from sim.build import build_world

    scene = SceneParameters.model_validate(
        {
            "domain": {"min": (-3.0, -3.0, 0.0), "max": (3.0, 3.0, 4.0)},
            "cloth": [
                {
                    "name": "sheet",
                    "material": "silk",
                    "shape": {"type": "rectangle", "size": (1.0, 1.0), "counts": (HEAP_NODES, HEAP_NODES)},
                    "position": (0.0, 0.0, 2.0),
                    "rotation_deg": (90.0, 0.0, 0.0),
                    "wind": (0.1 * wind, 0.1 * wind, -wind),
                    "thickness": thickness,
                    "substeps": substeps,
                }
            ],
        }
    )
    world = build_world(scene, frames_per_second=FRAMES_PER_SECOND)
    seconds, jammed = [], 0.0
    for _ in range(HEAP_FRAMES):
        start = time.process_time()
        jammed += world.advance_frame().diagnostics["cloth"]["jammed"]
        seconds.append(time.process_time() - start)
    return {
        "wind": wind,
        "substeps": substeps,
        "thickness": thickness,
        "jammed_frames": jammed,
        "air_processor_ms": 1e3 * statistics.median(seconds[FALLING]),
        "heap_processor_ms": 1e3 * statistics.median(seconds[LYING]),
    }


def measure_wind() -> list[dict[str, Any]]:
    """Sheets in weak and strong wind, with more steps, and thicker."""
    (weak, strong), (few, many), (thin, thick) = WINDS, SUBSTEPS, HEAP_THICKNESSES
    runs = ((weak, few, thin), (strong, few, thin), (strong, many, thin), (strong, few, thick))
    return [heap_in_wind(*run) for run in runs]


MEASUREMENTS: dict[str, Callable[[], list[dict[str, Any]]]] = {"layers": measure_layers, "wind": measure_wind}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=sorted(MEASUREMENTS), default=list(MEASUREMENTS))
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    device = initialize(arguments.device, threads=arguments.threads)
    runs = {name: MEASUREMENTS[name]() for name in arguments.only}
    json.dump({"device": device, "load_average": os.getloadavg()[0], **runs}, sys.stdout, indent=2)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
