"""Whether a fixed time step can hold the speeds that the start of a job foretells."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pipeline.job.positions import KeyPath
from pipeline.job.problems import Findings

if TYPE_CHECKING:
    from pipeline.job.models import Job
    from sim.fluid.parameters import FluidParameters
    from sim.rigid.parameters import RigidBodyParameters
    from sim.shapes import Solid

WAY_IN_SPACINGS = {"wcsph": 0.4, "dfsph": 0.4, "pcisph": 0.2}
"""Share of the particle spacing that a signal may cross in a step, by solver. These, and the next, are what the solvers
have, which are not imported here as that loads Taichi; a test holds them together."""
REST_NUMBER = {"wcsph": math.inf, "dfsph": 0.1, "pcisph": 0.05}
"""Largest step over sqrt(d/g), whatever the speed, by solver."""
SPEED_OF_SOUND_IN_SPEEDS = 10.0
"""The numerical speed of sound over the largest expected speed, for less than 1 % compression."""


def check_time_steps(job: Job, solids: Mapping[KeyPath, Solid], findings: Findings) -> None:
    """Warn of fixed steps above what will be stable.

    Args:
        job: the job.
        solids: its shapes as far as they can be built, by path.
        findings: where warnings go.
    """
    for index, fluid in enumerate(job.fluid):
        if fluid.dt == "adaptive":
            continue
        stable = _stable_dt(job, fluid, expected_speed(job, solids))
        if fluid.dt > stable:
            findings.warn(
                ("fluid", index, "dt"),
                f'{fluid.dt:g} s is above the stable step of about {stable:.2g} s and may blow up; use "adaptive"',
            )


def expected_speed(job: Job, solids: Mapping[KeyPath, Solid]) -> float:
    """Largest speed [m/s] of fluid or bodies: the one that each starts with, and a fall through the whole domain.

    Spinning bodies count with the speed of their surface, kinematic ones with the largest on their path. All fluids
    and bodies count for each fluid, as they share one tank.
    """
    fall = 2.0 * math.hypot(*job.gravity) * math.dist(job.domain.min, job.domain.max)
    speeds = [math.hypot(*block.velocity) for fluid in job.fluid for block in fluid.block]
    speeds += [emitter.speed for fluid in job.fluid for emitter in fluid.emitter]
    fastest = math.sqrt(fall + max(speeds, default=0.0) ** 2)
    for index, body in enumerate(job.rigid):
        if body.kind != "static" and (solid := solids.get(("rigid", index))) is not None:
            fastest = max(fastest, _body_speed(body, solid, fall))
    return fastest


def _body_speed(body: RigidBodyParameters, solid: Solid, fall: float) -> float:
    """Largest speed of a point of a body [m/s]; `fall` is the square of the speed of a fall [m²/s²]."""
    from sim.rigid.keyframes import path_of

    reach = float(np.linalg.norm(np.abs(solid.bounds - np.asarray(body.position)).max(axis=0)))
    if body.kind == "kinematic":
        return path_of(body).largest_speed(reach)
    return math.sqrt(fall + math.hypot(*body.velocity) ** 2) + math.hypot(*body.angular_velocity) * reach


def _stable_dt(job: Job, fluid: FluidParameters, speed: float) -> float:
    """The limits by signals, cfl k d / (c_s + v), and by gravity [s]."""
    spacing, gravity = 2.0 * fluid.particle_radius, math.hypot(*job.gravity)
    explicit = fluid.solver == "wcsph"
    sound = (fluid.sound_speed or SPEED_OF_SOUND_IN_SPEEDS * speed) if explicit else 0.0
    way = fluid.cfl * WAY_IN_SPACINGS[fluid.solver] * spacing
    by_signals = way / (sound + speed) if sound + speed > 0.0 else math.inf
    by_gravity = REST_NUMBER[fluid.solver] * math.sqrt(spacing / gravity) if gravity > 0.0 else math.inf
    return min(by_signals, by_gravity)
