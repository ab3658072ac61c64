"""Work of a frame, by kind of body: how long it takes to compute on the reference machine, before any is measured.

`frame_s` is of the EPYC cores of docs/performance.md, which pages that run live count in. `Work` is of the reference
machine of whole films, a virtual core of a Xeon server, or an H200 beside it (docs/decisions/0047);
`pipeline.run.rates` knows how fast this machine is beside it.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from pipeline.kinds.base import Work
from pipeline.kinds.checks.steps import stable_dt
from pipeline.kinds.elements import count_cloth_nodes, most_particles_of
from pipeline.model.job import Job
from sim.cloth.parameters import substeps_of
from sim.fluid.expected_speed import expected_speed
from sim.fluid.parameters import is_implicit
from sim.fluid.traits import TRAITS, VISCOUS_NUMBER
from sim.smoke.parameters import SmokeParameters


class GpuRates(NamedTuple):
    """Rates of a kind on a GPU."""

    element_s: float  # of an element in a step, of the GPU [s]
    step_s: float  # of a step, of the host [s]


GPU_RATES = {
    "wcsph": GpuRates(0.5e-9, 0.25e-3),
    "dfsph": GpuRates(10e-9, 1.7e-3),
    "pcisph": GpuRates(7.5e-9, 1.7e-3),
    "viscous": GpuRates(60e-9, 7.0e-3),
    "cloth": GpuRates(80e-9, 2.4e-3),
    "smoke": GpuRates(1.2e-9, 2.5e-3),
    "soft": GpuRates(1.0e-9, 0.5e-3),
}
"""Of fluids by solver, of solving for viscosity on top, of cloth, smoke and soft matter."""
PARTICLE_FRAME_S, CELL_FRAME_S = 0.13e-6, 0.063e-6
"""Time of the host that a particle or a cell takes on its way from a GPU to the disk, in each frame [s]."""
CELL_STEP_S = 0.25e-6
"""Core time of a cell in a step of smoke [s]."""
CELL_STEP_LAUNCHES_S = 35e-3
"""Time of launches of a step of smoke, however few its cells [s]."""
GUIDING_SHARE = 0.1
"""Time that being drawn to a guide adds to a step of smoke, over it [-]."""
RISING_SHARE = 0.7
"""Largest speed of buoyant smoke over that of a free rise through its box."""
PASSING_FACTOR = 2.0
"""Largest speed of air over that of the wind, or of a body that it has to get round."""
SOFT_PARTICLE_STEP_S, SOFT_STEP_S = 0.7e-6, 0.5e-3
"""Core time of a particle of soft matter in a step, and of launches [s]."""
BODY_STEP_S = 0.3e-3
"""Time of a rigid body in a step: contacts are the host's [s]."""
SURFACE_PARTICLE_S = 1.0e-3
"""Time of a surface over the number of its particles to the power 2/3, at the usual cubes [s]."""
USUAL_CUBE_SIZE = 0.75
"""In radii."""
CLOTH_REFINEMENT = 1.2
"""Steps of cloth over those that it asks for where contacts make it take more."""
SLOWER = 3.5
"""Time of the reference machine over that of a free EPYC core, which the rates above are of."""

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
    shared = job.fluid[0]
    signal_speed = shared.sound_speed or TRAITS[shared.solver].speed_ratio * _fall_speed(job)
    return is_implicit(shared, _stiffest(job), signal_speed)


def _stiffest(job: Job) -> float:
    """Kinematic viscosity of the stiffest fluid, against walls too [m²/s]."""
    return max(fluid.viscosity for fluid in job.fluid) * max(1.0, job.fluid[0].wall_friction)


def _fall_speed(job: Job) -> float:
    """Largest speed [m/s] of what falls from the top of a block, or out of an opening, to the domain's floor."""
    from pipeline.kinds.checks.fluid import openings_of
    from sim.shapes.placement import build_solid

    points, velocities = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for index, fluid in enumerate(job.fluid):
        for block in fluid.block:
            low, high = build_solid(block).bounds
            points.append(
                np.clip(np.array(list(product(*zip(low, high, strict=True)))), job.domain.min, job.domain.max)
            )
            velocities.append(np.tile(block.velocity, (8, 1)))
        for _, opening in openings_of(job, index):
            place, velocity = opening.first_jet
            points.append(place[None])
            velocities.append(velocity[None])
    return expected_speed(np.concatenate(points), np.concatenate(velocities), job.domain, job.gravity)


def soft_frame_s(job: Job, particles: int, *, power: float) -> float:
    """Time that a frame of soft matter takes [s], of this many particles."""
    return shared_steps(job) * (particles * SOFT_PARTICLE_STEP_S / power + SOFT_STEP_S) if job.soft else 0.0


def frame_s(job: Job, particles: int, soft_particles: int, *, power: float) -> float:
    """Time that a frame of a scene takes [s]; rigid bodies cost next to nothing. Raises ShapeError as above."""
    of_particles = fluid_frame_s(job, particles, power=power) + soft_frame_s(job, soft_particles, power=power)
    return cloth_frame_s(job, power=power) + of_particles


# --- work, of which films are estimated ---


def _on_reference(shared_s: float, host_s: float, *, on_gpu: bool = False) -> Work:
    """Work of times on an EPYC core, or on the GPU and an EPYC core."""
    return Work(shared_s if on_gpu else SLOWER * shared_s, SLOWER * host_s)


