"""Speed of cloth that falls over a ball; JSON on the standard output.

    python -m benchmarks.cloth --nodes 128 --substeps 20 --device cpu [--without-contacts] [--blender]

A square metre of cloth falls flat onto a ball, drapes itself around it and reaches the floor. Times are of whole frames
at 60 frames a second, contacts with the ball, the floor and itself included; of the frames the median counts. The
processor time of all threads stands beside it, as other programs on the same cores do not enter it (on a GPU it says
nothing). Parts of a substep are timed apart, at the end, where the cloth is folded most; contacts in one more frame, as
lists last only while cloth moves as it does in a run. With `--blender` Blender's own
cloth (bpy of this Python) does the same drop of the same mesh; both results are described by the same numbers.
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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.runtime import initialize
from sim.scene import SceneParameters

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.cloth.state import ClothState
    from sim.world import World

SIDE, HEIGHT = 1.0, 0.3
"""Length of the cloth's sides, and how high it starts [m]."""

BALL_RADIUS, BALL_HEIGHT, FLOOR = 0.25, 0.0, -0.4
"""Radius of the ball, height of its centre and of the floor [m]."""

THICKNESS_IN_SPACINGS = 0.5
"""Distance that layers keep: below the spacing of nodes, as a cloth that folds needs."""

FRAMES_PER_SECOND = 60.0


def scene(nodes: int, *, substeps: int, self_collision: bool, mass_per_area: float) -> SceneParameters:
    """The drop, with nodes x nodes."""
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-1.0, -1.0, FLOOR), "max": (1.0, 1.0, 1.0)},
            "cloth": [
                {
                    "name": "cloth",
                    "shape": {"type": "rectangle", "size": (SIDE, SIDE), "counts": (nodes, nodes)},
                    "position": (0.0, 0.0, HEIGHT),
                    "substeps": substeps,
                    "self_collision": self_collision,
                    "mass_per_area": mass_per_area,
                    "thickness": THICKNESS_IN_SPACINGS * SIDE / (nodes - 1),
                }
            ],
            "rigid": [
                {"name": "ball", "shape": {"type": "sphere", "radius": BALL_RADIUS}, "position": (0, 0, BALL_HEIGHT)}
            ],
        }
    )


