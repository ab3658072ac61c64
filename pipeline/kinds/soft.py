"""Soft matter: grains as points, what holds together as a surface."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.kinds.base import Change, Display, Kind, Materials, Product, SolidBuilder, Solids, Work
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.live_parameters import SOFT_LIVE
from pipeline.kinds.sizes import box_of, measures_of
from pipeline.kinds.work import soft_work, surface_work
from pipeline.model.job import Job
from pipeline.model.looks import BODY
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.bounds import Reach, reach_of_particles
from render.dye import dye_of
from render.grains import GRAINS_A_PARTICLE, grains_of
from render.meshes import validate_ply, write_ply
from render.parameters import MaterialParameters
from render.point_clouds import validate_point_cloud, write_point_cloud
from render.spec import MeshSequenceObject, PointSequenceObject, SceneObject
from render.surface import reconstruct_surface
from sim.core.snapshots import Snapshot
from sim.shapes.parameters import Placement
from sim.soft.materials import MATERIALS, Law
from sim.soft.parameters import SoftParameters

if TYPE_CHECKING:
    import h5py

LOOKS: dict[str, MaterialParameters] = {
    "sand": MaterialParameters(look="sand"),
    "wet_sand": MaterialParameters(look="sand", color=(0.32, 0.22, 0.13)),
    "snow": MaterialParameters(look="snow"),
    "packed_snow": MaterialParameters(look="snow"),
    "jelly": MaterialParameters(look="jelly"),
    "rubber": MaterialParameters(look="rubber"),
    "clay": MaterialParameters(look="stone", color=(0.45, 0.24, 0.15)),
    "dough": MaterialParameters(look="ceramic", color=(0.86, 0.76, 0.58), roughness=0.7),
    "cream": MaterialParameters(look="ceramic", color=(0.93, 0.89, 0.8), roughness=0.6),
}
"""Usual looks by material."""

GRAINY = (Law.SAND, Law.SNOW)

BASE_BYTES, BYTES_PER_PARTICLE = 150_000_000, 3_000
"""Of a task that makes a file, with pysplashsurf."""
SURFACE_BYTES = 2_600.0
"""Size of a surface's file over the number of its particles to the power 2/3, of cubes of 27,000 and 216,000."""


def is_grainy(soft: SoftParameters) -> bool:
    """Whether it is drawn grain by grain."""
    return soft.row.law in GRAINY


def count_particles(soft: SoftParameters, *, until_s: float = math.inf) -> float:
    """About the particles of a body: what its blocks hold, and emitters let in until a time [s]. Raises as below."""
    return _volume(soft, until_s) / soft.spacing**3


def _volume(soft: SoftParameters, until_s: float = math.inf) -> float:
    """Of all that there is of a body by a time [s] [m³]. Raises as `measures_of`."""
    poured = sum(emitter.emitted_volume(until_s) for emitter in soft.emitter)
    return float(sum(measures_of(block).volume for block in soft.block) + poured)


def _placements(job: Job, index: int) -> Iterator[tuple[KeyPath, Placement]]:
    for number, block in enumerate(job.soft[index].block):
        yield ("block", number), block


def _check(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.soft import check_soft

    return check_soft(job, solids, budget, findings)


def _coarser(job: Job, factor: float, _solids: SolidBuilder | None) -> list[Change]:
    return [(("soft", index, "cell_size"), soft.cell_size * factor) for index, soft in enumerate(job.soft)]


def _objects(_job: Job, _layout: JobLayout, soft: SoftParameters, material_of: Materials) -> Iterator[SceneObject]:
    file, material = MATTER.file_of(soft.name), material_of(BODY)
    if is_grainy(soft):
        yield PointSequenceObject(name=soft.name, file=file, kind="spray", material=material)
    else:
        yield MeshSequenceObject(name=soft.name, file=file, material=material)


def _reach(_job: Job, _layout: JobLayout, _soft: SoftParameters, group: h5py.Group) -> Reach | None:
    position = group["position"][()]
    return reach_of_particles(position, float(group.attrs["radius"])) if len(position) else None


def _write(path: Path, soft: Snapshot, job: Job, threads: int) -> None:
    arrays, radius, dye = soft.arrays, soft.number("radius"), soft.arrays.get("dye")
    if MATERIALS[str(soft.attributes["material"])].law in GRAINY:
        cloud = grains_of(arrays["position"], arrays["velocity"], arrays["particle_id"], dye, radius=radius)
        write_point_cloud(path, cloud)
        return
    surface = reconstruct_surface(
        arrays["position"], arrays["velocity"], particle_radius=radius, parameters=job.surface, threads=threads
    )
    dyed = dye_of(surface, arrays["position"], dye, particle_radius=radius)
    write_ply(path, surface.vertices, surface.faces, normals=surface.normals, velocities=surface.velocities, **dyed)


def _validate(path: Path) -> None:
    """A mesh or a cloud, as its header says."""
    with path.open("rb") as file:
        is_mesh = b"element face" in file.read(1024)
    (validate_ply if is_mesh else validate_point_cloud)(path)


MATTER = Product(
    stage="soft",
    about="grains and surfaces of soft matter",
    version=1,
    folder="soft",
    suffix=".ply",
    tools=lambda _job: {name: tool_version(name) for name in ("pysplashsurf", "numpy", "scipy")},
    parameters=lambda job, soft: {} if is_grainy(soft) else {"surface": job.surface.of_meshes},
    memory_bytes=lambda job, soft: BASE_BYTES + int(BYTES_PER_PARTICLE * count_particles(soft, until_s=job.film_s)),
    write=_write,
    validate=_validate,
    file_bytes=lambda soft, particles: (
        33.0 * GRAINS_A_PARTICLE * particles if is_grainy(soft) else SURFACE_BYTES * particles ** (2.0 / 3.0)
    ),
    work=lambda job, soft, particles: (
        Work(0.0, 3.0e-6 * particles) if is_grainy(soft) else surface_work(job, particles)
    ),
    work_name=lambda soft: "grains" if is_grainy(soft) else "surface",
)

SOFT = Kind(
    name="soft",
    parameters=SoftParameters,
    about="Sand, snow, jelly and clay, on one grid; they meet walls, rigid bodies, fluids, cloth and smoke.",
    size="about {:,} particles of soft matter",
    elements=lambda _job, soft: count_particles(soft),
    snapshot_bytes=(150.0, 24.0, 140.0),
    work=soft_work,
    solver_bytes=300.0,
    compiling_s=12.0,
    drawing=0.6,
    wears="rigid",
    material=lambda soft: {BODY: LOOKS[soft.material]},
    look_size=lambda _job, soft: _volume(soft) ** (1.0 / 3.0),
    boxes=lambda _job, soft: map(box_of, soft.block),
    placements=_placements,
    check=_check,
    coarser=_coarser,
    lighter="a larger soft.cell_size",
    shares_solver=lambda _soft: True,
    product=MATTER,
    objects=_objects,
    reach=_reach,
    reach_bytes=160.0,
    display=Display("Soft matter", "points"),
    live=SOFT_LIVE,
    facts=lambda soft, count: (
        f"{soft.material.replace('_', ' ')}, cells of {soft.cell_size:g} m"
        + ("" if count is None else f", {count:,.0f} particles")
    ),
)
