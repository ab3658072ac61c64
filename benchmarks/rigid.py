"""Speed of rigid bodies that fall into a pit or a bowl; JSON on the standard output.

    python -m benchmarks.rigid --bodies 30 200 1000 [--hulls] [--frames 90] [--blender] [--fast]

Boxes of 10 cm, each turned in its own way, fall in layers onto each other between four walls; with `--hulls` meshes of
convex stones of that size fall into a bowl instead. Times are of whole frames at 60 frames a second; of the frames the
median counts, and the most. The processor time of all threads stands beside it, as other programs on the same cores do
not enter it. With `--blender` Blender's own rigid bodies (bpy of this Python) do the same fall of the same bodies, with
Blender's usual 10 steps and 10 iterations a frame, stones as convex hulls and the bowl as a mesh; how deep bodies are
in each other and in walls in the end, and how fast, is measured in both by our own contacts.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from benchmarks.compare import arguments_of, child, machine, run, spread, start_taichi, timed
from sim.core.motion import rotation
from sim.rigid.parameters import RigidBodyParameters
from sim.scene import SceneParameters

if TYPE_CHECKING:
    from sim.rigid.solver import RigidSolver

EDGE, PITCH = 0.1, 0.18
"""Edge of a box, and the distance of their centres at the start [m]: turned boxes do not touch."""

FRAMES_PER_SECOND = 60.0
DENSITY, FRICTION = 500.0, 0.5
WALL = 0.5  # thickness of Blender's walls [m]
FAST = 60.0  # [m/s]


def places(count: int, along: int, pitch: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where bodies start in square layers [m], (n, 3), the lowest at half a pitch, and their turns [degrees]."""
    layer, place = np.divmod(np.arange(count), along * along)
    row, column = np.divmod(place, along)
    middle = 0.5 * (along - 1)
    positions = pitch * np.stack([column - middle, row - middle, layer + 0.5], axis=1)
    return positions, np.random.default_rng(1).uniform(-180.0, 180.0, (count, 3))


def boxes_in_a_pit(count: int) -> SceneParameters:
    """The fall of so many boxes."""
    along = max(2, round((count / 2.0) ** (1.0 / 3.0)))
    positions, turns = places(count, along, PITCH)
    half = 0.5 * along * PITCH
    shape = {"type": "box", "size": (EDGE,) * 3}
    domain = {"min": (-half, -half, 0.0), "max": (half, half, positions[-1, 2] + 1.0)}
    return SceneParameters.model_validate({"domain": domain, "rigid": bodies(shape, positions, turns)})


def hulls_in_a_bowl(count: int, mesh: Path) -> SceneParameters:
    """The fall of so many stones, whose mesh is written to a file."""
    points = np.random.default_rng(3).normal(size=(40, 3))
    points *= np.array([0.6, 0.5, 0.4]) * EDGE / np.linalg.norm(points, axis=1, keepdims=True)
    trimesh.convex.convex_hull(points).export(mesh)
    size = count ** (1.0 / 3.0)
    radius = 1.12 * EDGE * size
    positions, turns = places(count, max(2, round(1.1 * size)), 1.3 * EDGE)
    angles = np.linspace(0.0, 0.5 * np.pi, 24)
    arc = np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    outer = radius + 0.5 * EDGE
    outline = [*(radius * arc), (radius, radius), (outer, radius), *(outer * arc[::-1])]
    bowl = {
        "kind": "static",
        "name": "bowl",
        "friction": FRICTION,
        "position": (0.0, 0.0, outer),
        "shape": {"type": "revolved", "profile": [tuple(map(float, point)) for point in outline]},
    }
    positions[:, 2] += outer - 0.4 * radius
    rigid = [bowl, *bodies({"type": "mesh", "file": str(mesh)}, positions, turns)]
    domain = {"min": (-2.0 * radius, -2.0 * radius, 0.0), "max": (2.0 * radius, 2.0 * radius, positions[-1, 2] + 1.0)}
    return SceneParameters.model_validate({"domain": domain, "rigid": rigid})


