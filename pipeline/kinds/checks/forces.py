"""Checks of forces: whether anything is there that feels them, and when."""

import numpy as np

from pipeline.model.boxes import Box, overlap, simulated_regions
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.forces.parameters import AirForce, BaseForce, RegionParameters
from sim.rigid.parameters import RigidBodyParameters
from sim.shapes.parameters import BoxShape, SphereShape


def check_forces(job: Job, findings: Findings) -> None:
    """Warn of forces that change nothing in the film."""
    for number, force in enumerate(job.force):
        if not _feel_it(job, force):
            what = "moves air" if isinstance(force, AirForce) else "acts"
            findings.warn(("force", number), f"{what}, and nothing feels it: {_why(job, force)}")
        elif smoke := _smoke_around_all(job, force):
            findings.warn(
                ("force", number, "only"),
                f'names bodies alone, which start in the box of "{smoke}": there its pressure acts on them in place of '
                f'this air; add "{smoke}"',
            )
        if force.start_s >= job.film_s:
            findings.warn(
                ("force", number, "start_s"), f"is {force.start_s:g} s, and the film ends at {job.film_s:g} s"
            )
        if force.within is not None:
            box = _box(force.within)
            if not any(overlap(box, region) for region in simulated_regions(job)):
                findings.warn(("force", number, "within"), "is outside of all that is simulated; is the place meant?")


def _feel_it(job: Job, force: BaseForce) -> bool:
    return bool(_bodies_that_feel(job, force)) or _others_feel(job, force)


def _is_meant(force: BaseForce, *names: str) -> bool:
    return not force.only or bool(set(force.only) & set(names))


def _bodies_that_feel(job: Job, force: BaseForce) -> list[RigidBodyParameters]:
    meant = [body for body in job.rigid if body.kind == "dynamic" and _is_meant(force, body.name, body.group)]
    return [body for body in meant if body.air_drag > 0.0 or not isinstance(force, AirForce)]


def _others_feel(job: Job, force: BaseForce) -> bool:
    of_air = isinstance(force, AirForce)
    fluids = (fluid for fluid in job.fluid if _is_meant(force, fluid.name))
    cloths = (cloth for cloth in job.cloth if _is_meant(force, cloth.name))
    return (
        any(_is_meant(force, smoke.name) for smoke in job.smoke)
        or any(fluid.air_density > 0.0 or not of_air for fluid in fluids)
        or (not of_air and any(_is_meant(force, soft.name) for soft in job.soft))
        or any(cloth.air_density * (cloth.drag + cloth.skin_drag) > 0.0 or not of_air for cloth in cloths)
    )


def _smoke_around_all(job: Job, force: BaseForce) -> str | None:
    """Name of a smoke that keeps air off bodies, where these are all in boxes of smoke and nothing else feels it."""
    if not isinstance(force, AirForce) or _others_feel(job, force):
        return None
    boxes = {smoke.name: np.array(smoke.limits(job.domain)) for smoke in job.smoke}
    around = [
        next((name for name, (low, high) in boxes.items() if np.all((low <= place) & (place <= high))), None)
        for place in (np.array(body.position) for body in _bodies_that_feel(job, force))
    ]
    return around[0] if all(around) else None


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
