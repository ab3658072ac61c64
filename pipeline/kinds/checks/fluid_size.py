"""Checks of the size of fluids: particles, memory, and blocks that hold none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipeline.kinds.checks.fluid import check_search_cells, emitted_particles, particle_room
from pipeline.kinds.checks.memory_budget import MemoryBudget
from pipeline.model.amounts import count, gigabytes, rounded_up
from pipeline.model.boxes import Box, domain_box, overlap, span, touch
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings
from sim.core.domain import DomainParameters
from sim.fluid.parameters import FluidParameters

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sim.shapes import Solid

BYTES_PER_PARTICLE = 1024
"""Upper bound of what the fluid solvers take, neighbour search and snapshots included."""
BYTES_PER_PARTICLE_ON_GPU = 600
"""The same without the snapshots, which are the host's."""
NEIGHBOR_BYTES = 240
"""The neighbour list's part of that at a support of two spacings; it grows with the cube of the support."""
BYTES_PER_SEARCH_CELL = 16
"""Starts and counts of fluid and boundary; a cell is as wide as the support radius, two particle spacings."""
BYTES_PER_WALL_SAMPLE = 150
"""State, search and what building the walls takes for a moment."""
COUNTED_PARTICLES = 200_000
"""Up to so many particles a fluid is filled as the simulation fills it; beyond, a coarser lattice is scaled up."""
ROUND_OFF_IN_SPACINGS = 1.0e-6
"""Sizes written in decimal may fall short of a whole number of spacings by this much."""
ALL = 1.0 - 1e-6
"""Share of a box that counts as all of it: sizes and positions written in decimal do not add up exactly."""


def check_fluid_size(
    job: Job, index: int, solids: Mapping[KeyPath, Solid], budget: MemoryBudget, findings: Findings
) -> int:
    """Particles that the fluid will have, about."""
    fluid = job.fluid[index]
    blocks = {path: solid for path, solid in solids.items() if path[:3] == ("fluid", index, "block")}
    obstacles = [solid for path, solid in solids.items() if path[0] == "rigid"]
    spacing = 2.0 * fluid.particle_radius
    expected = particle_room(job, fluid, sum(solid.volume for solid in blocks.values()))
    each = _bytes_per_particle(fluid, on_gpu=budget.on_gpu)
    if expected * each > budget.bytes:
        possible = budget.bytes // each
        radius = fluid.particle_radius * (expected / possible) ** (1.0 / 3.0)
        remedy = ", or give emitters an end_s, or the fluid max_particles" if fluid.emitter else ""
        findings.error(
            ("fluid", index, "particle_radius"),
            f"{count(expected)} particles need {gigabytes(expected * each)}, {budget.owner} has "
            f"{gigabytes(budget.bytes)}; at most {count(possible)} fit: "
            f"use {rounded_up(radius):g} m or more{remedy}",
        )
        return int(expected)
    _check_domain_size(job.domain, fluid, budget, findings)
    lattice = _Lattice(domain_box(job.domain), obstacles, spacing, max(1.0, (expected / COUNTED_PARTICLES) ** (1 / 3)))
    start = sum(_check_block(path, solid, lattice, findings) for path, solid in blocks.items())
    most = math.inf if fluid.max_particles is None else max(start, fluid.max_particles)
    return int(min(start + emitted_particles(job, fluid), most))


def _bytes_per_particle(fluid: FluidParameters, *, on_gpu: bool) -> int:
    base = BYTES_PER_PARTICLE_ON_GPU if on_gpu else BYTES_PER_PARTICLE
    return base + math.ceil(NEIGHBOR_BYTES * ((fluid.support_in_spacings / 2.0) ** 3 - 1.0))


def _check_domain_size(
    domain: DomainParameters, fluid: FluidParameters, budget: MemoryBudget, findings: Findings
) -> None:
    """The whole domain is covered by cells for the neighbour search, and its walls by samples, fluid or not."""
    box = domain_box(domain)
    x, y, z = (box[1] - box[0]) / (2.0 * fluid.particle_radius)
    need = x * y * z / 8.0 * BYTES_PER_SEARCH_CELL + 2.0 * (x * y + y * z + z * x) * BYTES_PER_WALL_SAMPLE
    if need > budget.bytes:
        radius = rounded_up(fluid.particle_radius * math.sqrt(need / budget.bytes))
        findings.error(
            ("domain",),
            f"is so large that walls and search cells for particles of {fluid.particle_radius:g} m need "
            f"{gigabytes(need)}, {budget.owner} has {gigabytes(budget.bytes)}; "
            f"make it smaller, or particle_radius {radius:g} m",
        )
    else:
        check_search_cells(domain, fluid, findings)


@dataclass(frozen=True)
class _Lattice:
    """What blocks are filled with, and where not.

    Attributes:
        box: the domain.
        obstacles: solid bodies.
        spacing: of the particles [m].
        coarsening: the checks' lattice is coarser by this factor [-].
    """

    box: Box
    obstacles: list[Solid]
    spacing: float
    coarsening: float

    def fill(self, solid: Solid) -> tuple[int, int]:
        """Number of particles that find a free place in the solid, and of those that obstacles keep out."""
        from sim.fluid.filling import ROUNDING
        from sim.shapes import fill_with_particles

        step = self.spacing * self.coarsening
        points = fill_with_particles(solid, step, lower=self.box[0], upper=self.box[1])
        free = np.ones(len(points), dtype=bool)
        for obstacle in self.obstacles:
            if not touch(obstacle.bounds, solid.bounds, margin=step):
                continue
            free &= obstacle.signed_distance(points.astype(np.float64)) >= (1.0 - ROUNDING) * step / 2
        left = int(np.count_nonzero(free))
        # Whole layers fit into a box, so its fine lattice is not just coarsening³ times its coarse one.
        scale = self._places(solid, self.spacing) / max(1.0, self._places(solid, step))
        return round(left * scale), round((len(points) - left) * scale)

    def _places(self, solid: Solid, spacing: float) -> float:
        """Places of a lattice in the bounds of the solid, as `fill_with_particles` lays it."""
        extent = np.minimum(solid.bounds[1], self.box[1]) - np.maximum(solid.bounds[0], self.box[0])
        return float(np.prod(np.floor(extent / spacing + ROUND_OFF_IN_SPACINGS)))


def _check_block(path: KeyPath, solid: Solid, lattice: _Lattice, findings: Findings) -> int:
    """Particles in a block, about."""
    inside = overlap(solid.bounds, lattice.box)
    if inside == 0.0:
        spans = f"it spans {span(solid.bounds)}, not {span(lattice.box)}"
        findings.error(path, f"is wholly outside the domain: {spans}")
        return 0
    if inside < ALL:
        findings.warn(path, f"{100 * (1 - inside):.0f} % of it are outside the domain and are clipped")
    left, kept_out = lattice.fill(solid)
    if kept_out and not left:
        findings.error(path, "lies wholly inside solid bodies, so it holds no particle; move it")
    elif kept_out:
        filled = count(left + kept_out)
        findings.warn(path, f"overlaps a solid body: {count(kept_out)} of its {filled} particles are left out")
    elif not left and lattice.coarsening == 1.0:
        thinnest = float(np.min(solid.bounds[1] - solid.bounds[0]))
        findings.error(
            path,
            f"holds no particle: it is {thinnest:.3g} m thin and particles are {lattice.spacing:.3g} m apart; "
            "enlarge it or use a smaller particle_radius",
        )
    return left
