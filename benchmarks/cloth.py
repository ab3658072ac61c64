"""Speed of cloth that falls over a ball, or slides into a funnel and heaps up; JSON on the standard output.

    python -m benchmarks.cloth --nodes 128 --substeps 20 --device cpu [--without-contacts] [--blender]
    python -m benchmarks.cloth --scene funnel --nodes 256 --frames 90 --device cuda [--by-kernel]
    python -m benchmarks.cloth --figures [--device cuda]

A square metre of cloth falls flat onto a ball, drapes itself around it and reaches the floor; the funnel is that of
`validation.cases.cloth_crossings`. Times are of whole frames at 60 frames a second, contacts with the ball, the floor
and itself included; the median and the most of those from `--from-frame` on count, whose substeps, contacts and listed
pairs of elements stand beside them. The processor time of all threads is told, too, as other programs on the same cores
do not enter it (on a GPU it says nothing). Parts of a substep are timed apart, at the end, where the cloth is folded
most; contacts in one more frame, as lists last only while cloth moves as it does in a run. With `--by-kernel` a GPU's
own time of each kernel in the last frames is told. With `--blender` Blender's own cloth (bpy of this Python) does the
same drop of the same mesh; both results are described by the same numbers. With `--figures` the scenes that speed is
judged by on this device are run one after the other, and a row of a Markdown table is printed for each.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.compare import arguments_of, child, machine, run, spread, start_taichi, timed
from benchmarks.launches import DeviceTimes
from sim.scene import SceneParameters
from validation.cases.cloth_crossings import in_a_funnel

if TYPE_CHECKING:
    from sim.cloth.solver import ClothSolver
    from sim.core.world import FrameReport, World

SIDE, HEIGHT = 1.0, 0.3
"""Length of the cloth's sides, and how high it starts [m]."""

BALL_RADIUS, BALL_HEIGHT, FLOOR = 0.25, 0.0, -0.4
"""Radius of the ball, height of its centre and of the floor [m]."""

THICKNESS_IN_SPACINGS = 0.5
"""Distance that layers keep: below the spacing of nodes, as a cloth that folds needs."""

FRAMES_PER_SECOND = 60.0

FIGURES = {
    "cpu": (("ball", 128, 60), ("ball", 100, 60)),
    "cuda": (("ball", 128, 60), ("ball", 512, 25), ("funnel", 256, 50)),
}
"""Scenes, nodes a side and frames that speed is judged by."""

LIVE_SUBSTEPS = (20, 10)
"""Substeps a frame of a live scene: as written, and the fewest that `pipeline live` takes by itself."""

BY_KERNEL_FRAMES = 2
"""Frames in which a GPU's time of each kernel is taken."""


