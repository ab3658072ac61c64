"""A submitted job with one body of every kind, whose frames are written by hand."""

from pathlib import Path

import numpy as np
from inline_tasks import run_task

from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import ArtifactPath, Task, TaskId
from pipeline.job.loading import load_job
from pipeline.record.manifest import Manifest
from pipeline.stages.bodies import BodiesStage
from pipeline.store.artifacts import committing
from pipeline.store.cache import validate_frame, write_frame
from pipeline.store.receipts import Receipt, read_receipt
from render.bounds import Reach, reach_of_box, validate_bounds, write_bounds
from render.meshes import validate_ply, write_ply
from render.point_clouds import PointCloud, validate_point_cloud, write_point_cloud
from sim.core.snapshots import Snapshot
from sim.core.world import FrameReport

JOB = """
name = "everything"
frames = {frames}
fps = 30
[domain]
min = [0.0, 0.0, 0.0]
max = [1.0, 1.0, 1.0]
[camera]
{camera}
[whitewater.water]
[[fluid]]
name = "water"
[[fluid.block]]
shape = {{ type = "box", size = [0.3, 0.3, 0.3] }}
position = [0.2, 0.2, 0.2]
[[rigid]]
name = "ball"
kind = "dynamic"
density = 600.0
shape = {{ type = "sphere", radius = 0.1 }}
position = [0.7, 0.3, 0.7]
[[cloth]]
name = "flag"
shape = {{ type = "rectangle", size = [0.4, 0.4], counts = [5, 5] }}
position = [0.5, 0.5, 0.9]
[[cloth.pin]]
edge = "x-"
release_s = 0.1
[[smoke]]
name = "plume"
cell_size = 0.05
source = [{{ shape = {{ type = "sphere", radius = 0.1 }}, position = [0.7, 0.7, 0.1] }}]
"""
PARTICLES = 1000
CELLS = (20, 20, 20)


def submitted(folder: Path, *, frames: int = 10, camera: str = "") -> JobLayout:
    """The job without a single frame."""
    layout = JobLayout(folder)
    layout.root.mkdir(parents=True)
    layout.job_file.write_text(JOB.format(frames=frames, camera=camera))
    with Manifest(layout.manifest) as manifest:
        manifest.record_plan([])
    for task in BodiesStage().plan(load_job(layout.job_file), layout):
        run_task(task, layout)
    return layout


