"""How long a frame of fluid will take, from what the job says: its particles, their size, and how fast they will be."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from pipeline.job.step_checks import SPEED_OF_SOUND_IN_SPEEDS, stable_dt
from pipeline.live.pace import fewest_for_bodies
from sim.fluid.expected_speed import expected_speed
from sim.fluid.time_step import VISCOUS_NUMBER

if TYPE_CHECKING:
    from pipeline.job.models import Job

PARTICLE_STEP_S = {"wcsph": 0.45e-6, "dfsph": 2.3e-6, "pcisph": 1.7e-6}
"""Core time of a particle in a step at a support of two spacings [s] (docs/live.md)."""

VISCOUS_STEP_S = 12.0e-6
"""What solving for viscosity adds to it [s]: 20 to 70 iterations a step, where a pressure takes 3 to 12."""

BODIES_FACTOR = 2.0
"""How much more an implicit pressure takes where it carries bodies, near which it is solved for ten times better."""

STEP_S = {"wcsph": 0.25e-3, "dfsph": 1.7e-3, "pcisph": 1.7e-3}
"""Of a step, however few particles there are, and however many cores: launches of its kernels [s]."""

VISCOUS_LAUNCHES_S = 3.0e-3
"""What solving for viscosity adds to that [s]."""

SPLASHING = {"wcsph": 1.6, "dfsph": 1.8, "pcisph": 1.8}
"""Largest speed over that of a fall from the top: jets are faster, and squeezed particles of wcsph are stiffer."""

BRAKED = 0.5
"""The same of a fluid so stiff that its viscosity is solved for."""


def fluid_frame_s(job: Job, particles: int, *, power: float) -> float:
    """About how long a frame of the fluids takes [s], on so many cores.

    Args:
        job: as it is simulated live.
        particles: of all fluids.
        power: cores that compute it.

    Raises:
        ShapeError: a block cannot be built.
    """
    if not job.fluid:
        return 0.0
    shared, is_viscous = job.fluid[0], _is_implicit(job)
    particle_s = PARTICLE_STEP_S[shared.solver] * (shared.support_in_spacings / 2.0) ** 3
    if shared.solver != "wcsph" and any(body.kind == "dynamic" for body in job.rigid):
        particle_s *= BODIES_FACTOR
    step_s = STEP_S[shared.solver]
    if is_viscous:
        particle_s, step_s = particle_s + VISCOUS_STEP_S, step_s + VISCOUS_LAUNCHES_S
    return steps_a_frame(job) * (particles * particle_s / power + step_s)


def steps_a_frame(job: Job) -> float:
    """About how many steps a frame the fluids of a job will take."""
    shared = job.fluid[0]
    if shared.dt != "adaptive":
        dt = float(shared.dt)
    else:
        is_viscous = _is_implicit(job)
        dt = stable_dt(job, shared, (BRAKED if is_viscous else SPLASHING[shared.solver]) * _fall_speed(job))
        stiffest = _stiffest(job)
        if stiffest > 0.0 and not is_viscous:
            dt = min(dt, VISCOUS_NUMBER * (2.0 * shared.particle_radius) ** 2 / stiffest)
    return max(1.0 / (job.fps * dt), float(fewest_for_bodies(job)))


def _is_implicit(job: Job) -> bool:
    """Whether viscosity is solved for."""
    from sim.fluid.viscosity_implicit import is_implicit

    shared = job.fluid[0]
    speed = _fall_speed(job)
    return is_implicit(
        shared.viscosity_solver,
        viscosity=_stiffest(job),
        spacing=2.0 * shared.particle_radius,
        speed=speed if shared.solver != "wcsph" else shared.sound_speed or SPEED_OF_SOUND_IN_SPEEDS * speed,
        dt=shared.dt,
        cfl=shared.cfl,
    )


def _stiffest(job: Job) -> float:
    """Kinematic viscosity of the stiffest fluid, against walls too [m²/s]."""
    return max(fluid.viscosity for fluid in job.fluid) * max(1.0, job.fluid[0].wall_friction)


def _fall_speed(job: Job) -> float:
    """Largest speed [m/s] of what falls from the top of a block, or out of an opening, to the domain's floor."""
    from sim.shapes import build_solid

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