def funnel(nodes: int, *, substeps: int) -> SceneParameters:
    """The funnel, for a sheet of nodes x nodes that is thick as that of the drop."""
    document = in_a_funnel(nodes)
    (cloth,) = document["cloth"]
    thickness = THICKNESS_IN_SPACINGS * cloth["shape"]["size"][0] / (nodes - 1)
    return SceneParameters.model_validate(
        {**document, "cloth": [{**cloth, "substeps": substeps, "thickness": thickness}]}
    )


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
    """One fall: times of frames and of the parts of a substep, and what became of the cloth."""
    import taichi as ti

    from sim.build import build_world
    from sim.cloth.solver import ClothSolver

    if arguments.scene == "funnel":
        parameters = funnel(nodes, substeps=arguments.substeps)
    else:
        parameters = scene(
            nodes, substeps=arguments.substeps, self_collision=not arguments.without_contacts, mass_per_area=0.3
        )
    start = time.perf_counter()
    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    solver = next(each for each in world._solvers.values() if isinstance(each, ClothSolver))
    if arguments.without_contacts:
        solver.contacts = None
    built_s = time.perf_counter() - start
    times: list[tuple[float, float]] = []
    counted: dict[str, list[float]] = {"substeps": [], "contacts": [], "listed_pairs": []}
    device = DeviceTimes() if arguments.by_kernel else None
    for number in range(1, arguments.frames + 1):
        if device is not None and number > arguments.frames - BY_KERNEL_FRAMES:
            device.watch()  # it slows the frames down that it watches
        reports: list[FrameReport] = []

        def frame(reports: list[FrameReport] = reports) -> None:
            reports.append(world.advance_frame())
            ti.sync()

        times.append(timed(frame))
        (report,) = reports
        counted["substeps"].append(report.substeps[solver.name])
        counted["contacts"].append(report.diagnostics[solver.name].get("contacts", 0.0))
        counted["listed_pairs"].append(listed_pairs(solver))
    first = min(arguments.from_frame, arguments.frames) - 1
    dt = solver.stable_dt()
    integrator: Any = solver._integrator
    return {
        "nodes": nodes,
        "springs": sum(springs.count for springs in solver._springs),
        "triangles": solver.state.triangle_count,
        "building_s": built_s,
        **frame_times(times, first),
        **{name: spread(numbers[first:]) for name, numbers in counted.items()},
        "by_frame": {"wall": [1e3 * wall for wall, _ in times], **counted},
        "device_ms_a_frame": device and device.per_frame(BY_KERNEL_FRAMES),
        "substep_parts_ms": {
            name: 1e3 * fastest(part, arguments.repeats)
            for name, part in {
                "damping": lambda: integrator.accelerate(dt),
                "air_and_gravity": lambda: solver.air.predict(solver.gravity, dt),
                "springs": lambda: integrator.displace(dt, np.ones(1, dtype=int)),
            }.items()
        },
        "diagnostics": dict(solver.diagnostics()),
        "result": described(solver.state.positions(), solver.state.host.triangles, has_ball=arguments.scene == "ball"),
        "contacts_ms_a_substep_of_one_more_frame": 1e3 * seconds_of_contacts(world, solver),
    }


def listed_pairs(solver: ClothSolver) -> int:
    """Pairs of elements of cloth that are near enough to be watched."""
    from sim.core.host_access import copied

    if solver.contacts is None:
        return 0
    pairs = solver.contacts._pairs
    return int(copied(pairs.listed.on_device.pieces)[: 2 * pairs.met.count, 2].sum())


def seconds_of_contacts(world: World, solver: ClothSolver) -> float:
    """Mean time of the contacts in a substep of the next frame [s]."""
    import taichi as ti

    contacts, spent = solver.contacts, [0.0]
    if contacts is None:
        return 0.0
    resolve = contacts.resolve

    def resolve_timed(*arguments: Any) -> bool:
        ti.sync()
        start = time.perf_counter()
        is_concluded = resolve(*arguments)
        ti.sync()
        spent[0] += time.perf_counter() - start
        return is_concluded

    contacts.resolve = resolve_timed
    solver.state.place_displaced()  # as the parts that were timed left other displacements
    substeps = world.advance_frame().substeps[solver.name]
    return spent[0] / substeps


def fastest(part: Callable[[], object], repeats: int) -> float:
    """Least time of a call [s]: what other programs disturbed least."""
    import taichi as ti

    def whole() -> None:
        part()
        ti.sync()

    ti.sync()
    return min(timed(whole)[0] for _ in range(repeats))


def described(
    positions: NDArray[np.float64], triangles: NDArray[np.integer], *, has_ball: bool = True
) -> dict[str, Any]:
    """Where a cloth lies [m], and whether it crosses itself."""
    from sim.cloth.sheet import edges_of
    from sim.cloth.start import first_crossing

    ball = np.linalg.norm(positions - (0.0, 0.0, BALL_HEIGHT), axis=1) - BALL_RADIUS
    crossing = first_crossing(positions, edges_of(triangles.astype(np.int32)).nodes, triangles)
    return {
        "highest": float(positions[:, 2].max()),
        "mean_height": float(positions[:, 2].mean()),
        "lowest": float(positions[:, 2].min()),
        "half_width": float(np.abs(positions[:, :2]).max()),
        **({"deepest_in_ball": float(max(-ball.min(), 0.0))} if has_ball else {}),
        "crosses_itself": crossing is not None,
    }


