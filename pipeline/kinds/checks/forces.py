"""Checks of forces: whether anything is there that feels them, and when."""

import numpy as np

from pipeline.model.boxes import Box, overlap, simulated_regions
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.forces.parameters import AirForce, BaseForce, RegionParameters
from sim.shapes.parameters import BoxShape, SphereShape


def check_forces(job: Job, findings: Findings) -> None:
    """Warn of forces that change nothing in the film."""
    for number, force in enumerate(job.force):
        if not _feel_it(job, force):
            what = "moves air" if isinstance(force, AirForce) else "acts"
            findings.warn(("force", number), f"{what}, and nothing feels it: {_why(job, force)}")
        if force.start_s >= job.film_s:
            findings.warn(
                ("force", number, "start_s"), f"is {force.start_s:g} s, and the film ends at {job.film_s:g} s"
            )
        if force.within is not None:
            box = _box(force.within)
            if not any(overlap(box, region) for region in simulated_regions(job)):
                findings.warn(("force", number, "within"), "is outside of all that is simulated; is the place meant?")


def _feel_it(job: Job, force: BaseForce) -> bool:
    def is_meant(*names: str) -> bool:
        return not force.only or bool(set(force.only) & set(names))

    of_air = isinstance(force, AirForce)
    bodies = (body for body in job.rigid if body.kind == "dynamic" and is_meant(body.name, body.group))
    fluids = (fluid for fluid in job.fluid if is_meant(fluid.name))
    cloths = (cloth for cloth in job.cloth if is_meant(cloth.name))
    return (
        any(is_meant(smoke.name) for smoke in job.smoke)
        or any(body.air_drag > 0.0 or not of_air for body in bodies)
        or any(fluid.air_density > 0.0 or not of_air for fluid in fluids)
        or (not of_air and any(is_meant(soft.name) for soft in job.soft))
        or any(cloth.air_density * (cloth.drag + cloth.skin_drag) > 0.0 or not of_air for cloth in cloths)
    )


def _why(job: Job, force: BaseForce) -> str:
    if not isinstance(force, AirForce):
        return "rigid bodies that stand still or follow a path are moved by no force; make one dynamic"
    fluid = next((each for each in job.fluid if not force.only or each.name in force.only), None)
    if fluid is not None:
        return f'give air_density to "{fluid.name}", 1.2 kg/m³ for air, so that it drags drops and sheets along'
    return "air moves smoke, cloth with drag, dynamic bodies with air_drag, and fluids with air_density"


def _box(region: RegionParameters) -> Box:
    """Lower and upper corner of a ball about a region [m], (2, 3)."""
    shape, centre = region.shape, np.array(region.position)
    if isinstance(shape, SphereShape):
        half = shape.radius
    elif isinstance(shape, BoxShape):
        half = 0.5 * float(np.linalg.norm(shape.size))
    else:
        half = float(np.hypot(shape.radius, 0.5 * shape.height))
    return np.stack([centre - half, centre + half])