def bodies(shape: dict[str, Any], positions: NDArray[np.float64], turns: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Dynamic bodies of one shape."""
    alike = {"kind": "dynamic", "density": DENSITY, "friction": FRICTION, "shape": shape}
    return [
        {**alike, "name": f"body{number}", "position": tuple(position), "rotation_deg": tuple(turn)}
        for number, (position, turn) in enumerate(zip(positions, turns, strict=True))
    ]


def measure(parameters: SceneParameters, frames: int) -> dict[str, Any]:
    """Our own fall."""
    from sim.build import build_world
    from sim.rigid.solver import RigidSolver

    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    times = [timed(world.advance_frame) for _ in range(frames)]
    solver = next(each for each in world.solvers.values() if isinstance(each, RigidSolver))
    return {**frame_times(times), "contacts": solver.diagnostics()["contacts"], "result": described(solver)}


def with_fast_ball(parameters: SceneParameters) -> SceneParameters:
    """The same scene, made wider, with a ball in the room beside it that flies to and fro."""
    low, high = np.array(parameters.domain.min), np.array(parameters.domain.max)
    ball = {
        "name": "fast",
        "kind": "dynamic",
        "density": DENSITY,
        "friction": 0.0,
        "restitution": 1.0,
        "shape": {"type": "sphere", "radius": 0.5 * EDGE},
        "position": (high[0] + 5.0 * EDGE, 0.5 * (low[1] + high[1]), low[2] + EDGE),
        "velocity": (0.0, FAST, 0.0),
    }
    divider = {
        "name": "divider",
        "friction": FRICTION,
        "shape": {"type": "box", "size": (EDGE, *(2.0 * (high - low)[1:]))},
        "position": (high[0] + 0.5 * EDGE, *(0.5 * (low + high)[1:])),
    }
    document = parameters.model_dump(exclude_unset=True)
    document["rigid"] = [divider, *document["rigid"], ball]  # the order of the others stays, and with it their bits
    document["domain"] = {**document["domain"], "max": (high[0] + 10.0 * EDGE, *high[1:])}
    return SceneParameters.model_validate(document)


def measure_fast(parameters: SceneParameters, frames: int) -> dict[str, Any]:
    """Processor times of frames with a fast ball over those without."""
    from sim.build import build_world

    worlds = [
        build_world(each, frames_per_second=FRAMES_PER_SECOND) for each in (parameters, with_fast_ball(parameters))
    ]
    times = np.array([[timed(world.advance_frame)[1] for world in worlds] for _ in range(frames)])[1:]
    return {
        "frame_processor_ms": spread(1e3 * times[:, 1]),
        "median_over_without": float(np.median(times[:, 1] / times[:, 0])),
        "sum_over_without": float(times[:, 1].sum() / times[:, 0].sum()),
    }


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

    count = len(solver.all_geometries)
    moves = np.arange(count) < len(solver.bodies)
    detector = CollisionDetector(solver.all_geometries, solver.walls, len(solver.bodies))
    detector.find(solver.poses(), np.zeros(count + 1), moves)
    found = detector.contacts()
    depth = np.maximum(-found.gap, 0.0)
    speed = np.sqrt(np.square(solver.bodies.velocity).sum(axis=1))
    return {
        "deepest_mm": 1e3 * float(depth.max(initial=0.0)),
        "rms_depth_mm": 1e3 * float(np.sqrt(np.mean(np.square(depth)))),
        "rms_speed": float(np.sqrt(np.mean(np.square(speed)))),
        "mean_height": float(solver.bodies.position[:, 2].mean()),
    }


def measure_blender(parameters: SceneParameters, frames: int, file: Path) -> dict[str, Any]:
    """Blender's rigid bodies, in a process of its own, to which the scene goes by a file."""
    from sim.build import build_world
    from sim.rigid.solver import RigidSolver

    file.write_text(parameters.model_dump_json(exclude_unset=True))
    answer = child(["-m", "benchmarks.rigid", "--as-blender", str(file), "--frames", str(frames)])
    world = build_world(parameters, frames_per_second=FRAMES_PER_SECOND)
    solver = next(each for each in world.solvers.values() if isinstance(each, RigidSolver))
    before, after = (np.array(answer.pop(name)) for name in ("before", "after"))
    solver.bodies.position, solver.bodies.orientation = after[:, :3], after[:, 3:]
    solver.bodies.velocity = (after[:, :3] - before[:, :3]) * FRAMES_PER_SECOND
    times = frame_times(answer.pop("times"))
    return {**answer, **times, "result": described(solver)}


def fall_in_blender(parameters: SceneParameters, frames: int) -> dict[str, Any]:
    """The same fall by Blender itself: times of frames [s], and the last two poses of each body. Needs bpy."""
    import bpy

    from sim.shapes.body_geometry import BodyGeometry

    bpy.ops.wm.read_factory_settings(use_empty=True)
    stage = bpy.context.scene
    stage.render.fps = round(FRAMES_PER_SECOND)
    bpy.ops.rigidbody.world_add()
    stage.rigidbody_world.collection = bpy.data.collections.new("bodies")
    stage.rigidbody_world.point_cache.frame_end = frames + 1
    meshes: dict[Any, tuple[Any, BodyGeometry]] = {}

    def add(rigid: RigidBodyParameters) -> Any:
        if rigid.shape not in meshes:
            geometry = BodyGeometry(rigid)
            rest = geometry.solid.rest_mesh()
            mesh = bpy.data.meshes.new("body")
            mesh.from_pydata((rest.vertices - geometry.centre_of_mass).tolist(), [], rest.faces.tolist())
            meshes[rigid.shape] = mesh, geometry
        mesh, geometry = meshes[rigid.shape]
        item = bpy.data.objects.new("body", mesh)
        item.rotation_mode, item.rotation_quaternion = "QUATERNION", rotation.from_degrees(rigid.rotation_deg)
        arm = rotation.rotated(np.array([item.rotation_quaternion]), geometry.centre_of_mass[None])[0]
        item.location = np.asarray(rigid.position) + arm
        stage.collection.objects.link(item)
        stage.rigidbody_world.collection.objects.link(item)
        body = item.rigid_body
        body.friction, body.restitution = rigid.friction, 0.0
        body.type = "ACTIVE" if rigid.kind == "dynamic" else "PASSIVE"
        body.collision_shape = {"box": "BOX", "mesh": "CONVEX_HULL", "revolved": "MESH"}[rigid.shape.type]
        if rigid.kind == "dynamic":
            body.mass = geometry.mass_properties(rigid.density).mass
        else:
            body.use_margin, body.collision_margin = True, 0.0
        return item

    low, high = np.array(parameters.domain.min), np.array(parameters.domain.max)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    for axis, side in ((2, -1.0), (0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)):
        size, place = 4.0 * half, middle.copy()
        size[axis] = WALL
        place[axis] += side * (half[axis] + 0.5 * WALL)
        shape = {"type": "box", "size": tuple(size)}
        add(RigidBodyParameters(name="wall", shape=shape, position=tuple(place), friction=FRICTION))
    items = [add(rigid) for rigid in parameters.rigid]
    moving = [item for item, rigid in zip(items, parameters.rigid, strict=True) if rigid.kind == "dynamic"]

    def poses() -> list[list[float]]:
        return [[*item.matrix_world.translation, *item.matrix_world.to_quaternion()] for item in moving]

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
    parser.add_argument("--hulls", action="store_true", help="stones into a bowl instead of boxes into a pit")
    parser.add_argument("--blender", action="store_true", help="also Blender's own rigid bodies")
    parser.add_argument("--fast", action="store_true", help="also with a fast ball beside it")
    parser.add_argument("--as-blender", type=Path, help=argparse.SUPPRESS)
    asked, _ = parser.parse_known_args()
    if asked.as_blender:
        return fall_in_blender(SceneParameters.model_validate_json(asked.as_blender.read_text()), asked.frames)
    arguments = start_taichi(parser)
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        for count in arguments.bodies:
            stone, file = Path(folder, "stone.ply"), Path(folder, "scene.json")
            parameters = hulls_in_a_bowl(count, stone) if arguments.hulls else boxes_in_a_pit(count)
            fall = {"bodies": count, **measure(parameters, arguments.frames)}
            if arguments.fast:
                fall["with_fast_ball"] = measure_fast(parameters, arguments.frames)
            if arguments.blender:
                fall["blender"] = measure_blender(parameters, arguments.frames, file)
                for time_of in ("seconds", "processor_seconds"):
                    fall[f"own_over_blender_{time_of}"] = fall[time_of] / fall["blender"][time_of]
            runs.append(fall)
    return {**machine(arguments.device), "runs": runs}


if __name__ == "__main__":
    run(main)
