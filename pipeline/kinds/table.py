"""The table of kinds, and what follows from it for a whole job.

A new kind of body is a module beside this one and a row here; see docs/architecture.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatchcase
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, create_model

from blender_scripts.look_table import LOOK_TABLE
from blender_scripts.optics import INSIDES, usual_density
from pipeline.base.layout import JobLayout
from pipeline.base.task import ArtifactPath
from pipeline.kinds.base import Kind
from pipeline.kinds.cloth import CLOTH
from pipeline.kinds.embers import EMBERS
from pipeline.kinds.fluid import FLUID
from pipeline.kinds.rigid import RIGID
from pipeline.kinds.smoke import SMOKE
from pipeline.kinds.soft import SOFT
from pipeline.model.boxes import domain_box
from pipeline.model.job import Job
from pipeline.model.looks import BODY, POINTS, SOLID, WHITEWATER
from pipeline.model.positions import KeyPath
from render.camera_path import corners_of_boxes
from render.parameters import MaterialParameters
from render.spec import (
    MeshObject,
    MeshSequenceObject,
    MovingMeshObject,
    PointSequenceObject,
    SceneObject,
    VolumeSequenceObject,
)
from sim.scene import SceneParameters
from sim.shapes.parameters import Placement

if TYPE_CHECKING:
    from sim.core.world import World

KINDS: dict[str, Kind] = {kind.name: kind for kind in (RIGID, FLUID, CLOTH, SOFT, SMOKE, EMBERS)}
"""Every kind by its name, in the order in which a job's bodies are listed."""


def register(kind: Kind) -> None:
    """Add a kind to the table: jobs may have tables of it from now on.

    Raises ValueError: its name is taken, by a kind or by another key of the job file.
    """
    if kind.name in KINDS or kind.name in Job.model_fields:
        raise ValueError(f'"{kind.name}" is a key of the job file already')
    KINDS[kind.name] = kind


def job_type() -> type[Job]:
    """The model of the job file, with a table for each kind."""
    return _job_type(tuple(KINDS))


@cache
def _job_type(names: tuple[str, ...]) -> type[Job]:
    fields: dict[str, Any] = {
        name: (tuple[KINDS[name].parameters, ...], Field(default=(), description=KINDS[name].about))  # type: ignore[misc]
        for name in names
        if name not in SceneParameters.model_fields
    }
    return create_model("Job", __base__=Job, **fields) if fields else Job


def bodies(job: SceneParameters) -> Iterator[tuple[KeyPath, Kind, Any]]:
    """Every body of a job with the path of its table and its kind."""
    for kind in KINDS.values():
        for index, body in enumerate(kind.bodies(job)):
            yield (kind.name, index), kind, body


def world_of(job: Job) -> World:
    """The world of a job in its initial state, with the solvers of all kinds; as of `sim.build.build_world`."""
    from sim.build import build_world

    makers = [kind.solvers for kind in KINDS.values() if kind.solvers is not None]
    more = [solver for make in makers for solver in make(job, job.fps)]
    return build_world(job, frames_per_second=job.fps, solvers=more)


def placements(job: Job) -> Iterator[tuple[KeyPath, Placement]]:
    """Every solid that a job places, with the path of its table."""
    for path, kind, _ in bodies(job):
        for below, placement in kind.placements(job, int(path[1])):
            yield (*path, *below), placement


def scene_boxes(job: Job) -> NDArray[np.float64]:
    """What a camera shows that shows the whole scene: the domain, and boxes of bodies beside it, (n, 2, 3) [m].

    Bodies that reach farther from the domain than its diagonal are ground or backdrop, and no subject. Of what lies
    below the ground nothing is seen. Raises MissingInputError: a mesh file cannot be read.
    """
    domain = domain_box(job.domain)
    reach = float(np.linalg.norm(domain[1] - domain[0]))
    beside = [box for _, kind, body in bodies(job) for box in kind.boxes(job, body)]
    low, high = domain[0] - reach, domain[1] + reach
    near = [box for box in beside if (box >= low).all() and (box <= high).all() and box[1, 2] > domain[0, 2]]
    boxes: NDArray[np.float64] = np.stack([domain, *near])
    boxes[..., 2] = np.maximum(boxes[..., 2], domain[0, 2])
    return boxes


