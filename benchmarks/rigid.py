"""Speed of rigid bodies that fall into a pit; JSON on the standard output.

    python -m benchmarks.rigid --bodies 30 200 1000 [--frames 90] [--blender]

Boxes of 10 cm, each turned in its own way, fall in layers onto each other between four walls. Times are of whole frames
at 60 frames a second; of the frames the median counts, and the most. The processor time of all threads stands beside
it, as other programs on the same cores do not enter it. With `--blender` Blender's own rigid bodies (bpy of this
Python) do the same fall of the same boxes, with Blender's usual 10 steps and 10 iterations a frame; how deep boxes are
in each other and in walls in the end, and how fast, is measured in both by our own contacts.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.compare import arguments_of, child, machine, run, spread, start_taichi, timed
from sim.scene import SceneParameters

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver

EDGE, PITCH = 0.1, 0.18
"""Edge of a box, and the distance of their centres at the start [m]: turned boxes do not touch."""

FRAMES_PER_SECOND = 60.0
DENSITY, FRICTION = 500.0, 0.5
WALL = 0.5  # thickness of Blender's walls [m]


def places(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Where the boxes start [m], (n, 3), how they are turned [degrees], (n, 3), and how many stand along an edge."""
    along = max(2, round((count / 2.0) ** (1.0 / 3.0)))
    layer, place = np.divmod(np.arange(count), along * along)
    row, column = np.divmod(place, along)
    middle = 0.5 * (along - 1)
    positions = PITCH * np.stack([column - middle, row - middle, layer + 0.5], axis=1)
    return positions, np.random.default_rng(1).uniform(-180.0, 180.0, (count, 3)), along


def scene(count: int) -> SceneParameters:
    """The fall of so many boxes."""
    positions, turns, along = places(count)
    half = 0.5 * along * PITCH
    box = {"kind": "dynamic", "density": DENSITY, "friction": FRICTION, "shape": {"type": "box", "size": (EDGE,) * 3}}
    return SceneParameters.model_validate(
        {
            "domain": {"min": (-half, -half, 0.0), "max": (half, half, positions[-1, 2] + 1.0)},
            "rigid": [
                {**box, "name": f"box{number}", "position": tuple(position), "rotation_deg": tuple(turn)}
                for number, (position, turn) in enumerate(zip(positions, turns, strict=True))
            ],
        }
    )


def measure(count: int, frames: int) -> dict[str, Any]:
    """Our own fall."""
    from sim.build import build_world
    from sim.rigid.solver import RigidSolver

    parameters = scene(count)
    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    times = [timed(world.advance_frame) for _ in range(frames)]
    solver = next(each for each in world.solvers.values() if isinstance(each, RigidSolver))
    return {**frame_times(times), "contacts": solver.diagnostics()["contacts"], "result": described(solver)}


def frame_times(times: list[tuple[float, float]]) -> dict[str, Any]:
    """Wall and processor times of frames; the first, in which kernels are read, is told apart."""
    wall, processor = zip(*times, strict=True)
    return {
        "first_frame_s": wall[0],
        "frame_ms": spread(wall[1:], scale=1e3),
        "frame_processor_ms": spread(processor[1:], scale=1e3),
        "seconds": sum(wall[1:]),
        "processor_seconds": sum(processor[1:]),
    }


def described(solver: RigidSolver) -> dict[str, float]:
    """How deep bodies are in each other and in walls [mm], and how fast they are [m/s]."""
    from sim.rigid.collision import CollisionDetector

    count = len(solver.bodies)
    detector = CollisionDetector(solver.all_geometries, solver.walls)
    nothing = np.zeros(0, dtype=np.int64)
    found = detector.find(solver.poses(), np.zeros(count + 1), nothing, np.ones(count, dtype=bool))
    depth = np.maximum(-found.gap, 0.0)
    speed = np.sqrt(np.square(solver.bodies.velocity).sum(axis=1))
    return {
        "deepest_mm": 1e3 * float(depth.max(initial=0.0)),
        "rms_depth_mm": 1e3 * float(np.sqrt(np.mean(np.square(depth)))),
        "rms_speed": float(np.sqrt(np.mean(np.square(speed)))),
        "mean_height": float(solver.bodies.position[:, 2].mean()),
    }


