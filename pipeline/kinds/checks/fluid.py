"""Checks of fluids: together, at their emitters, and in number."""

from collections.abc import Iterator

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.jets import check_jets
from pipeline.kinds.checks.openings import check_opening, check_speeds
from pipeline.kinds.checks.pressed_bodies import check_pressed_bodies
from pipeline.kinds.checks.shapes import mesh_exists
from pipeline.kinds.checks.vessels import check_vessels
from pipeline.model.amounts import rounded_down
from pipeline.model.boxes import domain_box, overlap
from pipeline.model.job import Job
from pipeline.model.positions import KeyPath
from pipeline.model.problems import Findings, format_path, unknown_name
from sim.coupling.emitter_bodies import emitter_on, follow_problem
from sim.fluid.opening import Opening, followed
from sim.fluid.parameters import shared_conflicts
from sim.shapes.parameters import BoxShape, MeshShape, RevolvedShape
from sim.shapes.sampling import fill_with_particles

THINNEST_PLATE_IN_SPACINGS = 1.9
"""Twice the depth of a body's samples (`sim.fluid.boundary_akinci2012`). Fluid rests 0.4 spacings off a thicker plate,
as off any wall, 0.9 off one of half that, 1.3 off the thinnest."""
SHARE_OF_WALLS = 0.5
"""Share of its surface that a vessel has on its walls, at least: beside sharp edges every body is thin."""
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
        check_speeds(job, ("fluid", index), findings)
        for number, opening in openings_of(job, index, findings):
            path: KeyPath = ("fluid", index, "emitter", number)
            check_opening(job, path, opening, openings, solids, findings=findings)
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
