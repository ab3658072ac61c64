"""Particle fluids: surfaces of their particles."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from blender_scripts.look_table import LOOK_TABLE
from blender_scripts.optics import INSIDES, dye_per_metre, per_metre, through_ball
from pipeline.base.content import tool_version
from pipeline.base.layout import JobLayout
from pipeline.kinds.base import Change, Display, Kind, Materials, Product, SolidBuilder, Solids
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.kinds.elements import most_particles_of
from pipeline.kinds.live_parameters import FLUID_LIVE
from pipeline.kinds.sizes import size_of_liquid
from pipeline.kinds.work import fluid_work, mean_particles, surface_work
from pipeline.model.job import Job
from pipeline.model.looks import BODY, POINTS, WHITEWATER
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from render.bounds import Reach, reach_of_particles
from render.dye import dye_of
from render.meshes import validate_ply, write_ply
from render.parameters import MaterialParameters
from render.spec import MeshSequenceObject, PointSequenceObject, SceneObject
from render.surface import reconstruct_surface
from render.walls import Walls
from sim.core.domain import DomainParameters
from sim.core.snapshots import Snapshot
from sim.fluid.parameters import FluidParameters
from sim.shapes.parameters import Placement
from sim.whitewater.kinds import LiquidKind, mean_diameter

if TYPE_CHECKING:
    import h5py

WETS_WITHIN_RADII = 1.5
"""How near a fluid's surface is to what it touches, in radii of its particles: up to 0.8 above moving ones."""

WORKER_BYTES = 110_000_000
BYTES_PER_SURFACE_PARTICLE = 220_000
"""Memory of meshing, which goes with the surface: with the particles to the power 2/3, at `CUBE_SIZE`. A block at rest
takes 130,000; more where particles are in sheets, which get samples between them: with 28 % of 15,000 and with 7 % of
99,000 a process had 243 and 542 MB."""
CUBE_SIZE = 0.75
"""In radii. Cubes of half the width need four times the memory."""


def _placements(job: Job, index: int) -> Iterator[tuple[KeyPath, Placement]]:
    for number, block in enumerate(job.fluid[index].block):
        yield ("block", number), block


