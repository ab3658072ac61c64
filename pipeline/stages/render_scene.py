"""The scene that Blender is given of a job, and the places of bodies and camera at a frame."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.table import scene_objects, scene_points
from pipeline.model.job import Job
from pipeline.stages.bounds import read_framed
from pipeline.store.cache import read_frame
from render.camera_path import CameraPath, View, write_views
from render.poses import write_poses
from render.spec import Camera, RenderSpec

Poses = Mapping[str, Mapping[str, NDArray[Any]]]


def render_spec(job: Job, layout: JobLayout, framed: NDArray[np.float64] | None = None) -> RenderSpec:
    """The job as Blender sees it; paths are relative to the job's folder. `framed` as in `camera_path`."""
    return RenderSpec(
        fps=job.fps,
        domain_min=job.domain.min,
        domain_max=job.domain.max,
        open_faces=job.domain.open_faces,
        camera=Camera.on(camera_path(job, framed), f_stop=job.camera.f_stop, views=layout.views),
        set=job.set,
        lights=job.light,
        objects=tuple(scene_objects(job, layout)),
        render=job.render,
    )


def camera_path(job: Job, framed: NDArray[np.float64] | None = None) -> CameraPath:
    """The path of a job's camera.

    `framed` are points that it frames if it frames the action [m], (n, 3); the whole scene while they are not known.
    """
    width, height = job.render.resolution
    starts = {body.name: body.position for body in job.rigid}
    framed = scene_points(job) if framed is None else framed
    return CameraPath(
        job.placed_camera, job.domain.min, job.domain.max, aspect=width / height, starts=starts, framed=framed
    )


def framing_files(job: Job, layout: JobLayout) -> list[ArtifactPath]:
    """The file that says what the camera frames, where it frames the action."""
    return [layout.film_bounds()] if job.camera.frames_action else []


def framed_points(job: Job, layout: JobLayout) -> NDArray[np.float64] | None:
    """What the camera frames [m], (n, 3), where it frames the action, which a file of the job's folder says."""
    return read_framed(layout.path(layout.film_bounds())) if job.camera.frames_action else None


def write_motion(job: Job, layout: JobLayout, frame: int, *, attempt: int) -> tuple[Poses, View]:
    """Write where bodies and camera are at a frame into the job's folder, for Blender; returns it, too.

    These documents are no artifacts, but a form of the cached frame and of the job. `attempt` names the files that they
    are written to first.
    """
    bodies, camera = job.moving_bodies, camera_path(job, framed_points(job, layout))
    cached = read_frame(layout.path(layout.frame_cache(frame)), kind="rigid").bodies if bodies else {}
    poses = {name: cached[name].arrays for name in bodies}
    if bodies:
        with _replacing(layout, layout.poses, frame, attempt) as path:
            write_poses(path, frame, poses)
    if camera.moves:
        reach = job.render.reach_of_motion
        views = {}
        for offset in sorted({-reach, 0.0, reach}):
            places = {name: _position_after(offset / job.fps, poses[name]) for name in camera.bodies}
            views[offset] = camera.view((frame + offset) / job.fps, places)
        with _replacing(layout, layout.views, frame, attempt) as path:
            write_views(path, frame, views)
    return poses, view_at(job, camera, frame, poses)


def view_at(job: Job, camera: CameraPath, frame: int, poses: Poses) -> View:
    """The view of a camera at a frame, of bodies with these poses."""
    return camera.view(frame / job.fps, {name: _position_after(0.0, poses[name]) for name in camera.bodies})


def _position_after(time_s: float, pose: Mapping[str, NDArray[Any]]) -> list[float]:
    """Position of a body a short time before or after, at constant velocity [m]."""
    return [float(x) for x in pose["position"] + time_s * pose["velocity"]]


@contextmanager
def _replacing(layout: JobLayout, document: str, frame: int, attempt: int) -> Iterator[Path]:
    """A path to write a frame's document to, which then takes the place of what is there."""
    path = layout.root / document.replace("{frame}", f"{frame:06d}")
    path.parent.mkdir(exist_ok=True)
    part = path.with_name(f".{path.name}.part.{attempt}")
    yield part
    part.replace(path)
