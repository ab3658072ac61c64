"""The visibility of bodies in a frame: from the files that it is drawn from, before it is drawn."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.layout import JobLayout
from pipeline.kinds.table import drawn_bodies
from pipeline.model.job import Job
from pipeline.stages.base import TaskContext
from render.camera_path import View
from render.meshes import read_ply
from render.point_clouds import read_point_cloud
from render.spec import MeshObject, MeshSequenceObject, PointSequenceObject, VolumeSequenceObject
from render.visibility import covered_cells, in_picture, is_inside, points_of_box
from sim.core.motion.rotation import rotated

Array = NDArray[np.float64]

MOST_POINTS = 20_000  # of a body that are looked for in the picture; of more, every second, third, ...
LEAST_SHARE = 0.005  # of the picture that bodies must cover for it to be sure that something is to be seen
ROUND_THE_DOMAIN = 0.02  # how far a body may reach out of the domain, in edges of it, and still be in front of the set
NOTHING_SEEN, CAMERA_INSIDE = "nothing in the picture", "camera inside"


@dataclass(frozen=True)
class BodyAtFrame:
    """A body at a frame."""

    name: str
    points: Array  # on or in it [m], (n, 3); none while it is not there
    faces: NDArray[np.int32] | None = None  # triangles of these points if they are those of a mesh, (k, 3)
    closed: bool = False  # whether the mesh has an inside


def warn_if_invisible(context: TaskContext, view: View, bodies: Sequence[BodyAtFrame]) -> None:
    """Warn if nothing of the scene is in the picture of a frame, or the camera is inside of something.

    A picture may be meant so, or be empty as nothing has begun yet, so this is no failure.
    """
    frame = context.task.frame
    assert frame is not None
    width, height = context.job.render.resolution
    for body in bodies:
        if body.closed and body.faces is not None and is_inside(view.position, body.points, body.faces):
            context.warn(CAMERA_INSIDE, f'frame {frame}: the camera is inside "{body.name}"; see [camera]')
            return
    points = [body.points[:: 1 + len(body.points) // MOST_POINTS] for body in bodies if len(body.points)]
    if points and not in_picture(view, np.concatenate(points), aspect=width / height).any():
        context.warn(NOTHING_SEEN, f"frame {frame}: nothing of the scene is in the picture; see [camera]")


def bodies_at(
    job: Job, layout: JobLayout, frame: int, poses: Mapping[str, Mapping[str, NDArray[Any]]]
) -> Iterator[BodyAtFrame]:
    """All drawn bodies at a frame; of a smoke, its whole box."""
    read: set[str] = set()
    for kind, body, drawn in drawn_bodies(job, layout):
        if isinstance(drawn, VolumeSequenceObject):
            yield BodyAtFrame(body.name, points_of_box(drawn.box_min, drawn.box_max))
            continue
        path = layout.root / drawn.file.replace("{frame}", f"{frame:06d}")
        if isinstance(drawn, PointSequenceObject):
            if drawn.file not in read:  # each kind of whitewater is an object of one file
                points = read_point_cloud(path).position.astype(np.float64)
                yield BodyAtFrame(f"{Path(drawn.file).parts[0]} of {body.name}", points)
            read.add(drawn.file)
            continue
        mesh = read_ply(path)
        points = mesh.vertices.astype(np.float64)
        if not isinstance(drawn, MeshSequenceObject):
            pose = vars(drawn) if isinstance(drawn, MeshObject) else poses[body.name]
            points = np.array(pose["position"]) + rotated(np.array(pose["orientation"]), points)
        yield BodyAtFrame(body.name, points, mesh.faces, closed=kind.is_closed)


def expected_cells(
    job: Job, view: View, bodies: Sequence[BodyAtFrame], shape: tuple[int, int]
) -> NDArray[np.bool_] | None:
    """The cells (rows, columns) where a picture must differ from the empty set; None if none surely must.

    Rigid bodies, fluids and cloths count, as far as they are in the domain: ground and backdrop may hide what is not.
    From below the ground it hides all.
    Smoke and spray may be too thin to be seen.
    """
    lower, upper = np.array(job.domain.min), np.array(job.domain.max)
    if view.position[2] < lower[2]:
        return None  # the ground may hide everything
    slack = ROUND_THE_DOMAIN * (upper - lower)
    width, height = job.render.resolution
    cells, share = np.zeros(shape, np.bool_), 0.0
    for body in bodies:
        if body.faces is None or not len(body.faces):
            continue
        inside = ((body.points >= lower - slack) & (body.points <= upper + slack)).all(axis=1)
        faces = body.faces[inside[body.faces].all(axis=1)]
        covered, of_picture = covered_cells(view, body.points, faces, shape=shape, aspect=width / height)
        cells |= covered
        share += of_picture
    return cells if min(share, cells.mean()) >= LEAST_SHARE else None