def _check(job: Job, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    from pipeline.kinds.checks.fluid import check_fluids
    from pipeline.kinds.checks.fluid_size import check_fluid_size
    from pipeline.kinds.checks.steps import check_time_steps

    check_fluids(job, solids, findings)
    check_time_steps(job, solids, findings)
    return sum(check_fluid_size(job, index, solids, budget, findings) for index in range(len(job.fluid)))


def _coarser(job: Job, factor: float, _solids: SolidBuilder | None) -> list[Change]:
    changes: list[Change] = []
    for index, fluid in enumerate(job.fluid):
        changes.append((("fluid", index, "particle_radius"), fluid.particle_radius * factor))
        if fluid.dt != "adaptive":
            changes.append((("fluid", index, "dt"), fluid.dt * factor))
    return changes


def _objects(job: Job, _layout: JobLayout, fluid: FluidParameters, material_of: Materials) -> Iterator[SceneObject]:
    # Nobody sees from inside where a fluid of another look touches solids, but through glass; a material of one's own
    # may look at it.
    material = material_of(BODY)
    sees = material.look is None or LOOK_TABLE[material.look].refracts or (material.look in INSIDES and _in_glass(job))
    yield MeshSequenceObject(
        name=fluid.name,
        file=SURFACE.file_of(fluid.name),
        material=material,
        wets_within=WETS_WITHIN_RADII * fluid.particle_radius if sees else None,
    )
    yield PointSequenceObject(
        name=f"{fluid.name}.drops",
        file=f"drops/{fluid.name}/{{frame}}.ply",
        kind="spray",
        material=_colored(material_of("drops"), material, job, fluid),
    )
    for kind in WHITEWATER if fluid.name in job.whitewater else ():
        yield PointSequenceObject(
            name=f"{fluid.name}.{kind}",
            file=f"whitewater/{fluid.name}/{{frame}}.ply",
            kind=kind,
            material=material_of(kind),
        )


def _colored(
    drops: MaterialParameters, liquid: MaterialParameters, job: Job, fluid: FluidParameters
) -> MaterialParameters:
    """The look `drops` in the colour that light has through a drop of the liquid, unless the job gives it one."""
    absorbs = liquid.look in INSIDES and LOOK_TABLE[liquid.look].refracts
    if drops.look != "drops" or drops.color is not None or not absorbs:
        return drops
    look, dye_color = liquid.look, liquid.dye_color
    assert look is not None and liquid.density is not None, "materials are as dense as they are drawn"
    diameter = mean_diameter(
        particle_radius=fluid.particle_radius,
        diameter=job.surface.drop_diameter,
        most=job.surface.drops_per_particle,
    )
    own = per_metre(look, liquid.density, liquid.color)
    colors = {"color": through_ball(own, diameter)}
    if dye_color is not None:
        dye = dye_per_metre(look, liquid.density, liquid.color, dye_color)
        red, green, blue = (of_look + of_dye for of_look, of_dye in zip(own, dye, strict=True))
        colors["dye_color"] = through_ball((red, green, blue), diameter)
    return drops.model_copy(update=colors)


def _in_glass(job: Job) -> bool:
    """Whether something beside the fluids has a look that light goes through."""
    fluids = {fluid.name for fluid in job.fluid}
    looks = (material.look for name, material in job.material.items() if name not in fluids)
    return any(look is not None and LOOK_TABLE[look].refracts for look in looks)


def _reach(_job: Job, _layout: JobLayout, _fluid: FluidParameters, group: h5py.Group) -> Reach | None:
    position = group["position"][()]
    return reach_of_particles(position, float(group.attrs["particle_radius"])) if len(position) else None


# --- the surface of a frame ---


def _surface_tools(_job: Job) -> dict[str, str]:
    return {name: tool_version(name) for name in ("pysplashsurf", "scipy")}


def _surface_parameters(job: Job, _fluid: FluidParameters) -> dict[str, Any]:
    return {"surface": job.surface.of_meshes, "domain": job.domain}


def _surface_memory(job: Job, fluid: FluidParameters) -> int:
    """An upper bound: how many particles there are is not known before the simulation has filled its blocks."""
    on_surface = most_particles_of(fluid, job, until_s=job.film_s) ** (2.0 / 3.0)
    finer = CUBE_SIZE / job.surface.cube_size_in_radii
    meshing: int = ceil(BYTES_PER_SURFACE_PARTICLE * on_surface * finer**2)
    return WORKER_BYTES + meshing


def wetted_walls(domain: DomainParameters) -> Walls:
    """The walls of a domain that liquids wet: all of its faces but the open ones."""
    is_open = np.array([[f"{axis}{side}" in domain.open_faces for axis in "xyz"] for side in "-+"])
    return Walls(np.where(is_open[0], -np.inf, domain.min), np.where(is_open[1], np.inf, domain.max))


def _write_surface(path: Path, fluid: Snapshot, job: Job, threads: int) -> None:
    meshed = fluid.arrays["liquid"] != LiquidKind.SPRAY
    radius = fluid.number("particle_radius")
    surface = reconstruct_surface(
        fluid.arrays["position"][meshed],
        fluid.arrays["velocity"][meshed],
        particle_radius=radius,
        parameters=job.surface,
        is_thin=fluid.arrays["liquid"][meshed] == LiquidKind.SHEET,
        walls=wetted_walls(job.domain),
        volume=len(meshed) * (2.0 * radius) ** 3 - fluid.number("volume_of_drops"),
        threads=threads,
    )
    dye = fluid.arrays.get("dye")
    dyed = dye_of(
        surface, fluid.arrays["position"][meshed], None if dye is None else dye[meshed], particle_radius=radius
    )
    write_ply(path, surface.vertices, surface.faces, normals=surface.normals, velocities=surface.velocities, **dyed)


def _facts(fluid: FluidParameters, count: float | None) -> str:
    particles = "particles" if count is None else f"{count:,.0f} particles"
    return f"{fluid.solver.upper()}, {particles} of radius {fluid.particle_radius:g} m"


SURFACE = Product(
    stage="surface",
    about="surfaces of fluids",
    version=6,
    folder="surfaces",
    suffix=".ply",
    tools=_surface_tools,
    parameters=_surface_parameters,
    memory_bytes=_surface_memory,
    write=_write_surface,
    validate=validate_ply,
    also_reads=lambda fluid, frame: (JobLayout.liquid(fluid, frame),),
    file_bytes=lambda _fluid, particles: 4_500.0 * particles ** (2 / 3),
    work=lambda job, _fluid, particles: surface_work(job, particles),
)

FLUID = Kind(
    name="fluid",
    parameters=FluidParameters,
    about="Particle fluids; several share one tank, and the keys that say how it is computed.",
    size="about {:,} particles",
    elements=lambda job, fluid: most_particles_of(fluid, job),
    snapshot_bytes=(84.0, 26.0, 90.0),
    method=lambda fluid: str(fluid.solver),
    work=lambda job, particles, on_gpu: fluid_work(job, mean_particles(job, particles), on_gpu),
    solver_bytes=600.0,
    compiling_s=4.0,
    drawing=1.0,
    wears="fluid",
    material=lambda _fluid: {BODY: MaterialParameters(look="water"), **POINTS},
    look_size=size_of_liquid,
    placements=_placements,
    check=_check,
    coarser=_coarser,
    lighter="a larger fluid.particle_radius",
    product=SURFACE,
    objects=_objects,
    reach=_reach,
    reach_bytes=160.0,
    display=Display("Particles", "points", radius="particle_radius"),
    live=FLUID_LIVE,
    facts=_facts,
)
