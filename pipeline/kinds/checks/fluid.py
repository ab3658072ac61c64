"""Checks of fluids: together, at their emitters, and in number."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.jets import check_jets
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import domain_box, overlap
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path
from sim.fluid.opening import Opening, opening_problem
from sim.fluid.parameters import FluidParameters, shared_conflicts
from sim.shapes.parameters import BoxShape
from sim.shapes.sampling import fill_with_particles

THINNEST_PLATE_IN_SPACINGS = 1.9
"""Twice the depth of a body's samples (`sim.fluid.boundary_akinci2012`). Fluid rests 0.4 spacings off a thicker plate,
as off any wall, 0.9 off one of half that, 1.3 off the thinnest."""
# Points of a block that are looked at for an overlap with another fluid's.
OVERLAP_SAMPLES = 20_000


def check_fluids(job: Job, solids: Solids, findings: Findings) -> None:
    """Note what the fluids do not share and should, where they overlap, and what is wrong with their emitters."""
    for number, key, message in shared_conflicts(job.fluid):
        findings.error(("fluid", number, key), message)
    _check_overlaps(job, solids, findings)
    _check_thin_bodies(job, solids, findings)
    openings: dict[KeyPath, Opening] = {}
    for index, fluid in enumerate(job.fluid):
        _check_speeds(job, index, findings)
        for number, opening in openings_of(fluid, index, findings):
            path: KeyPath = ("fluid", index, "emitter", number)
            _check_emitter(job, path, opening, openings, solids, findings=findings)
            openings[path] = opening
    if openings:
        check_jets(job, solids, openings, job.fluid[0].spacing, findings)


def openings_of(
    fluid: FluidParameters, index: int = 0, findings: Findings | None = None
) -> Iterator[tuple[int, Opening]]:
    """The openings of a fluid's emitters that are wide enough; the others are noted."""
    for number, emitter in enumerate(fluid.emitter):
        try:
            yield number, Opening.of(emitter, fluid.spacing, fluid.lattice_volume, fluid.support_in_spacings)
        except ValueError as error:
            if findings is not None:
                findings.error(("fluid", index, "emitter", number, "shape"), str(error))


def _check_emitter(
    job: Job,
    path: KeyPath,
    opening: Opening,
    earlier: Mapping[KeyPath, Opening],
    solids: Solids,
    *,
    findings: Findings,
) -> None:
    obstacles = [solid for place, solid in solids.items() if place[0] == "rigid"]
    others = {format_path(place): other for place, other in earlier.items()}
    if reason := opening_problem(opening, job.fluid[0].spacing, job.domain, obstacles, others):
        findings.error(path, reason)
    if opening.start_s >= job.film_s:
        findings.warn((*path, "start_s"), f"starts at {opening.start_s:g} s, after the film's end at {job.film_s:g} s")


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


def _check_thin_bodies(job: Job, solids: Solids, findings: Findings) -> None:
    """Warn of plates thinner than two layers of samples are deep: fluid stands off them."""
    spacing = max(fluid.spacing for fluid in job.fluid)
    domain, least = domain_box(job.domain), THINNEST_PLATE_IN_SPACINGS * spacing
    for index, body in enumerate(job.rigid):
        solid, shape = solids.get(("rigid", index)), body.shape
        if solid is None or not isinstance(shape, BoxShape) or overlap(solid.bounds, domain) == 0.0:
            continue
        thickness = body.scale * min(shape.size)
        if thickness < least:
            radius = rounded_down(0.5 * thickness / THINNEST_PLATE_IN_SPACINGS)
            findings.warn(
                ("rigid", index, "shape"),
                f"is {thickness:.3g} m thin, less than the {least:.3g} m that particles {spacing:.3g} m apart can "
                f"hold: nothing passes, but fluid stays up to {spacing:.3g} m off it; give more thickness, or "
                f"particle_radius {radius:g} m",
            )


def _check_overlaps(job: Job, solids: Solids, findings: Findings) -> None:
    """A place that two fluids want belongs to the first."""
    blocks = [(path, solid) for path, solid in solids.items() if path[0] == "fluid"]
    for place, (path, solid) in enumerate(blocks):
        for earlier_path, earlier in blocks[:place]:
            if earlier_path[1] == path[1] or overlap(solid.bounds, earlier.bounds) == 0.0:
                continue
            step = max(job.fluid[int(path[1])].spacing, (solid.volume / OVERLAP_SAMPLES) ** (1.0 / 3.0))
            points = fill_with_particles(solid, step, lower=job.domain.min, upper=job.domain.max).astype(np.float64)
            shared = int(np.count_nonzero(earlier.signed_distance(points) < 0.0))
            if shared:
                findings.warn(
                    path,
                    f"shares {100.0 * shared / len(points):.0f} % of its volume with {format_path(earlier_path)}; "
                    f'that belongs to "{job.fluid[int(earlier_path[1])].name}", the first of the two',
                )
