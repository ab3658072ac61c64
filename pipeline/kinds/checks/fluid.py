"""Checks of fluids: together, at their emitters, and in number."""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.jets import check_jets
from pipeline.kinds.checks.pressed_bodies import check_pressed_bodies
from pipeline.kinds.checks.shapes import mesh_exists
from pipeline.kinds.checks.vessels import check_vessels
from pipeline.model.amounts import rounded_down, rounded_up
from pipeline.model.boxes import domain_box, overlap
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path, unknown_name
from sim.coupling.emitter_bodies import emitter_on, follow_problem
from sim.fluid.opening import Opening, followed
from sim.fluid.opening_conflicts import opening_problem
from sim.fluid.parameters import shared_conflicts
from sim.shapes.parameters import BoxShape, MeshShape, RevolvedShape
from sim.shapes.sampling import fill_with_particles

THINNEST_PLATE_IN_SPACINGS = 1.9
"""Twice the depth of a body's samples (`sim.fluid.boundary_akinci2012`). Fluid rests 0.4 spacings off a thicker plate,
as off any wall, 0.9 off one of half that, 1.3 off the thinnest."""
SHARE_OF_WALLS = 0.5
"""Share of its surface that a vessel has on its walls, at least: beside sharp edges every body is thin."""
FEWEST_FRAMES_ACROSS = 10
"""A jet by its flow rate that crosses the domain in fewer frames comes out of too narrow an opening, most likely."""
# Points of a block that are looked at for an overlap with another fluid's.
OVERLAP_SAMPLES = 20_000


def check_fluids(job: Job, solids: Solids, findings: Findings) -> None:
    """Note what the fluids do not share and should, where they overlap, and what is wrong with their emitters."""
    for number, key, message in shared_conflicts(job.fluid):
        findings.error(("fluid", number, key), message)
    _check_overlaps(job, solids, findings)
    _check_thin_bodies(job, solids, findings)
    check_pressed_bodies(job, solids, findings)
    openings: dict[KeyPath, Opening] = {}
    for index in range(len(job.fluid)):
        _check_speeds(job, index, findings)
        for number, opening in openings_of(job, index, findings):
            path: KeyPath = ("fluid", index, "emitter", number)
            _check_emitter(job, path, opening, openings, solids, findings=findings)
            openings[path] = opening
    if openings:
        check_jets(job, solids, openings, job.fluid[0].spacing, findings)
        check_vessels(job, solids, openings, findings)


def openings_of(job: Job, index: int, findings: Findings | None = None) -> Iterator[tuple[int, Opening]]:
    """The openings of a fluid's emitters that can be, at the start; what is wrong with others is noted."""
    fluid, bodies = job.fluid[index], {body.name: body for body in job.rigid}
    noted = Findings() if findings is None else findings
    for number, emitter in enumerate(fluid.emitter):
        path: KeyPath = ("fluid", index, "emitter", number)
        if emitter.follow is not None and emitter.follow not in bodies:
            problem = unknown_name(emitter.follow, bodies, "rigid body", plural="bodies", none="; add [[rigid]]")
            noted.error((*path, "follow"), problem)
        elif emitter.follow is not None and (piece := follow_problem(bodies[emitter.follow])):
            noted.error((*path, "follow"), piece)
        elif mesh_exists(emitter.shape, path, noted):
            own = emitter_on(emitter, bodies)
            try:
                yield number, Opening.of(own, fluid.spacing, fluid.lattice_volume, followed(own, bodies))
            except ValueError as error:
                noted.error((*path, "shape"), str(error))


def _check_emitter(
    job: Job,
    path: KeyPath,
    opening: Opening,
    earlier: Mapping[KeyPath, Opening],
    solids: Solids,
    *,
    findings: Findings,
) -> None:
    obstacles = [solid for place, solid in solids.items() if place[0] in ("rigid", "soft")]
    others = {format_path(place): other for place, other in earlier.items()}
    if reason := opening_problem(opening, job.fluid[0].spacing, job.domain, obstacles, others):
        findings.error(path, reason)
    if opening.start_s >= job.film_s:
        findings.warn((*path, "start_s"), f"starts at {opening.start_s:g} s, after the film's end at {job.film_s:g} s")
    elif opening.inflow.travel_at(job.film_s) == 0.0:
        findings.warn((*path, "ramp"), f"is 0 whenever it emits in the film's {job.film_s:g} s: it emits nothing")
    _check_amount(job, path, opening, findings)


def _check_amount(job: Job, path: KeyPath, opening: Opening, findings: Findings) -> None:
    """Refuse an amount of less than a particle, and warn of a rate that takes a jet too fast for the scene."""
    fluid = job.fluid[int(path[1])]
    emitter = fluid.emitter[int(path[3])]
    if opening.speed > 0.0 and opening.total_particles == 0.0:
        key = "end_s" if emitter.total_volume is None else "total_volume"
        volume, particle = opening.inflow.total_travel * emitter.area, fluid.lattice_volume
        radius = rounded_down(0.5 * (2.0 * volume) ** (1.0 / 3.0))
        findings.error(
            (*path, key),
            f"makes {volume:.2g} m³ in all, less than half a particle of {particle:.2g} m³: it emits nothing; "
            f"use more, or particle_radius {radius:g} m",
        )
    sane = math.dist(job.domain.min, job.domain.max) * job.fps / FEWEST_FRAMES_ACROSS
    if emitter.flow_rate is not None and emitter.inflow_speed > sane:
        findings.warn(
            (*path, "flow_rate"),
            f"{emitter.flow_rate:g} m³/s through {emitter.area:.2g} m² is a jet of {emitter.inflow_speed:.3g} m/s, "
            f"which crosses the domain within {FEWEST_FRAMES_ACROSS} frames; use an opening of "
            f"{rounded_up(emitter.flow_rate / sane):g} m², or {rounded_down(sane * emitter.area):g} m³/s",
        )


def _check_speeds(job: Job, index: int, findings: Findings) -> None:
    """Warn of a start so fast that the fluid crosses the domain within a frame: a slip of the unit, most likely."""
    fastest = math.dist(job.domain.min, job.domain.max) * job.fps
    fluid = job.fluid[index]
    speeds = [(("block", number, "velocity"), math.hypot(*block.velocity)) for number, block in enumerate(fluid.block)]
    speeds += [
        (("emitter", number, "speed"), emitter.speed)
        for number, emitter in enumerate(fluid.emitter)
        if emitter.speed is not None
    ]
    for key, speed in speeds:
        if speed > fastest:
            findings.warn(
                ("fluid", index, *key),
                f"{speed:g} m/s crosses the whole domain within a frame; the time steps will be very short",
            )


def _check_thin_bodies(job: Job, solids: Solids, findings: Findings) -> None:
    """Warn of plates and vessels with walls thinner than two layers of samples are deep: fluid stands off them."""
    from sim.shapes.distance_grids import wall_thickness

    spacing = max(fluid.spacing for fluid in job.fluid)
    domain, least = domain_box(job.domain), THINNEST_PLATE_IN_SPACINGS * spacing
    for index, body in enumerate(job.rigid):
        solid, shape = solids.get(("rigid", index)), body.shape
        if solid is None or overlap(solid.bounds, domain) == 0.0:
            continue
        if isinstance(shape, BoxShape):
            thickness = body.scale * min(shape.size)
        elif isinstance(shape, RevolvedShape | MeshShape):
            thickness = body.scale * wall_thickness(solid.shape, SHARE_OF_WALLS)
        else:
            continue
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