def measure_blender(count: int, frames: int) -> dict[str, Any]:
    """Blender's rigid bodies, in a process of its own."""
    from sim.build import build_world
    from sim.rigid.solver import RigidSolver

    answer = child(["-m", "benchmarks.rigid", "--as-blender", "--bodies", str(count), "--frames", str(frames)])
    world = build_world(scene(count), frames_per_second=FRAMES_PER_SECOND)
    solver = next(each for each in world.solvers.values() if isinstance(each, RigidSolver))
    before, after = (np.array(answer.pop(name)) for name in ("before", "after"))
    solver.bodies.position, solver.bodies.orientation = after[:, :3], after[:, 3:]
    solver.bodies.velocity = (after[:, :3] - before[:, :3]) * FRAMES_PER_SECOND
    times = frame_times(answer.pop("times"))
    return {**answer, **times, "result": described(solver)}


def fall_in_blender(count: int, frames: int) -> dict[str, Any]:
    """The same fall by Blender itself: times of frames [s], and the last two poses of each box. Needs bpy."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.render.fps = round(FRAMES_PER_SECOND)
    bpy.ops.rigidbody.world_add()
    stage.rigidbody_world.collection = bpy.data.collections.new("bodies")
    stage.rigidbody_world.point_cache.frame_end = frames + 1
    positions, turns, along = places(count)
    half, height = 0.5 * along * PITCH, positions[-1, 2] + 1.0

    def add(size: tuple[float, float, float], place: Any, turn: Any, kind: str) -> Any:
        corners = 0.5 * np.array(size) * [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
        faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        mesh = bpy.data.meshes.new("box")
        mesh.from_pydata(corners.tolist(), [], faces)
        box = bpy.data.objects.new("box", mesh)
        box.location, box.rotation_euler = place, np.radians(turn)
        stage.collection.objects.link(box)
        stage.rigidbody_world.collection.objects.link(box)
        body = box.rigid_body
        body.type, body.collision_shape, body.friction, body.restitution = kind, "BOX", FRICTION, 0.0
        if kind == "ACTIVE":
            body.mass = DENSITY * float(np.prod(size))
        return box

    straight = (0.0, 0.0, 0.0)
    add((4.0 * half, 4.0 * half, WALL), (0.0, 0.0, -0.5 * WALL), straight, "PASSIVE")
    for side in (-1.0, 1.0):
        away = side * (half + 0.5 * WALL)
        add((WALL, 4.0 * half, height), (away, 0.0, 0.5 * height), straight, "PASSIVE")
        add((4.0 * half, WALL, height), (0.0, away, 0.5 * height), straight, "PASSIVE")
    boxes = [
        add((EDGE,) * 3, place, turn, "ACTIVE") for place, turn in zip(positions.tolist(), turns.tolist(), strict=True)
    ]

    def poses() -> list[list[float]]:
        return [[*box.matrix_world.translation, *box.matrix_world.to_quaternion()] for box in boxes]

    stage.frame_set(1)
    times: list[tuple[float, float]] = []
    before: list[list[float]] = []
    for frame in range(2, frames + 2):
        before = poses() if frame == frames + 1 else before
        times.append(timed(lambda frame=frame: stage.frame_set(frame)))
    return {"blender": bpy.app.version_string, "times": times, "before": before, "after": poses()}


def main() -> dict[str, Any]:
    parser = arguments_of(__doc__)
    parser.add_argument("--bodies", type=int, nargs="+", default=[30, 200, 1000], help="one fall each")
    parser.add_argument("--frames", type=int, default=90)
    parser.add_argument("--blender", action="store_true", help="also Blender's own rigid bodies")
    parser.add_argument("--as-blender", action="store_true", help=argparse.SUPPRESS)
    asked, _ = parser.parse_known_args()
    if asked.as_blender:
        return fall_in_blender(asked.bodies[0], asked.frames)
    arguments = start_taichi(parser)
    runs = []
    for count in arguments.bodies:
        fall = {"bodies": count, **measure(count, arguments.frames)}
        if arguments.blender:
            fall["blender"] = measure_blender(count, arguments.frames)
            for time_of in ("seconds", "processor_seconds"):
                fall[f"own_over_blender_{time_of}"] = fall[time_of] / fall["blender"][time_of]
        runs.append(fall)
    return {**machine(arguments.device), "runs": runs}


if __name__ == "__main__":
    run(main)
