"""Rigid bodies: meshes at rest, which the poses of a frame place."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from math import cos, radians, sin
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.base import Display, Kind, Materials, Product, Solids, Work
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.live_parameters import RIGID_LIVE
from pipeline.kinds.sizes import boxes_of_body, size_of_solid
from pipeline.kinds.work import rigid_work
from pipeline.model.job import Job
from pipeline.model.looks import BODY, natural_materials, parts_of
from pipeline.model.problems import Findings
from render.bounds import Reach, reach_of_points
from render.meshes import read_ply, validate_ply, with_sharp_edges, write_ply
from render.spec import MeshObject, MeshSequenceObject, MovingMeshObject, SceneObject
from sim.core.motion.rotation import rotated
from sim.core.snapshots import Snapshot
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import AnimationShape

if TYPE_CHECKING:
    import h5py

SHARP_DEG = 40.0
"""Edges of animated meshes that are sharper stay sharp, as those of meshes at rest do."""
BASE_BYTES = 400_000_000
"""Interpreter, numpy, h5py and a mesh of half a million triangles."""
ANIMATED_BYTES, ANIMATED_S = 1.0e6, 0.1
"""About what a mesh of ten thousand triangles takes."""


def _check(job: Job, solids: Solids, _budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.animated_bodies import check_animated_bodies
    from pipeline.kinds.checks.joints import check_anchors
    from pipeline.kinds.checks.rigid import check_ballast, check_pieces, check_places, check_rigid_start

    check_places(job, solids, findings)
    check_rigid_start(job, solids, findings)
    check_ballast(job, solids, findings)
    check_pieces(job, solids, findings)
    check_anchors(job, solids, findings)
    check_animated_bodies(job, solids, findings)
    return 0


def _objects(_job: Job, layout: JobLayout, body: RigidBodyParameters, material_of: Materials) -> Iterator[SceneObject]:
    """A static body stands where the job puts it; the others are where the poses of the frame say, or their meshes."""
    if is_animated(body):
        yield MeshSequenceObject(name=body.name, file=ANIMATED.file_of(body.name), material=material_of(BODY))
        return
    for part in parts_of(body.shape):
        name = body.name if part == BODY else f"{body.name}.{part}"
        file, material = layout.body_mesh(body.model, part), material_of(part)
        if body.kind == "static":
            orientation = _orientation(body.rotation_deg)
            yield MeshObject(name=name, file=file, position=body.position, orientation=orientation, material=material)
        else:
            yield MovingMeshObject(name=name, file=file, body=body.name, poses=layout.poses, material=material)


def _orientation(rotation_deg: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z) of rotations about the world's x, then y, then z axis: q = q_z q_y q_x."""
    (cx, sx), (cy, sy), (cz, sz) = ((cos(half), sin(half)) for half in (radians(angle) / 2 for angle in rotation_deg))
    return (
        cx * cy * cz + sx * sy * sz,
        sx * cy * cz - cx * sy * sz,
        cx * sy * cz + sx * cy * sz,
        cx * cy * sz - sx * sy * cz,
    )


def _reach(_job: Job, layout: JobLayout, body: RigidBodyParameters, group: h5py.Group) -> Reach | None:
    """How far a body that moves reaches; one that stands still is of the film, not of a frame."""
    if body.kind == "static":
        return None
    if is_animated(body):
        return reach_of_points(group["vertices"][()])
    position, orientation = (np.asarray(group[key][()], np.float64) for key in ("position", "orientation"))
    return reach_of_points(position + rotated(orientation, rest_vertices(layout, body)))


def meshes_at_rest(bodies: Iterable[RigidBodyParameters]) -> tuple[ArtifactPath, ...]:
    """Files of the meshes of bodies at rest, each once; what a file animates has none."""
    still = (body for body in bodies if not is_animated(body))
    files = (JobLayout.body_mesh(body.model, part) for body in still for part in parts_of(body.shape))
    return tuple(dict.fromkeys(files))


def rest_vertices(layout: JobLayout, body: RigidBodyParameters) -> NDArray[np.float64]:
    """Vertices of all parts of a body at rest [m], (n, 3)."""
    paths = [layout.path(file) for file in meshes_at_rest([body])]
    return np.concatenate([_vertices(path, path.stat().st_mtime_ns) for path in paths]).astype(np.float64)


@lru_cache(maxsize=64)  # bodies of a group share them
def _vertices(path: Path, _mtime_ns: int) -> NDArray[np.float32]:
    return read_ply(path).vertices


def is_animated(body: RigidBodyParameters) -> bool:
    """Whether a file moves and deforms the mesh of a body."""
    return isinstance(body.shape, AnimationShape)


def _write_animated(path: Path, body: Snapshot, _job: Job, _threads: int) -> None:
    arrays = body.arrays
    vertices, velocities, faces, normals = with_sharp_edges(
        arrays["vertices"], arrays["vertex_velocities"], arrays["triangles"], angle_deg=SHARP_DEG
    )
    write_ply(path, vertices, faces, normals=normals, velocities=velocities)


ANIMATED = Product(
    stage="animated",
    about="meshes of animated bodies",
    version=1,
    of=is_animated,
    folder="animated",
    suffix=".ply",
    tools=lambda _job: {"numpy": tool_version("numpy")},
    memory_bytes=lambda _job, _body: BASE_BYTES,
    write=_write_animated,
    validate=validate_ply,
    file_bytes=lambda _body, _elements: ANIMATED_BYTES,
    work=lambda _job, _body, _elements: Work(0.0, ANIMATED_S),
)

RIGID = Kind(
    name="rigid",
    parameters=RigidBodyParameters,
    about="Rigid bodies.",
    work=rigid_work,
    material=lambda body: natural_materials(body.shape),
    look_size=size_of_solid,
    boxes=boxes_of_body,
    placements=lambda job, index: iter([((), job.rigid[index])]),
    check=_check,
    shares_solver=lambda body: body.kind != "static",
    product=ANIMATED,
    objects=_objects,
    reach=_reach,
    display=Display("Rigid bodies", "parts"),
    live=RIGID_LIVE,
)
