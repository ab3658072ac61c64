"""One frame of a job, read from its cache and from what was made from that, as arrays that can be drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.cache import FrameNumbers, read_frame, read_numbers, read_smoke_density
from pipeline.errors import InvalidArtifactError
from pipeline.job.models import Job
from pipeline.layout import JobLayout
from pipeline.stages.render_scene import camera_path, framed_points
from pipeline.view.committed import CommittedFrames
from render.camera_path import View
from render.errors import InvalidFileError
from render.meshes import SurfaceMesh, read_ply
from render.point_clouds import read_point_cloud
from sim.snapshots import BodyKind, Snapshot

Floats = NDArray[np.float32]
DENSE_KINDS: tuple[BodyKind, ...] = ("fluid", "rigid", "cloth")
"""Kinds of bodies whose arrays are read whole; of a smoke only the cells that are not empty."""
PRESSURE = "pressure"
SPEED = "speed"
"""Computed from the velocities; every other value that particles are coloured by is an array of the cache."""


@dataclass(frozen=True)
class Particles:
    """Particles of a fluid, or of its whitewater.

    Attributes:
        position: [m], (n, 3).
        values: what they can be coloured by, (n,) each, by name.
        radius: of a particle [m].
        rest_density: of the fluid [kg/m³]; None of whitewater.
        count: how many there are, of which n are shown.
    """

    position: Floats
    values: Mapping[str, Floats]
    radius: float
    rest_density: float | None
    count: int


@dataclass(frozen=True)
class Sheet:
    """A cloth.

    Attributes:
        position: of its nodes [m], (n, 3).
        triangles: (k, 3) int32.
    """

    position: Floats
    triangles: NDArray[np.int32]


@dataclass(frozen=True)
class Pose:
    """Where a rigid body is.

    Attributes:
        position: [m], (3,).
        orientation: unit quaternion w, x, y, z, (4,).
    """

    position: NDArray[np.float64]
    orientation: NDArray[np.float64]


@dataclass(frozen=True)
class Smoke:
    """The cells of a smoke that are not empty.

    Attributes:
        density: (nx, ny, nz) [-].
        origin: lower corner of the first cell [m].
        cell_size: [m].
    """

    density: Floats
    origin: tuple[float, float, float]
    cell_size: float


@dataclass(frozen=True)
class ShownFrame:
    """All that is drawn of a frame, bodies by name.

    Attributes:
        numbers: number and time of the frame, and what the solvers told.
        fluids, whitewater: particles.
        surfaces: of fluids, where the surface stage has made them.
        cloths, poses, smokes: the other bodies.
        view: of the film's camera; None while it is not known.
        troubles: what could not be read, in sentences.
    """

    numbers: FrameNumbers
    fluids: Mapping[str, Particles] = field(default_factory=dict)
    whitewater: Mapping[str, Particles] = field(default_factory=dict)
    surfaces: Mapping[str, SurfaceMesh] = field(default_factory=dict)
    cloths: Mapping[str, Sheet] = field(default_factory=dict)
    poses: Mapping[str, Pose] = field(default_factory=dict)
    smokes: Mapping[str, Smoke] = field(default_factory=dict)
    view: View | None = None
    troubles: tuple[str, ...] = ()

    @property
    def bytes(self) -> int:
        """What its arrays take in memory."""
        arrays: list[NDArray[Any] | None] = []
        for cloud in (*self.fluids.values(), *self.whitewater.values()):
            arrays += [cloud.position, *cloud.values.values()]
        for mesh in self.surfaces.values():
            arrays += [mesh.vertices, mesh.faces]
        for sheet in self.cloths.values():
            arrays += [sheet.position, sheet.triangles]
        arrays += [smoke.density for smoke in self.smokes.values()]
        return sum(array.nbytes for array in arrays if array is not None)


def read_shown_frame(
    job: Job, layout: JobLayout, committed: CommittedFrames, frame: int, *, most_particles: int, surfaces: bool = True
) -> ShownFrame:
    """Read a committed frame; what of it is missing yet is left out, what is spoilt is told.

    Args:
        job: the job.
        layout: its folder, which is only read.
        committed: its frames, this one among them.
        frame: its number.
        most_particles: of a fluid that are kept; of more, every second, third, ... by their numbers, so that the same
            ones are seen in every frame.
        surfaces: whether to read the fluids' surfaces, which take longer than all the rest.

    Raises:
        InvalidArtifactError: the cached frame itself cannot be read.
    """
    path = layout.path(layout.frame_cache(frame))
    try:
        return _read(job, layout, committed, frame, most_particles=most_particles, surfaces=surfaces)
    except (KeyError, TypeError, ValueError) as error:  # readable, but not what a frame holds
        raise InvalidArtifactError(f"{path}: lacks what a frame has: {error}") from error


def every(count: int, most: int) -> int:
    """1 if so many particles may all be shown, else which of them: every second, third, ..."""
    return max(1, -(-count // max(1, most)))


def _read(
    job: Job, layout: JobLayout, committed: CommittedFrames, frame: int, *, most_particles: int, surfaces: bool
) -> ShownFrame:
    path = layout.path(layout.frame_cache(frame))
    numbers = read_numbers(path)
    kinds = frozenset(numbers.kinds.values())
    smokes = {name: Smoke(*read_smoke_density(path, name)) for name, kind in numbers.kinds.items() if kind == "smoke"}
    bodies = {kind: read_frame(path, kind=kind).bodies for kind in DENSE_KINDS if kind in kinds}
    fluids = {name: _particles(body, most_particles) for name, body in bodies.get("fluid", {}).items()}
    poses = {
        name: Pose(*(np.asarray(body.arrays[key], np.float64) for key in ("position", "orientation")))
        for name, body in bodies.get("rigid", {}).items()
    }
    cloths = {
        name: Sheet(_floats(body, "position"), np.asarray(body.arrays["triangles"], np.int32))
        for name, body in bodies.get("cloth", {}).items()
    }
    meshes: dict[str, SurfaceMesh] = {}
    whitewater: dict[str, Particles] = {}
    troubles: list[str] = []
    for fluid in job.fluid:
        surface = layout.surface(fluid.name, frame)
        cloud = layout.whitewater(fluid.name, frame)
        try:
            if surfaces and committed.derived(frame, surface):
                mesh = read_ply(layout.path(surface))
                meshes[fluid.name] = SurfaceMesh(_own(mesh.vertices), _own(mesh.faces))
            if fluid.name in job.whitewater and committed.derived(frame, cloud):
                whitewater[fluid.name] = _whitewater(layout, fluid.name, frame, most_particles)
        except (InvalidFileError, OSError) as error:
            troubles.append(f"frame {frame}: {error}; see: pipeline verify")
    return ShownFrame(
        numbers,
        fluids=fluids,
        whitewater=whitewater,
        surfaces=meshes,
        cloths=cloths,
        poses=poses,
        smokes=smokes,
        view=_view(job, layout, committed, frame, poses),
        troubles=tuple(troubles),
    )


def _particles(body: Snapshot, most: int) -> Particles:
    position = _floats(body, "position")
    count = len(position)
    step = every(count, most)
    if step == 1:
        chosen: Any = slice(None)
    elif "particle_id" in body.arrays:
        chosen = np.asarray(body.arrays["particle_id"], np.int64) % step == 0
    else:
        chosen = slice(None, None, step)
    values = {
        name: _own(np.asarray(array[chosen], np.float32))
        for name, array in body.arrays.items()
        if array.shape == (count,) and np.issubdtype(array.dtype, np.floating)
    }
    if "velocity" in body.arrays:
        values[SPEED] = np.linalg.norm(_floats(body, "velocity")[chosen], axis=1).astype(np.float32)
    rest_density = body.number("rest_density") if "rest_density" in body.attributes else None
    return Particles(_own(position[chosen]), values, body.number("particle_radius"), rest_density, count)


def _whitewater(layout: JobLayout, fluid: str, frame: int, most: int) -> Particles:
    cloud = read_point_cloud(layout.path(layout.whitewater(fluid, frame)))
    count = len(cloud.position)
    chosen = slice(None, None, every(count, most))
    radius = float(cloud.radius.mean()) if count else 0.0
    speed = np.linalg.norm(cloud.velocity[chosen], axis=1).astype(np.float32)
    return Particles(_own(cloud.position[chosen]), {SPEED: speed}, radius, None, count)


def _view(
    job: Job, layout: JobLayout, committed: CommittedFrames, frame: int, poses: Mapping[str, Pose]
) -> View | None:
    """The camera's view at a frame; None as long as the film's bounds are not known, which it may frame."""
    if job.camera.frames_action and not committed.bounds_are_known(job, frame):
        return None
    try:
        path = camera_path(job, framed_points(job, layout))
    except (InvalidFileError, InvalidArtifactError, OSError):
        return None
    if any(name not in poses for name in path.bodies):
        return None
    return path.view(frame / job.fps, {name: poses[name].position.tolist() for name in path.bodies})


def _own(array: NDArray[Any]) -> NDArray[Any]:
    """An array that keeps no larger one in memory."""
    base = array.base
    return array if base is None or (isinstance(base, np.ndarray) and base.nbytes == array.nbytes) else array.copy()


def _floats(body: Snapshot, name: str) -> Floats:
    return np.asarray(body.arrays[name], np.float32)
