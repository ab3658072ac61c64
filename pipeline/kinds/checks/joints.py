"""Checks of joints: bodies that are there and can move, lengths, places."""

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.kinds.checks.cloth_start import ClothStart
from pipeline.model.job import Job
from pipeline.model.problems import Findings, Problem
from sim.cloth.parameters import ClothParameters
from sim.coupling.cloth_joints import eyelet_mass, jointed_ends, node_near, off_cloth, place_of_end
from sim.rigid.joint_parameters import joint_problems, points_of

# Distance of a joint from its body, in radii of the body's box, from which it is told: a slip of an axis or a unit.
FAR_JOINT = 3.0


def check_joints(job: Job, findings: Findings) -> None:
    """Note joints that the simulation would refuse."""
    for problem in joint_problems(job.joint, job.rigid, cloths_of(job)):
        findings.error(("joint", problem.number, *([problem.key] if problem.key else [])), problem.sentence)


def cloths_of(job: Job) -> list[str]:
    """Names of the cloths of a job."""
    return [cloth.name for cloth in job.cloth]


def joined_to(cloth: ClothParameters, job: Job) -> set[str]:
    """Names of bodies that joints keep from touching a cloth."""
    joints = (joint for joint in job.joint if cloth.name in joint.between and not joint.contacts)
    return {name for joint in joints for name in joint.between}


def check_joints_of_cloth(start: ClothStart, job: Job, findings: Findings) -> None:
    """Note joints that are off a cloth, and tell what their eyelets weigh."""
    refused = {problem.number for problem in joint_problems(job.joint, job.rigid, cloths_of(job))}
    for number, joint in enumerate(job.joint):
        for end, _ in jointed_ends(joint, [start.cloth]) if number not in refused else ():
            problem = off_cloth(number, joint, end, start.cloth.name, start.position, start.longest_edge)
            if problem is not None:
                findings.error(("joint", number, problem.key), problem.sentence)
                continue
            node, _ = node_near(place_of_end(joint, end), start.position)
            mass = eyelet_mass(start.cloth, float(start.sheet.node_area[node]), job.fps, job.cloth)
            sentence = f'holds "{start.cloth.name}" by an eyelet of {1e3 * mass:.2g} g; more substeps make it lighter'
            findings.facts.append(Problem(("joint", number), sentence))


def check_anchors(job: Job, solids: Solids, findings: Findings) -> None:
    """Note joints far from the bodies that they hold, which an arm without mass would reach."""
    index_of = {body.name: index for index, body in enumerate(job.rigid)}
    refused = {problem.number for problem in joint_problems(job.joint, job.rigid, cloths_of(job))}
    for number, joint in enumerate(job.joint):
        if number in refused:
            continue
        for name, point in zip(joint.between, points_of(joint, job.rigid), strict=False):
            solid = solids.get(("rigid", index_of[name])) if name in index_of else None
            if solid is None:
                continue
            distance = float(solid.signed_distance(np.array([point]))[0])
            low, high = solid.bounds
            if distance > FAR_JOINT * 0.5 * float(np.linalg.norm(high - low)):
                findings.warn(
                    ("joint", number),
                    f'is {distance:.3g} m away from "{name}", as if an arm without mass held it; is the place meant?',
                )
