"""Bounds: where the action is, for a camera that frames it."""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.cache import read_frame, read_smoke_density
from pipeline.job.looks import parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.parameter_set import ParameterSet
from pipeline.stages.base import TaskContext
from pipeline.stages.inputs import estimated_cloth_nodes, most_particles, tool_version
from pipeline.task import ArtifactPath, Resources, Task, TaskId
from sim.rigid.parameters import RigidBodyParameters

if TYPE_CHECKING:
    from render.bounds import Box

ACTION = "action"
"""The film's one box, by this name."""
FILM = TaskId("bounds/film")

BASE_BYTES = 150_000_000
"""Interpreter, numpy, h5py and the meshes of bodies."""
BYTES_PER_PARTICLE = 120
"""The arrays of a snapshot, which are read together, and positions in double precision, sorted."""
BYTES_PER_NODE = 100
BYTES_PER_CELL = 8


class BoundsStage:
    """Boxes around the bodies of each frame, and one around the film; only for `camera.framing = "action"`.

    A file a frame, made while the simulation goes on, so that the last frame is soon followed by the box that all
    pictures wait for. A film whose box stays the same has none of its frames drawn again.
    """

    name = "bounds"
    version = 1

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame, and one for the film; none for a camera that frames the domain or stands by itself."""
        if not job.camera.frames_action:
            return []
        tools = {"numpy": tool_version("numpy")}
        of_frames = ParameterSet.of(stage=self.name, version=self.version, tools=tools)
        meshes = tuple(
            layout.body_mesh(body.name, part)
            for body in job.rigid
            if body.kind != "static"
            for part in parts_of(body.shape.type)
        )
        resources = Resources(memory_bytes=_memory_bytes(job))
        frames = [
            Task(
                id=TaskId(f"bounds/{frame:06d}"),
                stage=self.name,
                inputs=(*meshes, layout.frame_cache(frame)),
                outputs=(layout.frame_bounds(frame),),
                parameters=of_frames,
                frame=frame,
                resources=resources,
            )
            for frame in range(job.frame_count)
        ]
        static = [body for body in job.rigid if body.kind == "static"]
        film = Task(
            id=FILM,
            stage=self.name,
            inputs=(
                *(layout.body_mesh(body.name, part) for body in static for part in parts_of(body.shape.type)),
                *(task.outputs[0] for task in frames),
            ),
            outputs=(layout.film_bounds(),),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools=tools,
                domain=job.domain,
                smoke={smoke.name: smoke.corners(job.domain) for smoke in job.smoke},
                static={body.name: {"position": body.position, "rotation_deg": body.rotation_deg} for body in static},
                tank=job.stage.tank,
            ),
        )
        return [*frames, film]

    def obstacles(self, job: Job) -> list[str]:  # noqa: ARG002
        """None: its packages are always there."""
        return []

    def run(self, context: TaskContext) -> None:
        """Find the boxes of a frame, or that of the film."""
        from render.bounds import validate_bounds, write_bounds

        frame = context.task.frame
        boxes = {ACTION: _of_film(context)} if frame is None else _of_frame(context.job, context.layout, frame)
        with context.committing(context.task.outputs[0], validate_bounds) as path:
            write_bounds(path, boxes)
        context.progress(1, 1)


def read_framed(path: Path) -> Box:
    """The box that the camera of a film frames [m], (2, 3)."""
    from render.bounds import read_bounds

    return read_bounds(path)[ACTION]


def _memory_bytes(job: Job) -> int:
    cells = max((prod(smoke.cell_counts(job.domain)) for smoke in job.smoke), default=0)
    particles = BYTES_PER_PARTICLE * most_particles(job)
    return int(BASE_BYTES + particles + BYTES_PER_NODE * estimated_cloth_nodes(job) + BYTES_PER_CELL * cells)


def _of_frame(job: Job, layout: JobLayout, frame: int) -> dict[str, Box]:
    """The boxes of what there is at a frame, by body."""
    from render.bounds import box_of_particles, box_of_points, box_of_smoke
    from sim.rigid.rotation import rotated

    cached = layout.path(layout.frame_cache(frame))
    boxes = {}
    for name, body in read_frame(cached, kind="fluid").bodies.items():
        if len(body.arrays["position"]):
            boxes[name] = box_of_particles(body.arrays["position"], body.number("particle_radius"))
    for name, body in read_frame(cached, kind="cloth").bodies.items():
        boxes[name] = box_of_points(body.arrays["position"])
    moving = job.moving_bodies
    for name, body in read_frame(cached, kind="rigid").bodies.items():
        if name in moving:
            vertices = _mesh_of(layout, next(each for each in job.rigid if each.name == name))
            position, orientation = (np.asarray(body.arrays[key], np.float64) for key in ("position", "orientation"))
            boxes[name] = box_of_points(position + rotated(orientation, vertices))
    for smoke in job.smoke:
        density, lower, cell_size = read_smoke_density(cached, smoke.name)
        box = box_of_smoke(density, lower, cell_size)
        if box is not None:
            boxes[smoke.name] = box
    return boxes


def _of_film(context: TaskContext) -> Box:
    """The box around all frames and the bodies that stand still, as far as they are in the world."""
    from render.bounds import around, box_of_points, framed_box, read_bounds
    from sim.rigid.rotation import from_degrees, rotated

    job, layout = context.job, context.layout
    domain = np.array([job.domain.min, job.domain.max])
    world = around([domain, *(np.array(smoke.corners(job.domain)) for smoke in job.smoke)])
    assert world is not None
    boxes = [
        box for frame in range(job.frame_count) for box in read_bounds(layout.path(layout.frame_bounds(frame))).values()
    ]
    for body in job.rigid:
        if body.kind == "static":
            turned = rotated(from_degrees(body.rotation_deg), _mesh_of(layout, body))
            boxes.append(box_of_points(np.array(body.position) + turned))
    if job.stage.tank and boxes:
        # Its glass is seen, and walls that the picture cuts off look like a mistake.
        boxes.append(np.array([domain[0], [*domain[1, :2], domain[0, 2]]]))
    return framed_box(around(boxes), domain=domain, world=world)


def _mesh_of(layout: JobLayout, body: RigidBodyParameters) -> NDArray[np.float64]:
    """Vertices of all parts of a body at rest [m], (n, 3)."""
    from render.meshes import read_ply

    files: list[ArtifactPath] = [layout.body_mesh(body.name, part) for part in parts_of(body.shape.type)]
    return np.concatenate([read_ply(layout.path(file)).vertices for file in files]).astype(np.float64)
