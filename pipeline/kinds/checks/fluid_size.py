"""Checks of the size of fluids: particles, memory, and blocks that hold none."""

import math

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.fluid import openings_of
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.model.amounts import count, gigabytes, rounded_down, rounded_up
from pipeline.model.boxes import ALL, domain_box, overlap, span
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, Problem
from sim.core.domain import DomainParameters
from sim.fluid.parameters import FluidParameters
from sim.shapes.filled_volume import Surroundings, amount

BYTES_PER_PARTICLE, BYTES_PER_PARTICLE_ON_GPU = 1024, 600
"""Upper bounds of what the solvers take, neighbour search included, and on a CPU the snapshots."""
NEIGHBOR_BYTES = 240
"""The neighbour list's part of that at a support of two spacings; it grows with the cube of the support."""
# Starts and counts of fluid and boundary; a cell is as wide as the support radius.
BYTES_PER_SEARCH_CELL = 16
# State, search and building of a sample of the walls.
BYTES_PER_WALL_SAMPLE = 150
MOST_CELLS = 2**28
"""`sim.core.cells.MAX_CELLS`, which is not imported here as that loads Taichi; a test holds them together."""


def check_fluid_size(job: Job, index: int, solids: Solids, budget: MemoryBudget, findings: Findings) -> int:
    """Particles that the fluid will have, about."""
    fluid = job.fluid[index]
    blocks = {path: solid for path, solid in solids.items() if path[:3] == ("fluid", index, "block")}
    expected = particle_room(job, index, sum(solid.volume for solid in blocks.values()))
    each = _bytes_per_particle(fluid, on_gpu=budget.on_gpu)
    if refusal := budget.refusal(expected, "particles", each):
        radius = fluid.particle_radius * (expected / (budget.bytes // each)) ** (1.0 / 3.0)
        remedy = ", or give emitters an end_s, or the fluid max_particles" if fluid.emitter else ""
        findings.error(("fluid", index, "particle_radius"), f"{refusal}: use {rounded_up(radius):g} m or more{remedy}")
        return int(expected)
    _check_domain_size(job.domain, fluid, budget, findings)
    start = sum(_check_block(job, path, solids, findings) for path in blocks)
    most = math.inf if fluid.max_particles is None else max(start, fluid.max_particles)
    emitted = sum(opening.particles_due(job.film_s) for _, opening in openings_of(job, index))
    return int(min(start + emitted, most))


def particle_room(job: Job, index: int, block_volume: float) -> float:
    """Particles that the simulation makes room for: those of blocks [m³], and all that emitters may ever add."""
    fluid = job.fluid[index]
    start = block_volume / fluid.lattice_volume
    emitted = sum(opening.total_particles for _, opening in openings_of(job, index))
    domain: float = math.prod(np.subtract(job.domain.max, job.domain.min).tolist())
    most = min(domain, fluid.most_volume) / fluid.lattice_volume
    return max(start, min(start + emitted, most))


def _bytes_per_particle(fluid: FluidParameters, *, on_gpu: bool) -> int:
    base = BYTES_PER_PARTICLE_ON_GPU if on_gpu else BYTES_PER_PARTICLE
    return base + math.ceil(NEIGHBOR_BYTES * ((fluid.support_in_spacings / 2.0) ** 3 - 1.0))


def _check_domain_size(
    domain: DomainParameters, fluid: FluidParameters, budget: MemoryBudget, findings: Findings
) -> None:
    """The whole domain is covered by cells for the neighbour search, and its walls by samples, fluid or not."""
    size = np.subtract(domain.max, domain.min)
    x, y, z = size / fluid.spacing
    need = x * y * z / 8.0 * BYTES_PER_SEARCH_CELL + 2.0 * (x * y + y * z + z * x) * BYTES_PER_WALL_SAMPLE
    cells = float(np.prod(np.ceil(size / ((1.0 + fluid.skin) * fluid.support_in_spacings * fluid.spacing)) + 2.0))
    if need > budget.bytes:
        radius = rounded_up(fluid.particle_radius * math.sqrt(need / budget.bytes))
        findings.error(
            ("domain",),
            f"is so large that walls and search cells for particles of {fluid.particle_radius:g} m need "
            f"{gigabytes(need)}, {budget.owner} has {gigabytes(budget.bytes)}; "
            f"make it smaller, or particle_radius {radius:g} m",
        )
    elif cells > MOST_CELLS:
        radius = 1.05 * fluid.particle_radius * (cells / MOST_CELLS) ** (1.0 / 3.0)
        findings.error(
            ("domain",),
            f"has {cells:.3g} cells for the search of neighbours of {fluid.particle_radius:g} m particles, more than "
            f"{MOST_CELLS:.3g}; make it smaller, or particle_radius {radius:.2g} m",
        )


def _check_block(job: Job, path: KeyPath, solids: Solids, findings: Findings) -> int:
    """Particles in a block, as the simulation fills it."""
    solid, box, fluid = solids[path], domain_box(job.domain), job.fluid[int(path[1])]
    inside = overlap(solid.bounds, box)
    if inside == 0.0:
        findings.error(path, f"is wholly outside the domain: it spans {span(solid.bounds)}, not {span(box)}")
        return 0
    if inside < ALL:
        findings.warn(path, f"{100 * (1 - inside):.0f} % of it are outside the domain and are clipped")
    walls = [each for place, each in solids.items() if place[0] == "rigid"]
    earlier = [each for place, each in solids.items() if place[0] == "soft" or (place[0] == "fluid" and place < path)]
    held, outside_walls = (
        amount(solid, fluid.spacing, Surroundings.in_domain(job.domain, walls, others)) for others in (earlier, [])
    )
    thinnest = float(np.min(solid.bounds[1] - solid.bounds[0]))
    kept_out = round(held.of_solid) - outside_walls.particles
    if not held.particles and kept_out:
        findings.error(path, "lies wholly inside solid bodies, so it holds no particle; move it")
    elif not held.particles:
        findings.error(
            path,
            f"holds no particle: it is {thinnest:.3g} m thin and particles are {fluid.spacing:.3g} m apart; "
            "enlarge it or use a smaller particle_radius",
        )
    elif kept_out:
        filled = count(round(held.of_solid))
        findings.warn(path, f"overlaps a solid body: {count(kept_out)} of its {filled} particles are left out")
    if held.particles and thinnest < (1.0 - 1.0e-6) * fluid.spacing:
        findings.warn(
            path,
            f"is {thinnest:.3g} m thin and particles are {fluid.spacing:.3g} m apart: they have its mass, not its "
            f"shape; use a particle_radius of {rounded_down(0.5 * thinnest):g} m or less",
        )
    made, meant = (fluid.rest_density * volume for volume in (held.particles * fluid.lattice_volume, held.volume))
    if held.particles:
        findings.facts.append(Problem(path, f"holds {made:.3g} kg of {fluid.name}, {meant:.3g} kg by its volume"))
    return held.particles
