"""Checks of joints to cloths: places, and what their eyelets weigh."""

from pipeline.kinds.checks.cloth_start import ClothStart
from pipeline.kinds.checks.joints import cloths_of
from pipeline.model.job import Job
from pipeline.model.problems import Findings, Problem
from sim.coupling.cloth_joints import eyelet_mass, jointed_ends, node_near, off_cloth, place_of_end
from sim.rigid.joint_parameters import joint_problems


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
