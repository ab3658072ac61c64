"""Checks of rigid bodies: places, starts of those that move, ballast."""

from dataclasses import replace

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.model.boxes import domain_box, overlap, simulated_regions, span
from pipeline.model.job import Job
from pipeline.model.problems import Findings, Problem
from sim.rigid.joint_parameters import joint_problems
from sim.rigid.solver import RigidSolver
from sim.rigid.start import start_problems
from sim.rigid.steps import groups_of
from sim.shapes.parameters import PieceShape
from sim.shapes.solid import ShapeError

# Share of a body's size by which ballast on its surface may be outside, as decimals do not add up exactly.
ROUND_OFF = 1.0e-6


def check_places(job: Job, solids: Solids, findings: Findings) -> None:
    """Note bodies that are wholly outside of the domain and of every smoke's box."""
    domain, regions = domain_box(job.domain), simulated_regions(job)
    for path, solid in solids.items():
        if path[0] == "rigid" and not any(overlap(solid.bounds, region) for region in regions):
            findings.error(path, f"is wholly outside the domain: it spans {span(solid.bounds)}, not {span(domain)}")


def check_ballast(job: Job, solids: Solids, findings: Findings) -> None:
    """Note ballast that lies outside of its body: a slip of the unit, most likely, that would topple the body."""
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if not body.ballast or solid is None:
            continue
        unturned = replace(solid, rotation=np.eye(3), position=np.zeros(3))
        low, high = unturned.bounds
        distances = unturned.signed_distance(np.array([ballast.position for ballast in body.ballast]))
        for number, distance in enumerate(distances):
            if distance > ROUND_OFF * float(np.max(high - low)):
                findings.error(
                    ("rigid", index, "ballast", number, "position"),
                    f"lies {distance:.3g} m outside of the body, whose shape spans {span(unturned.bounds)}; "
                    "give it in metres from the shape's centre, before the body is turned",
                )


def check_pieces(job: Job, solids: Solids, findings: Findings) -> None:
    """Note the number and sizes of the pieces of each body that breaks; warn of those that nothing glues."""
    from sim.shapes.cutting import cut_of

    wholes: dict[str, dict[int, float]] = {}
    for index, body in enumerate(job.rigid):
        solid = solids.get(("rigid", index))
        if body.whole is not None and solid is not None:
            wholes.setdefault(body.whole, {})[index] = solid.volume
    for whole, volumes in wholes.items():
        smallest = min(volumes, key=volumes.__getitem__)
        mean = sum(volumes.values()) / len(volumes)
        sentence = (
            f'"{whole}" has {len(volumes)} pieces, the smallest, "{job.rigid[smallest].name}", of '
            f"{1e6 * volumes[smallest]:.3g} cm³, the mean of {1e6 * mean:.3g} cm³"
        )
        findings.facts.append(Problem(("rigid", smallest, "breaks"), sentence))
        shape = job.rigid[smallest].shape
        assert isinstance(shape, PieceShape), "pieces are made by what breaks"
        faces = cut_of(shape).faces
        first, second = (np.array([getattr(face, side) for face in faces], int) for side in ("first", "second"))
        count = int(groups_of(first, second, len(volumes)).max()) + 1
        if count > 1:
            findings.warn(
                ("rigid", smallest, "breaks"),
                f'"{whole}" is in {count} from the start: only plane faces that lie on each other are glued; move '
                "parts until they touch by one",
            )


def check_rigid_start(job: Job, solids: Solids, findings: Findings) -> None:
    """Note dynamic bodies that overlap others or walls, as the simulation would refuse them.

    Bodies without a shape in `solids` have been found wanting already; then nothing is looked at.
    """
    # Joints to cloths keep no bodies from each other, and are refused where these are not told.
    refused = {problem.number for problem in joint_problems(job.joint, job.rigid)}
    joints = [joint for number, joint in enumerate(job.joint) if number not in refused]
    dynamic = [index for index, body in enumerate(job.rigid) if body.kind == "dynamic"]
    if not dynamic or any(("rigid", index) not in solids for index in range(len(job.rigid))):
        return
    moving = [body for body in job.rigid if body.kind != "static"]
    static = [body for body in job.rigid if body.kind == "static"]
    try:
        solver = RigidSolver(moving, obstacles=static, joints=joints, domain=job.domain, gravity=job.gravity)
        problems = start_problems(solver)
    except ShapeError as error:
        findings.error(("rigid", dynamic[0], "shape"), f"cannot be that of a body that moves: {error}")
        return
    index_of = {body.name: index for index, body in enumerate(job.rigid)}
    for problem in problems:
        findings.error(("rigid", index_of[problem.body]), problem.sentence)
