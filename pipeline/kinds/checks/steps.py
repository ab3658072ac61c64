"""Checks of fixed time steps against the speeds that the start of a job foretells."""

import math

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.model.job import Job
from pipeline.model.problems import Findings
from sim.fluid.parameters import FluidParameters
from sim.fluid.traits import TRAITS
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.paths import path_of
from sim.shapes.solid import Solid

# Of particles that hit a wall (docs/decisions/0021-fixed-steps-at-impacts.md): omega d/c_s in a lattice, omega on the
# samples of a wall over that, and the compression over v/c_s; omega grows with the cube of the density.
FREQUENCY_AT_REST = 1.1
STIFFENING_AT_WALLS = math.sqrt(28.0)
COMPRESSION_BY_IMPACTS = 1.9
# With these two longer steps bear impacts too: they take a particle's speed before it is pressed onto the samples.
WALL_FRICTION_AT_IMPACTS = 1.0
ARTIFICIAL_VISCOSITY_AT_IMPACTS = 0.1


def check_time_steps(job: Job, solids: Solids, findings: Findings) -> None:
    """Warn of fixed steps above what will be stable, in the flow or where it hits a wall."""
    for index, fluid in enumerate(job.fluid):
        if fluid.dt == "adaptive":
            continue
        speed = expected_speed(job, solids)
        stable, bearing = stable_dt(job, fluid, speed), _dt_bearing_impacts(fluid, speed)
        if fluid.dt > stable:
            findings.warn(
                ("fluid", index, "dt"),
                f'{fluid.dt:g} s is above the stable step of about {stable:.2g} s and may blow up; use "adaptive"',
            )
        elif fluid.dt > bearing:
            findings.warn(
                ("fluid", index, "dt"),
                f"{fluid.dt:g} s is above the {bearing:.2g} s that bear an impact on a wall, and may blow up there; "
                f'use "adaptive" or that, or wall_friction = {WALL_FRICTION_AT_IMPACTS:g} and artificial_viscosity = '
                f"{ARTIFICIAL_VISCOSITY_AT_IMPACTS:g}, or more of each",
            )


def expected_speed(job: Job, solids: Solids) -> float:
    """Largest speed [m/s] of fluid or bodies: the one that each starts with, and a fall through the whole domain.

    Spinning bodies count with the speed of their surface, kinematic ones with the largest on their path. All fluids
    and bodies count for each fluid, as they share one tank.
    """
    fall = 2.0 * math.hypot(*job.gravity) * math.dist(job.domain.min, job.domain.max)
    speeds = [math.hypot(*block.velocity) for fluid in job.fluid for block in fluid.block]
    speeds += [emitter.inflow_speed for fluid in job.fluid for emitter in fluid.emitter]
    fastest = math.sqrt(fall + max(speeds, default=0.0) ** 2)
    for index, body in enumerate(job.rigid):
        if body.kind != "static" and (solid := solids.get(("rigid", index))) is not None:
            fastest = max(fastest, _body_speed(body, solid, fall))
    return fastest


def _body_speed(body: RigidBodyParameters, solid: Solid, fall: float) -> float:
    """Largest speed of a point of a body [m/s]; `fall` is the square of the speed of a fall [m²/s²]."""
    reach = float(np.linalg.norm(np.abs(solid.bounds - np.asarray(body.position)).max(axis=0)))
    if body.kind == "kinematic":
        return path_of(body).largest_speed(reach)
    return math.sqrt(fall + math.hypot(*body.velocity) ** 2) + math.hypot(*body.angular_velocity) * reach


def stable_dt(job: Job, fluid: FluidParameters, speed: float) -> float:
    """Largest step [s] at a largest speed [m/s], by signals, cfl k d / (c_s + v), and by gravity."""
    traits, gravity = TRAITS[fluid.solver], math.hypot(*job.gravity)
    signal_speed = _speed_of_sound(fluid, speed) + speed
    by_signals = fluid.cfl * traits.cfl_number * fluid.spacing / signal_speed if signal_speed > 0.0 else math.inf
    by_gravity = traits.gravity_number * math.sqrt(fluid.spacing / gravity) if gravity > 0.0 else math.inf
    return min(by_signals, by_gravity)


def _dt_bearing_impacts(fluid: FluidParameters, speed: float) -> float:
    """The limit omega dt < 2 by the stiffest particle at a wall [s]; none where friction and viscosity soften it."""
    softened = (
        fluid.wall_friction >= WALL_FRICTION_AT_IMPACTS
        and fluid.artificial_viscosity >= ARTIFICIAL_VISCOSITY_AT_IMPACTS
    )
    sound = _speed_of_sound(fluid, speed)
    if softened or sound == 0.0:
        return math.inf
    at_rest = FREQUENCY_AT_REST * sound / fluid.spacing
    return 2.0 / (at_rest * STIFFENING_AT_WALLS * (1.0 + COMPRESSION_BY_IMPACTS * speed / sound) ** 3)


def _speed_of_sound(fluid: FluidParameters, speed: float) -> float:
    """The numerical one [m/s]; 0 in implicit solvers, which have none."""
    traits = TRAITS[fluid.solver]
    return fluid.sound_speed or traits.speed_ratio * speed if traits.has_sound_speed else 0.0
