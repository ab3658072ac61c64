"""What Blender is told of a job: the scene, and where bodies and camera are at a frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import cos, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cache import read_frame
from pipeline.job.looks import BODY, REFRACTING_LOOKS, parts_of
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.bounds import read_framed
from render.camera_path import CameraPath, View, write_views
from render.point_clouds import KINDS
from render.poses import write_poses
from render.spec import (
    Camera,
    MeshObject,
    MeshSequenceObject,
    MovingMeshObject,
    PointSequenceObject,
    RenderSpec,
    SceneObject,
    VolumeSequenceObject,
)
from sim.fluid.parameters import FluidParameters
from sim.rigid.parameters import RigidBodyParameters

Poses = Mapping[str, Mapping[str, NDArray[Any]]]

WETS_WITHIN_RADII = 1.5
"""How near a fluid's surface is to what it touches, in radii of its particles. It ends 0.05 radii above a floor and a
radius inside of a body where particles rest, and 0.8 above where they move; a layer of one particle is two thick."""


def render_spec(job: Job, layout: JobLayout, framed: NDArray[np.float64] | None = None) -> RenderSpec:
    """The job as Blender sees it; paths are relative to the job's folder. `framed` as in `camera_path`."""
    objects: list[SceneObject] = [
        _body_object(job, layout, body, part) for body in job.rigid for part in parts_of(body.shape.type)
    ]
    objects += [
        MeshSequenceObject(
            name=fluid.name,
            file=f"surfaces/{fluid.name}/{{frame}}.ply",
            material=job.material_of(fluid.name),
            wets_within=_wets_within(job, fluid),
        )
        for fluid in job.fluid
    ]
    objects += [
        MeshSequenceObject(
            name=cloth.name, file=f"cloths/{cloth.name}/{{frame}}.ply", material=job.material_of(cloth.name)
        )
        for cloth in job.cloth
    ]
    objects += [
        PointSequenceObject(
            name=f"{fluid}.{kind}",
            file=f"whitewater/{fluid}/{{frame}}.ply",
            kind=kind,
            material=job.material_of(fluid, kind),
        )
        for fluid in job.whitewater
        for kind in KINDS
    ]
    objects += [
        VolumeSequenceObject(
            name=smoke.name,
            file=f"volumes/{smoke.name}/{{frame}}.vdb",
            box_min=corners[0],
            box_max=corners[1],
            open_faces=smoke.open_faces,
            ambient_temperature=smoke.ambient_temperature,
            material=job.material_of(smoke.name),
        )
        for smoke in job.smoke
        for corners in (smoke.corners(job.domain),)
    ]
    return RenderSpec(
        fps=job.fps,
        domain_min=job.domain.min,
        domain_max=job.domain.max,
        open_faces=job.domain.open_faces,
        camera=Camera.on(camera_path(job, framed), f_stop=job.camera.f_stop, views=layout.views),
        stage=job.stage,
        lights=job.light,
        objects=tuple(objects),
        render=job.render,
    )


def _wets_within(job: Job, fluid: FluidParameters) -> float | None:
    """Within which distance a fluid's surface touches solids [m]; None where nobody sees from inside whether it does.

    A material of one's own may look at it, too.
    """
    look = job.material_of(fluid.name).look
    return None if look is not None and look not in REFRACTING_LOOKS else WETS_WITHIN_RADII * fluid.particle_radius


def _body_object(job: Job, layout: JobLayout, body: RigidBodyParameters, part: str) -> SceneObject:
    """A static body stands where the job puts it; the others are where the poses of the frame say."""
    name = body.name if part == BODY else f"{body.name}.{part}"
    file, material = layout.body_mesh(body.name, part), job.material_of(body.name, part)
    if body.kind == "static":
        orientation = _orientation(body.rotation_deg)
        return MeshObject(name=name, file=file, position=body.position, orientation=orientation, material=material)
    return MovingMeshObject(name=name, file=file, body=body.name, poses=layout.poses, material=material)


def camera_path(job: Job, framed: NDArray[np.float64] | None = None) -> CameraPath:
    """Where the camera of a job goes.

    Args:
        job: the job.
        framed: points that it frames if it frames the action [m], (n, 3); the domain while they are not known.
    """
    width, height = job.render.resolution
    starts = {body.name: body.position for body in job.rigid}
    return CameraPath(
        job.placed_camera, job.domain.min, job.domain.max, aspect=width / height, starts=starts, framed=framed
    )


def framed_points(job: Job, layout: JobLayout) -> NDArray[np.float64] | None:
    """What the camera frames [m], (n, 3), where it frames the action, which a file of the job's folder says."""
    return read_framed(layout.path(layout.film_bounds())) if job.camera.frames_action else None


def write_motion(job: Job, layout: JobLayout, frame: int, *, attempt: int) -> tuple[Poses, View]:
    """Put where bodies and camera are at a frame where Blender finds it; returns it, too.

    These documents are no artifacts, but a form of the cached frame and of the job.

    Args:
        job: the job.
        layout: the folder that holds the cached frame, and gets the documents.
        frame: which frame.
        attempt: names the files that they are written to first.
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
    places = {name: _position_after(0.0, poses[name]) for name in camera.bodies}
    return poses, camera.view(frame / job.fps, places)


def _position_after(time_s: float, pose: Mapping[str, NDArray[Any]]) -> list[float]:
    """Where a body is a short time before or after, its velocity kept [m]."""
    return [float(x) for x in pose["position"] + time_s * pose["velocity"]]


@contextmanager
def _replacing(layout: JobLayout, document: str, frame: int, attempt: int) -> Iterator[Path]:
    """A path to write a frame's document to, which then takes the place of what is there."""
    path = layout.root / document.replace("{frame}", f"{frame:06d}")
    path.parent.mkdir(exist_ok=True)
    part = path.with_name(f".{path.name}.part.{attempt}")
    yield part
    part.replace(path)


def _orientation(rotation_deg: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of rotations about the world's x, then y, then z axis: q = q_z q_y q_x."""
    (cx, sx), (cy, sy), (cz, sz) = ((cos(half), sin(half)) for half in (radians(angle) / 2 for angle in rotation_deg))
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )
