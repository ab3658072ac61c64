"""Bounds: where the action is, for a camera that frames it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.parameter_set import ParameterSet
from pipeline.base.task import Resources, Task, TaskId
from pipeline.kinds.base import Work
from pipeline.kinds.rigid import meshes_at_rest, rest_vertices
from pipeline.kinds.table import bodies, scene_boxes
from pipeline.model.boxes import ALL, overlap, simulated_regions
from pipeline.model.job import Job
from pipeline.stages.base import FILE_S, FileWork, Stage, TaskContext
from pipeline.store.cache import open_bodies
from render.bounds import (
    Reach,
    around,
    corners_of,
    framed,
    reach_of_box,
    reach_of_points,
    read_bounds,
    validate_bounds,
    write_bounds,
)
from sim.core.motion.rotation import from_degrees, rotated

ACTION = "action"  # the film's one reach, by this name
FILM = TaskId("bounds/film")

BASE_BYTES = 150_000_000  # interpreter, numpy, h5py and the meshes of bodies


class BoundsStage(Stage):
    """How far the bodies of each frame reach, and those of the film; only for `camera.framing = "action"`.

    A file a frame, made while the simulation goes on, so that the last frame is soon followed by the one that all
    pictures wait for. A film whose reach stays the same has none of its frames drawn again.
    """

    name = "bounds"
    about = "how far things reach, for the camera"
    version = 2

    def plan(self, job: Job, layout: JobLayout) -> list[Task]:
        """One task a frame, and one for the film; none for a camera that frames the domain or stands by itself."""
        if not job.camera.frames_action:
            return []
        tools = {"numpy": tool_version("numpy")}
        of_frames = ParameterSet.of(stage=self.name, version=self.version, tools=tools)
        meshes = meshes_at_rest([body for body in job.rigid if body.kind != "static"])
        # Bodies are read one after the other; the cells of a smoke are few bytes each, and only one smoke's at a time.
        in_memory = BASE_BYTES + sum(kind.reach_bytes * kind.elements(job, body) for _, kind, body in bodies(job))
        resources = Resources(memory_bytes=int(in_memory))
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
        endless = [smoke.name for smoke in job.smoke if smoke.grid == "open"]
        film = Task(
            id=FILM,
            stage=self.name,
            inputs=(
                *meshes_at_rest(static),
                *(task.outputs[0] for task in frames),
            ),
            outputs=(layout.film_bounds(),),
            parameters=ParameterSet.of(
                stage=self.name,
                version=self.version,
                tools=tools,
                domain=job.domain,
                smoke={smoke.name: smoke.corners(job.domain) for smoke in job.smoke},
                **({"endless": endless} if endless else {}),
                static={body.name: {"position": body.position, "rotation_deg": body.rotation_deg} for body in static},
                tank=job.has_panes,
                **({"beside": beside} if (beside := _beside(job)) else {}),
            ),
        )
        return [*frames, film]

    def work(self, job: Job, elements: Mapping[str, float], *, on_gpu: bool) -> FileWork:  # noqa: ARG002
        """Little."""
        return FileWork("frame", Work(0.0, FILE_S))

    def run(self, context: TaskContext) -> None:
        """Find how far a frame's bodies reach, or the film's."""
        frame = context.task.frame
        reaches = {ACTION: _of_film(context)} if frame is None else _of_frame(context.job, context.layout, frame)
        with context.committing(context.task.outputs[0], validate_bounds) as path:
            write_bounds(path, reaches)
        context.progress(1, 1)


def read_framed(path: Path) -> NDArray[np.float64]:
    """The points that the camera of a film frames [m], (n, 3): corners of a convex body around the action."""
    return corners_of(read_bounds(path)[ACTION])


def _beside(job: Job) -> list[list[list[float]]]:
    """Boxes of bodies that reach out of the domain and the smokes, which are of the world, too."""
    regions = simulated_regions(job)
    boxes = [box for box in scene_boxes(job) if all(overlap(box, region) < ALL for region in regions)]
    return [box.tolist() for box in boxes]


def _of_frame(job: Job, layout: JobLayout, frame: int) -> dict[str, Reach]:
    """How far what there is at a frame reaches, by body."""
    with open_bodies(layout.path(layout.frame_cache(frame))) as groups:
        there = [(kind, body, groups[body.name]) for _, kind, body in bodies(job) if body.name in groups]
        reaches = {body.name: kind.reach(job, layout, body, group) for kind, body, group in there}
    return {name: reach for name, reach in reaches.items() if reach is not None}


def _of_film(context: TaskContext) -> Reach:
    """How far all frames and the bodies that stand still reach, as far as they are in the world."""
    job, layout = context.job, context.layout
    domain = np.array([job.domain.min, job.domain.max])
    smokes = [smoke.limits(job.domain) for smoke in job.smoke]
    boxes = np.concatenate([[domain, *smokes], scene_boxes(job)])
    world = np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    reaches = [
        reach
        for frame in range(job.frame_count)
        for reach in read_bounds(layout.path(layout.frame_bounds(frame))).values()
    ]
    for body in job.rigid:
        if body.kind == "static":
            turned = rotated(from_degrees(body.rotation_deg), rest_vertices(layout, body))
            reaches.append(reach_of_points(np.array(body.position) + turned))
    if job.has_panes and reaches:
        # Its glass is seen, and walls that the picture cuts off look like a mistake.
        reaches.append(reach_of_box(np.array([domain[0], [*domain[1, :2], domain[0, 2]]])))
    return framed(around(reaches), domain=domain, world=world)
