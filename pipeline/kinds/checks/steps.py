"""Checks of fixed time steps against the speeds that the start of a job foretells."""

import math

import numpy as np

from pipeline.kinds.base import Solids
from pipeline.model.amounts import rounded_down, rounded_up
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


SLOWED_BY_TENSION = 4.0
"""Steps that surface tension asks for over those of the flow from which on it is worth a warning."""

PARTS_OF_DYE = 8.9
"""Parts that diffusion takes a time t in, over D t/d² (`sim.fluid.dye`, at a support of 2 d)."""
MANY_PARTS = 200.0
"""Such parts a frame from which on they are worth a warning: they take as long as ten steps of the flow."""


def check_time_steps(job: Job, solids: Solids, findings: Findings) -> None:
    """Warn of fixed steps above what will be stable, in the flow or at walls, of stiff surfaces, and of fast dye."""
    for index, fluid in enumerate(job.fluid):
        _check_dye(job, index, findings)
        speed = expected_speed(job, solids)
        if fluid.dt == "adaptive":
            _check_tension(job, index, _dt_of_flow(job, fluid, speed), findings)
            continue
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


def _check_tension(job: Job, index: int, of_flow: float, findings: Findings) -> None:
    """Warn of a surface tension whose steps are much shorter than those of the flow, of_flow [s]."""
    fluid = job.fluid[index]
    allowed = fluid.tension_step
    slower = of_flow / allowed
    if slower > SLOWED_BY_TENSION:
        # Steps go as the root of the tension, and as d^1.5 where those of the flow go as d.
        bearable = rounded_down(fluid.surface_tension * (SLOWED_BY_TENSION / slower) ** 2)
        radius = rounded_up(fluid.particle_radius * (slower / SLOWED_BY_TENSION) ** 2)
        findings.warn(
            ("fluid", index, "surface_tension"),
            f"asks for steps of {allowed:.2g} s, {1.0 / (job.fps * allowed):,.0f} a frame, {slower:.2g} times as many "
            f"as the flow; use {bearable:g} or less, or particle_radius {radius:g} m or more",
        )


def _check_dye(job: Job, index: int, findings: Findings) -> None:
    """Warn of a dye that diffuses so fast that particles have to exchange it many times a frame."""
    fluid = job.fluid[index]
    parts = PARTS_OF_DYE * fluid.dye_diffusivity / (job.fps * fluid.spacing**2)
    if fluid.has_dye and parts > MANY_PARTS:
        bearable = rounded_down(fluid.dye_diffusivity * MANY_PARTS / parts)
        findings.warn(
            ("fluid", index, "dye_diffusivity"),
            f"neighbours have to exchange dye {parts:,.0f} times a frame; use {bearable:g} m²/s or less",
        )


def stable_dt(job: Job, fluid: FluidParameters, speed: float) -> float:
    """Largest step [s] at a largest speed [m/s], by the flow and by the surface tension of all fluids."""
    return min(_dt_of_flow(job, fluid, speed), *(each.tension_step for each in job.fluid))


def _dt_of_flow(job: Job, fluid: FluidParameters, speed: float) -> float:
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