def scene_points(job: Job) -> NDArray[np.float64] | None:
    """Corners of the boxes of `scene_boxes` [m], (n, 3), for a camera that frames them; None for one that has a place.

    Raises as `scene_boxes`.
    """
    return corners_of_boxes(scene_boxes(job)) if job.camera.frames else None


def products_of(job: Job, layout: JobLayout, frame: int) -> list[tuple[Kind, Any, ArtifactPath]]:
    """Every body that has a file of its own in each frame, its kind, and the file."""
    return [
        (kind, body, layout.product(kind.product.folder, body.name, frame, kind.product.suffix))
        for _, kind, body in bodies(job)
        if kind.product is not None and kind.product.of(body)
    ]


def points_of(job: Job, layout: JobLayout, frame: int) -> list[ArtifactPath]:
    """Files of the points of each frame: drops of fluids, and whitewater."""
    drops = [layout.drops(fluid.name, frame) for fluid in job.fluid]
    return drops + [layout.whitewater(fluid, frame) for fluid in job.whitewater]


_RANKS: dict[type, int] = {
    MeshObject: 0,
    MovingMeshObject: 0,
    MeshSequenceObject: 1,
    PointSequenceObject: 2,
    VolumeSequenceObject: 3,
}


def drawn_bodies(job: Job, layout: JobLayout) -> Iterator[tuple[Kind, Any, SceneObject]]:
    """Every object that the renderer draws, with its body and that one's kind."""
    for _, kind, body in bodies(job):
        for drawn in kind.objects(job, layout, body, partial(_drawn_material, job, kind, body)):
            yield kind, body, drawn


def scene_objects(job: Job, layout: JobLayout) -> list[SceneObject]:
    """Objects that the renderer draws of all bodies: solids first, volumes last."""
    return sorted((drawn for _, _, drawn in drawn_bodies(job, layout)), key=lambda drawn: _RANKS[type(drawn)])


# --- materials ---


def _drawn_material(job: Job, kind: Kind, body: Any, part: str) -> MaterialParameters:
    """Material of a part as it is drawn: as dense as it is said to be, or as suits the size of the body."""
    material = material_of(job, body.name, part)
    if material.look not in INSIDES or material.density is not None:
        return material
    density = usual_density(material.look, kind.look_size(job, body), material.color)
    return material.model_copy(update={"density": density})


def material_of(job: Job, body: str, part: str = BODY) -> MaterialParameters:
    """Material of a body, or of a part of it or of its whitewater: from the job file, else as is usual.

    Caustics are asked for only of what bends light: they change the light of the whole scene.
    """
    material = described_material(job, body, part)
    if material.caustics and not (material.look and LOOK_TABLE[material.look].refracts):
        return material.model_copy(update={"caustics": False})
    return material


def described_material(job: Job, body: str, part: str = BODY) -> MaterialParameters:
    """The same with every key that the job file gives, also those that have no effect.

    A table of the body's own name counts most, then that of its group, then those of names with `*`.
    """
    usual = _usual_material(job, body, part)
    if part != BODY and part not in WHITEWATER:
        is_own = usual != _usual_material(job, body, BODY)
        look = (of_body := described_material(job, body)).look
        # Drops of a clear liquid are too small to refract in a picture; those of others look like it.
        keeps = (not look or LOOK_TABLE[look].refracts) if part in POINTS else look and LOOK_TABLE[look].paints_parts
        usual = usual if keeps and is_own else of_body
    ending = "" if part == BODY else f".{part}"
    names = tuple(f"{each}{ending}" for each in dict.fromkeys((job.groups.get(body, body), body)))
    said = [job.material[written] for written in job.material if written not in names and is_meant(written, names[-1])]
    for material in [*said, *(job.material.get(name) for name in names)]:
        usual = usual if material is None else material.upon(usual)
    return usual


def is_meant(written: str, name: str) -> bool:
    """Whether a table of materials, as `ball` or `ball*.spray`, is about a body or a part of one."""
    (owner, _, part), (body, _, its_part) = written.partition("."), name.partition(".")
    return fnmatchcase(body, owner) and fnmatchcase(its_part, part)


def _usual_material(job: Job, name: str, part: str) -> MaterialParameters:
    """Material of a part of a body that the job file does not describe."""
    if part in POINTS:
        return POINTS[part]
    name = job.groups.get(name, name)
    there = (kind.material(body) for _, kind, body in bodies(job) if getattr(body, "group", body.name) == name)
    found = next(there, {BODY: SOLID})
    return found.get(part, found[BODY])
