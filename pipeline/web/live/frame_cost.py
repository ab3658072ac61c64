"""Cost of a frame: estimates, by kind of body, of how long it takes to compute. Estimated, not measured."""

import math
from itertools import product

import numpy as np

from pipeline.kinds.checks.steps import stable_dt
from pipeline.kinds.cloth import count_cloth_nodes
from pipeline.model.job import Job
from sim.cloth.parameters import substeps_of
from sim.fluid.expected_speed import expected_speed
from sim.fluid.traits import TRAITS, VISCOUS_NUMBER

NODE_SUBSTEP_S = 1.4e-6
"""Core time of a node in a substep of cloth in contact [s], with room for page and browser (docs/guide/live.md)."""
APART_SHARE = 0.4
"""Share of it where cloth does not collide with itself."""
VISCOUS_STEP_S = 12.0e-6
"""Core time of a particle that solving for viscosity adds to a step [s]: 20 to 70 iterations."""
BODIES_FACTOR = 2.0
"""Factor of an implicit pressure that carries bodies, near which it is solved for ten times better."""
VISCOUS_LAUNCHES_S = 3.0e-3
"""Time of launches that solving for viscosity adds to a step [s]."""
BRAKED = 0.5
"""Largest speed over that of a fall from the top, of a fluid so stiff that its viscosity is solved for."""


def fewest_for_bodies(job: Job) -> int:
    """Substeps a frame that the bodies of a scene need: its cloths take as many, however few they ask for."""
    from sim.rigid.solver import largest_dt

    return max(1, math.ceil(1.0 / (job.fps * largest_dt(job.rigid))))


def cloth_frame_s(job: Job, *, power: float) -> float:
    """Time that a frame of the cloths takes [s], on as many cores as `power`."""
    if not job.cloth:
        return 0.0
    substeps = max(substeps_of(job.cloth), fewest_for_bodies(job))
    meets = any(cloth.self_collision for cloth in job.cloth) or len(job.cloth) > 1
    return count_cloth_nodes(job) * substeps * NODE_SUBSTEP_S * (1.0 if meets else APART_SHARE) / power


def fluid_frame_s(job: Job, particles: int, *, power: float) -> float:
    """Time that a frame of the fluids takes [s], of this many particles. Raises ShapeError: a block cannot be built."""
    if not job.fluid:
        return 0.0
    shared, is_viscous = job.fluid[0], _is_implicit(job)
    traits = TRAITS[shared.solver]
    particle_s = traits.particle_step_s * (shared.support_in_spacings / 2.0) ** 3
    if not traits.has_sound_speed and any(body.kind == "dynamic" for body in job.rigid):
        particle_s *= BODIES_FACTOR
    step_s = traits.step_s
    if is_viscous:
        particle_s, step_s = particle_s + VISCOUS_STEP_S, step_s + VISCOUS_LAUNCHES_S
    return steps_a_frame(job) * (particles * particle_s / power + step_s)


def steps_a_frame(job: Job) -> float:
    """Steps a frame that the fluids of a job will take."""
    shared = job.fluid[0]
    if shared.dt != "adaptive":
        dt = float(shared.dt)
    else:
        is_viscous = _is_implicit(job)
        dt = stable_dt(job, shared, (BRAKED if is_viscous else TRAITS[shared.solver].splash_factor) * _fall_speed(job))
        stiffest = _stiffest(job)
        if stiffest > 0.0 and not is_viscous:
            dt = min(dt, VISCOUS_NUMBER * (2.0 * shared.particle_radius) ** 2 / stiffest)
    return max(1.0 / (job.fps * dt), float(fewest_for_bodies(job)))


def _is_implicit(job: Job) -> bool:
    """Whether viscosity is solved for."""
    from sim.fluid.viscosity import is_implicit

    shared = job.fluid[0]
    signal_speed = shared.sound_speed or TRAITS[shared.solver].speed_ratio * _fall_speed(job)
    return is_implicit(shared, _stiffest(job), signal_speed)


def _stiffest(job: Job) -> float:
    """Kinematic viscosity of the stiffest fluid, against walls too [m²/s]."""
    return max(fluid.viscosity for fluid in job.fluid) * max(1.0, job.fluid[0].wall_friction)


def _fall_speed(job: Job) -> float:
    """Largest speed [m/s] of what falls from the top of a block, or out of an opening, to the domain's floor."""
    from sim.shapes.placement import build_solid

    points, velocities = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for fluid in job.fluid:
        for block in fluid.block:
            low, high = build_solid(block).bounds
            points.append(
                np.clip(np.array(list(product(*zip(low, high, strict=True)))), job.domain.min, job.domain.max)
            )
            velocities.append(np.tile(block.velocity, (8, 1)))
        for emitter in fluid.emitter:
            direction = np.asarray(emitter.direction)
            points.append(np.array([emitter.position]))
            velocities.append(np.array([emitter.speed / np.linalg.norm(direction) * direction]))
    return expected_speed(np.concatenate(points), np.concatenate(velocities), job.domain, job.gravity)


def frame_s(job: Job, particles: int, *, power: float) -> float:
    """Time that a frame of a scene takes [s]; rigid bodies cost next to nothing. Raises ShapeError as above."""
    return cloth_frame_s(job, power=power) + fluid_frame_s(job, particles, power=power)
