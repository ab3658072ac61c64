"""Checks of joints: bodies that are there and can move, lengths, places."""

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.cloth.parameters import ClothParameters
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
