"""Checks of fluids: together, at their emitters, and in number."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipeline.kinds.checks.jets import check_jets
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.fluid.parameters import shared_conflicts

if TYPE_CHECKING:
    from pipeline.model.job import Job
    from sim.core.domain import DomainParameters
    from sim.fluid.opening import Opening
    from sim.fluid.parameters import FluidParameters
    from sim.shapes import Solid

MOST_CELLS = 2**28
"""`sim.core.cells.MAX_CELLS`, which is not imported here as that loads Taichi; a test holds them together."""
OVERLAP_SAMPLES = 20_000
"""Points of a block that are looked at for an overlap with another fluid's."""


def check_fluids(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """Note what the fluids do not share and should, where they overlap, and what is wrong with their emitters."""
    for number, key, message in shared_conflicts(job.fluid):
        findings.error(("fluid", number, key), message)
    _check_overlaps(job, solids, findings)
    obstacles = [solid for path, solid in solids.items() if path[0] == "rigid"]
    openings: dict[KeyPath, Opening] = {}
    for index, fluid in enumerate(job.fluid):
        _check_speeds(job, index, findings)
        for number, opening in openings_of(fluid, index, findings):
            path = ("fluid", index, "emitter", number)
            _check_emitter(job, path, opening, obstacles, findings)
            _check_nozzle(path, opening, openings, 2.0 * fluid.particle_radius, findings)
            openings[path] = opening
    if openings:
        check_jets(job, solids, openings, 2.0 * job.fluid[0].particle_radius, findings)


def particle_room(job: Job, fluid: FluidParameters, block_volume: float) -> float:
    """Particles that the simulation makes room for: those of the blocks, and all that emitters may ever add.

    Args:
        job: the job.
        fluid: one of its fluids.
        block_volume: of the fluid's blocks [m³].
    """
    spacing = 2.0 * fluid.particle_radius
    start = block_volume / spacing**3
    emitted = sum(opening.total_particles() for _, opening in openings_of(fluid))
    domain = math.prod(high - low for low, high in zip(job.domain.min, job.domain.max, strict=True))
    cap = math.inf if fluid.max_particles is None else fluid.max_particles
    return max(start, min(start + emitted, cap, domain / spacing**3))


def emitted_particles(job: Job, fluid: FluidParameters) -> int:
    """Particles that the emitters of a fluid add until the film's end, about."""
    end = job.frame_count / job.fps
    return sum(len(opening.points) * opening.layers_due(end) for _, opening in openings_of(fluid))


def openings_of(
    fluid: FluidParameters, index: int = 0, findings: Findings | None = None
) -> Iterator[tuple[int, Opening]]:
    """The openings of a fluid's emitters that are wide enough; the others are noted."""
    from sim.fluid.opening import Opening

    spacing = 2.0 * fluid.particle_radius
    for number, emitter in enumerate(fluid.emitter):
        try:
            yield number, Opening.of(emitter, spacing, spacing**3, fluid.support_in_spacings)
        except ValueError as error:
            if findings is not None:
                findings.error(("fluid", index, "emitter", number, "shape"), str(error))


def _check_emitter(job: Job, path: KeyPath, opening: Opening, obstacles: Sequence[Solid], findings: Findings) -> None:
    from sim.fluid.opening import obstruction

    fluid = job.fluid[path[1]]  # type: ignore[index]
    if reason := obstruction(opening, 2.0 * fluid.particle_radius, job.domain, list(obstacles)):
        findings.error(path, reason)
    length = job.frame_count / job.fps
    if opening.start_s >= length:
        findings.warn((*path, "start_s"), f"starts at {opening.start_s:g} s, after the film's end at {length:g} s")


def _check_nozzle(
    path: KeyPath, opening: Opening, earlier: Mapping[KeyPath, Opening], spacing: float, findings: Findings
) -> None:
    """Refuse an emitter that is in the way of one before it; one reason will do."""
    from sim.fluid.nozzles import nozzle_collision

    for other_path, other in earlier.items():
        if reason := nozzle_collision(opening, other, format_path(other_path), spacing):
            findings.error(path, reason)
            return


def check_search_cells(domain: DomainParameters, fluid: FluidParameters, findings: Findings) -> None:
    """Refuse a domain with more cells for the search of neighbours than can be numbered."""
    cell = (1.0 + fluid.skin) * fluid.support_in_spacings * 2.0 * fluid.particle_radius
    size = np.subtract(domain.max, domain.min)
    cells = float(np.prod(np.ceil(size / cell) + 2.0))
    if cells > MOST_CELLS:
        radius = fluid.particle_radius * (cells / MOST_CELLS) ** (1.0 / 3.0)
        findings.error(
            ("domain",),
            f"has {cells:.3g} cells for the search of neighbours of {fluid.particle_radius:g} m particles, more than "
            f"{MOST_CELLS:.3g}; make it smaller, or particle_radius {1.05 * radius:.2g} m",
        )


def _check_speeds(job: Job, index: int, findings: Findings) -> None:
    """Warn of a start so fast that the fluid crosses the domain within a frame: a slip of the unit, most likely."""
    fastest = math.dist(job.domain.min, job.domain.max) * job.fps
    fluid = job.fluid[index]
    speeds = [(("block", number, "velocity"), math.hypot(*block.velocity)) for number, block in enumerate(fluid.block)]
    speeds += [(("emitter", number, "speed"), emitter.speed) for number, emitter in enumerate(fluid.emitter)]
    for key, speed in speeds:
        if speed > fastest:
            findings.warn(
                ("fluid", index, *key),
                f"{speed:g} m/s crosses the whole domain within a frame; the time steps will be very short",
            )


def _check_overlaps(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """A place that two fluids want belongs to the first."""
    from sim.shapes import fill_with_particles

    blocks = [(path, solid) for path, solid in solids.items() if path[0] == "fluid"]
    for place, (path, solid) in enumerate(blocks):
        for earlier_path, earlier in blocks[:place]:
            low = np.maximum(solid.bounds[0], earlier.bounds[0])
            high = np.minimum(solid.bounds[1], earlier.bounds[1])
            if earlier_path[1] == path[1] or np.any(high <= low):
                continue
            step = max(2.0 * job.fluid[path[1]].particle_radius, (solid.volume / OVERLAP_SAMPLES) ** (1.0 / 3.0))  # type: ignore[index]
            points = fill_with_particles(solid, step, lower=job.domain.min, upper=job.domain.max).astype(np.float64)
            shared = int(np.count_nonzero(earlier.signed_distance(points) < 0.0))
            if shared:
                share = shared / len(points)
                findings.warn(
                    path,
                    f"shares {100.0 * share:.0f} % of its volume with {format_path(earlier_path)}; "
                    f'that belongs to "{job.fluid[earlier_path[1]].name}", the first of the two',  # type: ignore[index]
                )