def shared_steps(job: Job) -> float:
    """Steps a frame that fluids, cloths and bodies take together; smoke follows with its own."""
    steps = float(fewest_for_bodies(job)) if job.moving_bodies else 1.0
    if job.cloth:
        steps = max(steps, CLOTH_REFINEMENT * substeps_of(job.cloth))
    if job.fluid:
        steps = max(steps, steps_a_frame(job))
    if job.soft:
        steps = max(steps, 1.0 / (job.fps * min(soft.longest_step for soft in job.soft)))
    return steps


def fluid_work(job: Job, particles: float, on_gpu: bool) -> Work:
    """Of a frame of all fluids, of this many particles."""
    steps = shared_steps(job)
    if not on_gpu:
        own = steps_a_frame(job)
        alone = fluid_frame_s(job, 0, power=1.0) * steps / own
        return _on_reference(fluid_frame_s(job, round(particles), power=1.0) * steps / own - alone, alone)
    shared = job.fluid[0]
    rates = GPU_RATES[shared.solver]
    carries = not TRAITS[shared.solver].has_sound_speed and any(body.kind == "dynamic" for body in job.rigid)
    factor = BODIES_FACTOR if carries else 1.0
    viscous = GPU_RATES["viscous"] if _is_implicit(job) else GpuRates(0.0, 0.0)
    wider = (shared.support_in_spacings / 2.0) ** 3
    return _on_reference(
        steps * particles * (factor * wider * rates.element_s + viscous.element_s),
        steps * (factor * rates.step_s + viscous.step_s) + particles * PARTICLE_FRAME_S,
        on_gpu=True,
    )


def cloth_work(job: Job, nodes: float, on_gpu: bool) -> Work:
    """Of a frame of all cloths, of this many nodes."""
    steps = shared_steps(job)
    meets = any(cloth.self_collision for cloth in job.cloth) or len(job.cloth) > 1
    share = 1.0 if meets else APART_SHARE
    if not on_gpu:
        return _on_reference(nodes * steps * NODE_SUBSTEP_S * share, 0.0)
    rates = GPU_RATES["cloth"]
    return _on_reference(steps * nodes * rates.element_s * share, steps * rates.step_s * share, on_gpu=True)


def smoke_work(job: Job, cells: float, on_gpu: bool) -> Work:
    """Of a frame of all smokes, of this many cells, with their guides."""
    steps = max(_smoke_steps(job, index) for index in range(len(job.smoke)))
    guided = [smoke for smoke in job.smoke if smoke.upres > 1]
    computed = cells * (1.0 + max(map(guide_share, guided), default=0.0))
    launches = steps * (len(job.smoke) + sum(1.0 / smoke.upres for smoke in guided))
    if not on_gpu:
        return _on_reference(steps * computed * CELL_STEP_S, launches * CELL_STEP_LAUNCHES_S)
    rates = GPU_RATES["smoke"]
    host_s = launches * rates.step_s + cells * CELL_FRAME_S
    return _on_reference(steps * computed * rates.element_s, host_s, on_gpu=True)


def guide_share(smoke: SmokeParameters) -> float:
    """Time of a guide, and of being guided, over that of the smoke's own steps."""
    return smoke.upres**-4 + GUIDING_SHARE


def soft_work(job: Job, particles: float, on_gpu: bool) -> Work:
    """Of a frame of all soft matter, of this many particles."""
    steps = shared_steps(job)
    if not on_gpu:
        return _on_reference(steps * particles * SOFT_PARTICLE_STEP_S, steps * SOFT_STEP_S)
    rates = GPU_RATES["soft"]
    return _on_reference(steps * particles * rates.element_s, steps * rates.step_s, on_gpu=True)


def _smoke_steps(job: Job, index: int) -> float:
    """Steps a frame that a smoke will take, by the speed of its wind, its rise or what moves in it."""
    smoke = job.smoke[index]
    size = math.dist(*smoke.corners(job.domain)) / math.sqrt(3.0)
    lift = smoke.lift_per_kelvin(job.gravity)
    pull = max(
        lift * abs(source.temperature - smoke.ambient_temperature) + smoke.buoyancy_density * source.density
        for source in smoke.source
    )
    pull = max(pull, lift * smoke.hottest_excess)
    fastest = max(math.hypot(*(source.velocity or (0.0, 0.0, 0.0))) for source in smoke.source)
    rise = RISING_SHARE * math.sqrt(fastest**2 + 2.0 * pull * size)
    speed = max(rise, PASSING_FACTOR * math.hypot(*smoke.wind))
    return max(1.0, speed / (smoke.cfl * smoke.cell_size * job.fps))


def rigid_work(job: Job, _elements: float, _on_gpu: bool) -> Work:
    """Of a frame of the bodies that move."""
    return _on_reference(0.0, shared_steps(job) * len(job.moving_bodies) * BODY_STEP_S)


def mean_particles(job: Job, particles: float) -> float:
    """Mean number of particles over a film at whose end there are so many: emitters fill it as it goes."""
    most = sum(most_particles_of(fluid, job, until_s=job.film_s) for fluid in job.fluid)
    halfway = sum(most_particles_of(fluid, job, until_s=0.5 * job.film_s) for fluid in job.fluid)
    return particles * halfway / most if most else particles


def surface_work(job: Job, particles: float) -> Work:
    """Of the surface of a fluid of this many particles in a frame."""
    return Work(0.0, SURFACE_PARTICLE_S * particles ** (2.0 / 3.0) * surface_fineness(job))


def surface_fineness(job: Job) -> float:
    """Triangles of a surface over those of one of the usual cubes [-]."""
    return (USUAL_CUBE_SIZE / job.surface.cube_size_in_radii) ** 2
