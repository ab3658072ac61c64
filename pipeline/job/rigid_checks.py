"""Whether the bodies that move can start where the job puts them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.shapes import Solid


def check_rigid_start(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """Note dynamic bodies that overlap others or walls, as the simulation would refuse them.

    Bodies without a shape in `solids` have been found wanting already; then nothing is looked at.
    """
    from sim.rigid.solver import RigidSolver
    from sim.rigid.start import start_problems
    from sim.shapes import ShapeError

    dynamic = [index for index, body in enumerate(job.rigid) if body.kind == "dynamic"]
    if not dynamic or any(("rigid", index) not in solids for index in range(len(job.rigid))):
        return
    moving = [body for body in job.rigid if body.kind != "static"]
    static = [body for body in job.rigid if body.kind == "static"]
    try:
        solver = RigidSolver(moving, obstacles=static, domain=job.domain, gravity=job.gravity)
        problems = start_problems(solver)
    except ShapeError as error:
        findings.error(("rigid", dynamic[0], "shape"), f"cannot be that of a body that moves: {error}")
        return
    index_of = {body.name: index for index, body in enumerate(job.rigid)}
    for problem in problems:
        findings.error(("rigid", index_of[problem.body]), problem.sentence)
