"""A frame of a job, read from its cache and from what was made from that, as bodies that can be drawn."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.base.errors import InvalidArtifactError, MissingInputError
from pipeline.base.layout import JobLayout
from pipeline.model.job import Job
from pipeline.stages.render_scene import camera_path, framed_points
from pipeline.store.cache import FrameNumbers, read_numbers
from pipeline.web.drawing.bodies import SPEED, every, own, read_bodies
from pipeline.web.drawing.shapes import Body, Particles, Pose, arrays_of
from pipeline.web.viewer.committed import CommittedFrames
from render.camera_path import View
from render.errors import InvalidFileError
from render.meshes import SurfaceMesh, read_ply
from render.point_clouds import read_point_cloud


@dataclass(frozen=True)
class ShownFrame:
    """A frame as it is drawn, everything by the names of bodies."""

    numbers: FrameNumbers  # number and time of the frame, and what the solvers told
    bodies: Mapping[str, Body] = field(default_factory=dict)  # the bodies
    whitewater: Mapping[str, Particles] = field(default_factory=dict)  # particles
    drops: Mapping[str, Particles] = field(default_factory=dict)  # of the spray of fluids
    # of fluids, where the surface stage has made them
    surfaces: Mapping[str, SurfaceMesh] = field(default_factory=dict)
    view: View | None = None  # of the film's camera; None while it is not known
    troubles: tuple[str, ...] = ()  # files that could not be read, in sentences

    @property
    def clouds(self) -> dict[str, Particles]:
        """The bodies of points."""
        return {name: body for name, body in self.bodies.items() if isinstance(body, Particles)}

    @property
    def bytes(self) -> int:
        """Memory of its arrays [bytes]."""
        parts = (*self.bodies.values(), *self.whitewater.values(), *self.drops.values(), *self.surfaces.values())
        return sum(array.nbytes for part in parts for array in arrays_of(part))


def read_shown_frame(
    job: Job, layout: JobLayout, committed: CommittedFrames, frame: int, *, most_particles: int, surfaces: bool = True
) -> ShownFrame:
    """Read a committed frame; files that are missing yet are left out, those that are damaged are told.

    Of a fluid `most_particles` are kept; its surface takes longer to read than all the rest.

    Raises InvalidArtifactError: the cached frame itself cannot be read.
    """
    path = layout.path(layout.frame_cache(frame))
    try:
        numbers = read_numbers(path)
        bodies = read_bodies(path, numbers.kinds, most_particles)
    except (KeyError, TypeError, ValueError) as error:  # readable, but not what a frame holds
        raise InvalidArtifactError(f"{path}: lacks what a frame has: {error}") from error
    meshes: dict[str, SurfaceMesh] = {}
    whitewater: dict[str, Particles] = {}
    drops: dict[str, Particles] = {}
    troubles: list[str] = []
    for fluid in job.fluid:
        surface = layout.surface(fluid.name, frame)
        cloud, spray = layout.whitewater(fluid.name, frame), layout.drops(fluid.name, frame)
        try:
            if surfaces and committed.derived(frame, surface):
                mesh = read_ply(layout.path(surface))
                meshes[fluid.name] = SurfaceMesh(own(mesh.vertices), own(mesh.faces))
            if fluid.name in job.whitewater and committed.derived(frame, cloud):
                whitewater[fluid.name] = _points("whitewater", layout.path(cloud), most_particles)
            if committed.derived(frame, spray):
                drops[fluid.name] = _points("drops", layout.path(spray), most_particles)
        except (InvalidFileError, OSError) as error:
            troubles.append(f"frame {frame}: {error}; see: pipeline verify")
    return ShownFrame(
        numbers,
        bodies=bodies,
        whitewater=whitewater,
        drops=drops,
        surfaces=meshes,
        view=_view(job, layout, committed, frame, bodies),
        troubles=tuple(troubles),
    )


def _points(kind: str, path: Path, most: int) -> Particles:
    cloud = read_point_cloud(path)
    count = len(cloud.position)
    chosen = slice(None, None, every(count, most))
    radius = float(cloud.radius.mean()) if count else 0.0
    speed = np.linalg.norm(cloud.velocity[chosen], axis=1).astype(np.float32)
    return Particles(kind, own(cloud.position[chosen]), {SPEED: speed}, radius, None, count)


def _view(
    job: Job, layout: JobLayout, committed: CommittedFrames, frame: int, bodies: Mapping[str, Body]
) -> View | None:
    """The camera's view at a frame; None as long as the film's bounds are not known, which it may frame."""
    if job.camera.frames_action and not committed.bounds_are_known(job, frame):
        return None
    try:
        path = camera_path(job, framed_points(job, layout))
    except (InvalidFileError, InvalidArtifactError, MissingInputError, OSError):
        return None
    poses = {name: body.position.tolist() for name, body in bodies.items() if isinstance(body, Pose)}
    if any(name not in poses for name in path.bodies):
        return None
    return path.view(frame / job.fps, {name: poses[name] for name in path.bodies})