def frame_times(times: list[tuple[float, float]], first: int) -> dict[str, dict[str, float]]:
    """Wall and processor times of frames [ms], without so many at the start."""
    wall, processor = zip(*times[first:], strict=True)
    return {"frame_ms": spread(wall, scale=1e3), "frame_processor_ms": spread(processor, scale=1e3)}


def measure_blender(nodes: int, frames: int, first: int) -> dict[str, Any]:
    """Blender's cloth, in a process of its own; frames count after so many."""
    answer = child(["-m", "benchmarks.cloth", "--as-blender", "--nodes", str(nodes), "--frames", str(frames)])
    positions, triangles = np.array(answer.pop("positions")), np.array(answer.pop("triangles"))
    return {**answer, **frame_times(answer.pop("times"), first), "result": described(positions, triangles)}


def drop_in_blender(nodes: int, frames: int) -> dict[str, Any]:
    """The same drop by Blender itself: times of frames [s], and where the cloth is in the end. Needs bpy.

    Quality 5, collisions with the ball and the floor, and with itself at a distance of half the spacing of the nodes.
    """
    import bpy

    from sim.cloth.parameters import RectangleSheet
    from sim.cloth.sheet import rectangle

    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.render.fps = round(FRAMES_PER_SECOND)
    sheet = rectangle(RectangleSheet(type="rectangle", size=(SIDE, SIDE), counts=(nodes, nodes)))
    mesh = bpy.data.meshes.new("cloth")
    mesh.from_pydata(sheet.vertices + (0.0, 0.0, HEIGHT), [], sheet.triangles.tolist())  # noqa: RUF005  an array
    cloth = bpy.data.objects.new("cloth", mesh)
    stage.collection.objects.link(cloth)
    bpy.ops.mesh.primitive_uv_sphere_add(
        segments=64, ring_count=32, radius=BALL_RADIUS, location=(0.0, 0.0, BALL_HEIGHT)
    )
    ball = bpy.context.object
    bpy.ops.mesh.primitive_plane_add(size=4.0, location=(0.0, 0.0, FLOOR))
    for obstacle in (ball, bpy.context.object):
        obstacle.modifiers.new("collision", "COLLISION")
        obstacle.collision.thickness_outer = 0.001

    modifier = cloth.modifiers.new("cloth", "CLOTH")
    distance = THICKNESS_IN_SPACINGS * SIDE / (nodes - 1)
    modifier.settings.quality = 5
    # Mass stays 0.3 kg a vertex, as in Blender's cotton: the true one, below a gram, hangs in Blender's air like down.
    modifier.collision_settings.use_collision = modifier.collision_settings.use_self_collision = True
    modifier.collision_settings.distance_min = modifier.collision_settings.self_distance_min = distance
    modifier.point_cache.frame_end = frames + 1
    evaluated = None

    def show(frame: int) -> None:
        nonlocal evaluated
        stage.frame_set(frame)
        evaluated = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data

    times = [timed(lambda frame=frame: show(frame)) for frame in range(1, frames + 2)]
    positions = np.empty(3 * nodes**2, dtype=np.float32)
    evaluated.vertices.foreach_get("co", positions)
    return {
        "blender": bpy.app.version_string,
        "times": times[1:],
        "positions": positions.reshape(-1, 3).tolist(),
        "triangles": sheet.triangles.tolist(),
    }


def print_figures(arguments: argparse.Namespace) -> None:
    """A row for each scene, and on a CPU for Blender beside one, for live and for the first frame of cold kernels."""
    device = "cpu" if arguments.device == "cpu" else "cuda"
    print("| scene | ms a frame: median, worst | processor time | substeps, contacts, pairs: most | strain |")
    print("|---|---|---|---|---|")
    for scene_name, nodes, frames in FIGURES[device]:
        its = argparse.Namespace(**{**vars(arguments), "scene": scene_name, "frames": frames})
        drop = measure(nodes, its)
        wall, processor = drop["frame_ms"], drop["frame_processor_ms"]
        print(
            f"| {scene_name}, {nodes}² | {wall['median']:.1f}, {wall['most']:.1f} | {processor['median']:.0f} | "
            f"{drop['substeps']['most']}, {drop['contacts']['most']:.0f}, {drop['listed_pairs']['most']} | "
            f"{drop['diagnostics']['max_strain']:.3f} |",
            flush=True,
        )
    if device != "cpu":
        return
    # The last scene again, in Blender.
    blender = measure_blender(nodes, frames, min(arguments.from_frame, frames) - 1)
    over, spent = blender["frame_ms"]["median"], blender["frame_processor_ms"]["median"]
    print(f"| Blender, the last again | {over:.0f}, {over / wall['median']:.1f} times | ", end="")
    print(f"{spent:.0f}, {spent / processor['median']:.1f} times | | |", flush=True)
    counts = [str(count) for count in LIVE_SUBSTEPS]
    for live in child(["-m", "benchmarks.live", "--nodes", "100", "--substeps", *counts])["results"]:
        for name in ("falls", "dragged"):
            its = live[name]
            print(f"| live, 100², {name}: {its['frames_per_second']:.1f} frames/s | {its['frame_ms']:.0f} | ", end="")
            print(f"{its['processor_ms']:.0f} | {its['substeps_taken']:.0f} | {its['max_strain']:.3f} |", flush=True)
    with tempfile.TemporaryDirectory() as cold:
        environment = {**os.environ, "TI_OFFLINE_CACHE_FILE_PATH": cold}
        (first,) = child(["-m", "benchmarks.cloth", "--nodes", "128", "--frames", "1"], env=environment)["runs"]
    print(f"| first frame, 128², cold kernels | {first['by_frame']['wall'][0]:.0f} | | | |")


def main() -> dict[str, Any] | None:
    parser = arguments_of(__doc__)
    parser.add_argument("--figures", action="store_true", help="the scenes that speed is judged by, as a table")
    parser.add_argument("--scene", choices=("ball", "funnel"), default="ball")
    parser.add_argument("--nodes", type=int, nargs="+", default=[100], help="along each side, one fall each")
    parser.add_argument("--substeps", type=int, default=20)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument(
        "--from-frame", type=int, default=15, help="counted from 1; until then kernels compile and cloth falls"
    )
    parser.add_argument("--by-kernel", action="store_true", help="the time of a GPU in the last frames")
    parser.add_argument("--repeats", type=int, default=20, help="of each part of a substep")
    parser.add_argument("--without-contacts", action="store_true", help="springs and air alone")
    parser.add_argument("--blender", action="store_true", help="also Blender's own cloth")
    parser.add_argument("--as-blender", action="store_true", help="Blender's own cloth alone, and where it lies")
    asked, _ = parser.parse_known_args()
    if asked.figures and (asked.blender or "--nodes" in sys.argv or "--scene" in sys.argv):
        parser.error("--figures has scenes of its own; leave out --scene, --nodes and --blender")
    if asked.as_blender:
        return drop_in_blender(asked.nodes[0], asked.frames)
    arguments = start_taichi(parser)
    if arguments.figures:
        print_figures(arguments)
        return None
    runs = []
    for nodes in arguments.nodes:
        drop = measure(nodes, arguments)
        if arguments.blender:
            drop["blender"] = measure_blender(nodes, arguments.frames, min(arguments.from_frame, arguments.frames) - 1)
            for time_of in ("frame_ms", "frame_processor_ms"):
                drop[f"blender_over_own_{time_of}"] = drop["blender"][time_of]["median"] / drop[time_of]["median"]
        runs.append(drop)
    return {**machine(arguments.device), "runs": runs}


if __name__ == "__main__":
    run(main)