def bodies_at(frame: int) -> dict[str, Snapshot]:
    """Where everything is: water slides along x, the ball falls, the flag sinks, the smoke rises."""
    grid = np.stack(np.meshgrid(*[np.linspace(0.05, 0.35, 10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    water = np.add(grid, (0.05 * frame, 0.0, 0.0)).astype(np.float32)
    velocity = np.zeros_like(water)
    velocity[:, 0] = np.linspace(0.0, 2.0, PARTICLES)
    flag = np.stack(np.meshgrid(np.linspace(0.3, 0.7, 5), np.linspace(0.3, 0.7, 5)), axis=-1).reshape(-1, 2)
    sheet = np.column_stack([flag, np.full(25, 0.9 - 0.02 * frame)]).astype(np.float32)
    corners = [[i, i + 1, i + 5] for j in range(4) for i in range(5 * j, 5 * j + 4)]
    corners += [[i + 1, i + 6, i + 5] for j in range(4) for i in range(5 * j, 5 * j + 4)]
    density = np.zeros(CELLS, np.float32)
    density[12:16, 12:16, 0 : 4 + frame] = 1.0
    temperature = np.where(density > 0.0, np.float32(350.0), np.float32(300.0))
    return {
        "water": Snapshot(
            "fluid",
            {
                "position": water,
                "velocity": velocity,
                "density": np.linspace(980.0, 1020.0, PARTICLES).astype(np.float32),
                "particle_id": np.arange(PARTICLES, dtype=np.int32),
            },
            {"particle_radius": 0.015, "rest_density": 1000.0},
        ),
        "ball": Snapshot(
            "rigid",
            {
                "position": np.array([0.7, 0.3, 0.7 - 0.03 * frame]),
                "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
                "velocity": np.zeros(3),
                "angular_velocity": np.zeros(3),
            },
            {},
        ),
        "flag": Snapshot(
            "cloth",
            {
                "position": sheet,
                "velocity": np.zeros_like(sheet),
                "triangles": np.array(corners, np.int32),
                "uv": sheet[:, :2].copy(),
            },
            {"thickness": 0.001},
        ),
        "plume": Snapshot(
            "smoke",
            {"density": density, "temperature": temperature, "velocity": np.zeros((*CELLS, 3), np.float32)},
            {"origin": (0.0, 0.0, 0.0), "cell_size": 0.05, "ambient_temperature": 300.0},
        ),
    }


def commit(layout: JobLayout, frame: int, *, fingerprint: str = "f", energy: float | None = None) -> Receipt:
    """A frame as the simulation commits it; the water's kinetic energy [J] is that of its number if omitted."""
    task = _task("simulate", "simulate", layout.frame_cache(frame))
    numbers = {
        "kinetic_energy": float(frame**2) if energy is None else energy,
        "potential_energy": 5.0,
        "max_speed": 2.0,
        "density_error": 0.001,
    }
    report = FrameReport(frame, frame / 30, {"water": 12}, {"water": 1.25e-3}, {"water": numbers})
    with committing(
        layout, task.outputs[0], task=task, attempt=1, fingerprint=fingerprint, validate=validate_frame
    ) as new:
        write_frame(new.path, bodies_at(frame), report, device="cpu", longest_shutter_s=1.0 / 60)
    return new.receipt


def commit_surface(layout: JobLayout, cached: Receipt, frame: int, *, dye: list[float] | None = None) -> Receipt:
    """A surface of the water, made from a frame: a triangle, with the dye of its vertices if there is any."""
    path = layout.surface("water", frame)
    vertices = bodies_at(frame)["water"].arrays["position"][[0, 9, 90]]
    with committing(
        layout,
        path,
        task=_task(f"surface/water/{frame:06d}", "surface", path),
        attempt=1,
        fingerprint="s",
        validate=validate_ply,
        inputs={cached.artifact: cached.hash},
    ) as new:
        write_ply(new.path, vertices, [[0, 1, 2]], dye=None if dye is None else np.array(dye)[:, None])
    return new.receipt


def commit_spray(layout: JobLayout, cached: Receipt, frame: int, *, points: int = 50) -> Receipt:
    """Whitewater, made from a frame."""
    return _commit_points(layout, "whitewater", layout.whitewater("water", frame), cached, frame, points)


def commit_drops(layout: JobLayout, cached: Receipt, frame: int, *, points: int = 30) -> Receipt:
    """Drops of the water's spray, made from a frame."""
    return _commit_points(layout, "spray", layout.drops("water", frame), cached, frame, points)


def _commit_points(
    layout: JobLayout, stage: str, path: ArtifactPath, cached: Receipt, frame: int, points: int
) -> Receipt:
    places = np.random.default_rng(frame).uniform(0.2, 0.8, (points, 3)).astype(np.float32)
    ones = np.full(points, 0.005, np.float32)
    with committing(
        layout,
        path,
        task=_task(f"{stage}/water/{frame:06d}", stage, path),
        attempt=1,
        fingerprint="w",
        validate=validate_point_cloud,
        inputs={cached.artifact: cached.hash},
    ) as new:
        write_point_cloud(new.path, PointCloud(places, places * 0, ones, ones, np.zeros(points, np.uint8)))
    return new.receipt


def commit_bounds(layout: JobLayout, frames: int) -> None:
    """Bounds of so many frames as they are now, and of the film."""
    reach = {"action": reach_of_box(np.array([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]]))}
    hashes = {}
    for frame in range(frames):
        cached = read_receipt(layout, layout.frame_cache(frame))
        hashes |= _commit_reach(layout, layout.frame_bounds(frame), {cached.artifact: cached.hash}, reach)
    _commit_reach(layout, layout.film_bounds(), hashes, reach)


def _commit_reach(layout: JobLayout, path: str, inputs: dict[str, str], reach: dict[str, Reach]) -> dict[str, str]:
    task = _task(f"bounds/{path}", "bounds", path)
    with committing(
        layout, path, task=task, attempt=1, fingerprint="b", validate=validate_bounds, inputs=inputs
    ) as new:
        write_bounds(new.path, reach)
    return {path: new.receipt.hash}


def _task(name: str, stage: str, output: str) -> Task:
    return Task(TaskId(name), stage, (), (output,), ParameterSet.of(stage=stage, version=1, tools={}))