def measure(nodes: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """One drop: times of frames and of the parts of a substep, and what became of the cloth."""
    import taichi as ti

    from sim.build import build_world
    from sim.cloth.solver import ClothSolver

    parameters = scene(
        nodes, substeps=arguments.substeps, self_collision=not arguments.without_contacts, mass_per_area=0.3
    )
    start = time.perf_counter()
    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    solver = next(each for each in world._solvers.values() if isinstance(each, ClothSolver))
    if arguments.without_contacts:
        solver.contacts.clear()
    built_s = time.perf_counter() - start
    seconds, processor_seconds, substeps = [], [], 0
    for _ in range(arguments.frames):
        start, processor_start = time.perf_counter(), time.process_time()
        substeps = world.advance_frame().substeps[solver.name]
        ti.sync()
        seconds.append(time.perf_counter() - start)
        processor_seconds.append(time.process_time() - processor_start)
    later = slice(min(5, len(seconds) - 1), None)  # the first ones compile
    dt = solver.stable_dt()
    return {
        "nodes": nodes,
        "springs": sum(springs.count for springs in solver._springs),
        "triangles": solver.state.triangle_count,
        "substeps_of_last_frame": substeps,
        "building_s": built_s,
        "frame_ms": spread(seconds[later]),
        "frame_processor_ms": spread(processor_seconds[later]),
        "substep_parts_ms": {
            name: 1e3 * fastest(part, arguments.repeats)
            for name, part in {
                "damping": lambda: solver._integrator.accelerate(dt),
                "air_and_gravity": lambda: solver._predict(dt),
                "springs": lambda: solver._integrator.displace(dt),
            }.items()
        },
        "diagnostics": dict(solver.diagnostics()),
        "result": described(solver.state.positions(), solver.state.host.triangles),
        "contacts_ms_a_substep_of_one_more_frame": 1e3 * seconds_of_contacts(world, solver),
    }


def seconds_of_contacts(world: World, solver: ClothSolver) -> float:
    """Mean time of the contacts in a substep of the next frame [s]."""
    import taichi as ti

    spent, resolvers = [0.0], [contacts.resolve for contacts in solver.contacts]

    def timed(resolve: Callable[[ClothState, float], None]) -> Callable[[ClothState, float], None]:
        def resolve_timed(state: ClothState, dt: float) -> None:
            ti.sync()
            start = time.perf_counter()
            resolve(state, dt)
            ti.sync()
            spent[0] += time.perf_counter() - start

        return resolve_timed

    for contacts, resolve in zip(solver.contacts, resolvers, strict=True):
        contacts.resolve = timed(resolve)  # type: ignore[method-assign]
    solver.state.place_displaced()  # as the parts that were timed left other displacements
    substeps = world.advance_frame().substeps[solver.name]
    return spent[0] / substeps


def fastest(part: Callable[[], object], repeats: int) -> float:
    """Least time of a call [s]: what other programs disturbed least."""
    import taichi as ti

    seconds = []
    for _ in range(repeats):
        ti.sync()
        start = time.perf_counter()
        part()
        ti.sync()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def described(positions: NDArray[np.float64], triangles: NDArray[np.integer]) -> dict[str, Any]:
    """Where a cloth lies [m], and whether it crosses itself."""
    from sim.cloth.springs import edges_of
    from sim.cloth.start import first_crossing

    ball = np.linalg.norm(positions - (0.0, 0.0, BALL_HEIGHT), axis=1) - BALL_RADIUS
    crossing = first_crossing(positions, edges_of(triangles.astype(np.int32)).nodes, triangles)
    return {
        "highest": float(positions[:, 2].max()),
        "mean_height": float(positions[:, 2].mean()),
        "lowest": float(positions[:, 2].min()),
        "half_width": float(np.abs(positions[:, :2]).max()),
        "deepest_in_ball": float(max(-ball.min(), 0.0)),
        "crosses_itself": crossing is not None,
    }


def spread(values: list[float]) -> dict[str, float]:
    """In milliseconds."""
    return {"median": 1e3 * statistics.median(values), "least": 1e3 * min(values), "most": 1e3 * max(values)}


def measure_blender(nodes: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Blender's cloth, in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.cloth_blender", str(nodes), str(arguments.frames)]
    child = subprocess.run(command, capture_output=True, text=True, check=True)
    answer = json.loads(child.stdout)
    positions, triangles = np.array(answer.pop("positions")), np.array(answer.pop("triangles"))
    seconds, processor_seconds = answer.pop("seconds"), answer.pop("processor_seconds")
    return {
        **answer,
        "frame_ms": spread(seconds[5:]),
        "frame_processor_ms": spread(processor_seconds[5:]),
        "result": described(positions, triangles),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="+", default=[100], help="along each side, one drop each")
    parser.add_argument("--substeps", type=int, default=20)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=20, help="of each part of a substep")
    parser.add_argument("--without-contacts", action="store_true", help="springs and air alone")
    parser.add_argument("--blender", action="store_true", help="also Blender's own cloth")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int)
    arguments = parser.parse_args()
    device = initialize(arguments.device, threads=arguments.threads)
    runs = []
    for nodes in arguments.nodes:
        run = measure(nodes, arguments)
        if arguments.blender:
            run["blender"] = measure_blender(nodes, arguments)
            for time_of in ("frame_ms", "frame_processor_ms"):
                run[f"blender_over_own_{time_of}"] = run["blender"][time_of]["median"] / run[time_of]["median"]
        runs.append(run)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    json.dump(
        {"device": device, "cores": cores, "load_average": os.getloadavg()[0], "runs": runs}, sys.stdout, indent=2
    )
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
