"""What the camera of a frame has in front of it: from the files that the frame is drawn from, before it is drawn."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.job.looks import parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.base import TaskContext
from render.camera_path import View
from render.meshes import read_ply
from render.point_clouds import read_point_cloud
from render.visibility import in_picture, is_inside, points_of_box

Array = NDArray[np.float64]

MOST_POINTS = 20_000
"""Of a body that are looked for in the picture; of more, every second, third, ..."""
NOTHING_SEEN, CAMERA_INSIDE = "nothing in the picture", "camera inside"


@dataclass(frozen=True)
class BodyAtFrame:
    """Where a body is.

    Attributes:
        name: of the body.
        points: on or in it [m], (n, 3); none while it is not there.
        faces: triangles of these points if they are those of a closed mesh, (k, 3).
    """

    name: str
    points: Array
    faces: NDArray[np.int32] | None = None


def warn_of_sight(context: TaskContext, view: View, poses: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
    """Warn if nothing of the scene is in the picture of a frame, or the camera is inside of something.

    A picture may be meant so, or be empty as nothing has begun yet, so this is no failure.

    Args:
        context: of a frame's task, whose inputs are there.
        view: of the camera at the frame.
        poses: `position` [m] and `orientation` of the moving bodies.
    """
    job, frame = context.job, context.task.frame
    assert frame is not None
    width, height = job.render.resolution
    bodies = list(bodies_at(job, context.layout, frame, poses))
    for body in bodies:
        if body.faces is not None and is_inside(view.position, body.points, body.faces):
            context.warn(CAMERA_INSIDE, f'frame {frame}: the camera is inside "{body.name}"; see [camera]')
            return
    points = [body.points[:: 1 + len(body.points) // MOST_POINTS] for body in bodies if len(body.points)]
    if points and not in_picture(view, np.concatenate(points), aspect=width / height).any():
        context.warn(NOTHING_SEEN, f"frame {frame}: nothing of the scene is in the picture; see [camera]")


def bodies_at(
    job: Job, layout: JobLayout, frame: int, poses: Mapping[str, Mapping[str, NDArray[Any]]]
) -> Iterator[BodyAtFrame]:
    """Where everything that is drawn is at a frame; of a smoke, its whole box."""
    from sim.rigid.rotation import from_degrees, rotated

    for body in job.rigid:
        if body.kind == "static":
            position, orientation = np.array(body.position), from_degrees(body.rotation_deg)
        else:
            position, orientation = poses[body.name]["position"], poses[body.name]["orientation"]
        for part in parts_of(body.shape.type):
            mesh = read_ply(layout.path(layout.body_mesh(body.name, part)))
            yield BodyAtFrame(body.name, position + rotated(orientation, mesh.vertices.astype(np.float64)), mesh.faces)
    for fluid in job.fluid:
        mesh = read_ply(layout.path(layout.surface(fluid.name, frame)))
        yield BodyAtFrame(fluid.name, mesh.vertices.astype(np.float64), mesh.faces)
    for cloth in job.cloth:
        yield BodyAtFrame(
            cloth.name, read_ply(layout.path(layout.cloth(cloth.name, frame))).vertices.astype(np.float64)
        )
    for name in job.whitewater:
        cloud = read_point_cloud(layout.path(layout.whitewater(name, frame)))
        yield BodyAtFrame(f"whitewater of {name}", cloud.position.astype(np.float64))
    for smoke in job.smoke:
        yield BodyAtFrame(smoke.name, points_of_box(*smoke.corners(job.domain)))
