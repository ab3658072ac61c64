"""Admission: jobs that can run live, how large they may be, and the steps in which they are simulated.

A film's cloth takes as many substeps as look right and collides with itself; ten thousand nodes of it take several
times longer than a hand can wait for. Only what does not fit is given up, told, and can be had back: substeps first,
which make cloth softer, then its collisions with itself.
"""

import math
from collections.abc import Mapping

from pipeline.base.errors import PipelineError
from pipeline.kinds.elements import count_cloth_nodes
from pipeline.kinds.live_parameters import Value
from pipeline.kinds.table import KINDS
from pipeline.kinds.work import cloth_frame_s, fewest_for_bodies, frame_s, shared_steps, steps_a_frame
from pipeline.model.job import Job
from pipeline.web.live.parameters import parameters_of
from sim.cloth.parameters import ClothParameters, substeps_of

GPU_CORES = 20
"""Cores that a GPU counts as: scenes that fit here are too small to fill it."""
MOST_FRAME_S = 0.25
"""Longest frame [s]: slower than four pictures a second nobody can steer anything."""
MOST_SLOWDOWN = 15.0
"""Most that it may be slower than real time: where things hardly move, nobody sees what a drag has done."""
FLUENT_FRAME_S = 1.0 / 30.0
"""Longest frame of a fluent scene [s]."""
FLUENT_SLOWDOWN = 2.0
"""Most that a fluent scene may be slower than real time."""
FEWEST_SUBSTEPS = 6
"""In fewer, springs beside a corner that carries a sheet are overstretched (docs/guide/live.md)."""
FEWEST_COLLIDING = 10
"""Where cloth collides with itself, fewer substeps gain nothing: contacts have the more to do."""
_CHANGED_KEYS = ("substeps", "self_collision")


def live_job(job: Job, *, substeps: int | None = None) -> Job:
    """The job as it is simulated live: bodies that rest can be moved where there is no fluid, and steps are as asked.

    Raises PipelineError: live does not run what the job has.
    """
    for kind in KINDS.values():
        if kind.live is None and kind.bodies(job):
            raise PipelineError(f"{job.name}: {kind.name} does not run live; `pipeline animatic` draws it fast")
    if not (job.moving_bodies or any(kind.bodies(job) for kind in KINDS.values() if kind.name != "rigid")):
        raise PipelineError(f"{job.name}: nothing moves in it; live runs cloth, rigid bodies, fluids and soft matter")
    changes: dict[str, object] = {}
    if substeps is not None:
        if not job.cloth or job.cloth[0].integrator != "xpbd":
            raise PipelineError(f'{job.name}: --substeps is for cloth with integrator = "xpbd"')
        changes["cloth"] = with_substeps(job.cloth, substeps)
    if not job.fluid:
        changes["rigid"] = tuple(
            body.model_copy(update={"kind": "kinematic"}) if body.kind == "static" else body for body in job.rigid
        )
    return job.model_copy(update=changes)


def with_substeps(cloth: tuple[ClothParameters, ...], count: int) -> tuple[ClothParameters, ...]:
    """The same cloths in another number of substeps a frame."""
    return tuple(each.model_copy(update={"substeps": count}) for each in cloth)


def computing_power(*, cores: int, on_gpu: bool) -> int:
    """Cores that compute a scene, with a GPU as so many."""
    return GPU_CORES if on_gpu else cores


def require_small(job: Job, particles: int, soft_particles: int = 0, *, cores: int, on_gpu: bool) -> None:
    """Refuse a scene whose frames would take too long on this many cores, or on a GPU.

    `particles` are those that its fluids will have, as the checks count them: of emitters, what flows in in the film;
    `soft_particles` those of its soft matter.

    Raises PipelineError: says about how long a frame takes, and what would fit.
    """
    nodes = count_cloth_nodes(job)
    power = computing_power(cores=cores, on_gpu=on_gpu)
    took_s = frame_s(job, particles, soft_particles, power=power)
    most_s = min(MOST_FRAME_S, MOST_SLOWDOWN / job.fps)
    if took_s <= most_s:
        return
    share = most_s / took_s
    sizes, remedies = [], []
    if nodes:
        for_bodies = fewest_for_bodies(job)
        substeps = max(substeps_of(job.cloth), for_bodies)
        sizes.append(f"{nodes:,} cloth nodes at {substeps} substeps a frame")
        remedies.append(f"about {int(nodes * share):,} nodes fit")
        fitting = int(substeps * share)
        # Explicit springs dictate theirs, and cloth that does not collide with itself has given up what it could.
        can_take_fewer = job.cloth[0].integrator == "xpbd" and any(cloth.self_collision for cloth in job.cloth)
        if can_take_fewer and fitting >= for_bodies:
            remedies[-1] += f", or --substeps {fitting}"
    if particles:
        steps = math.ceil(steps_a_frame(job))
        sizes.append(f"about {particles:,} particles at {steps} {'step' if steps == 1 else 'steps'} a frame")
        # Larger particles, which are fewer, take longer steps: a frame goes by the inverse fourth power of the radius.
        remedies.append(f"about {particles * share**0.75:,.0f} particles fit")
    if soft_particles:
        steps = math.ceil(shared_steps(job))
        sizes.append(f"about {soft_particles:,} particles of soft matter at {steps} steps a frame")
        remedies.append(f"about {soft_particles * share**0.75:,.0f} of them fit")  # as their steps grow with the cells
    where = "the GPU" if on_gpu else f"{cores} cores"
    raise PipelineError(
        f"{job.name} is too large to steer: {' and '.join(sizes)} take some {took_s:.2g} s a frame on "
        f"{where}, {most_s:.2g} s at most; {', '.join(remedies)} (--preview may do); --anyway runs it"
    )


# --- steps that are fluent ---


def fluent_frame_s(job: Job) -> float:
    """Longest frame of a scene that is fluent [s]."""
    return min(FLUENT_FRAME_S, FLUENT_SLOWDOWN / job.fps)


def fluent(job: Job, *, power: float) -> Job:
    """The job in steps that run fluently on as many cores as `power`, if it has any cloth that is too slow."""
    if not job.cloth or job.cloth[0].integrator != "xpbd" or cloth_frame_s(job, power=power) <= fluent_frame_s(job):
        return job
    fewer = _in_fewer_substeps(job, FEWEST_COLLIDING, power=power)
    if cloth_frame_s(fewer, power=power) <= fluent_frame_s(job) or len(job.cloth) > 1:
        return fewer  # several cloths collide with each other anyway
    apart = tuple(cloth.model_copy(update={"self_collision": False}) for cloth in job.cloth)
    return _in_fewer_substeps(job.model_copy(update={"cloth": apart}), FEWEST_SUBSTEPS, power=power)


def _in_fewer_substeps(job: Job, fewest: int, *, power: float) -> Job:
    """The job in as many substeps as are fluent, but no more than it has, and no fewer than that many, or than its
    bodies ask for."""
    substeps, for_bodies = substeps_of(job.cloth), fewest_for_bodies(job)
    fitting = int(max(substeps, for_bodies) * fluent_frame_s(job) / cloth_frame_s(job, power=power))
    count = min(substeps, max(fitting, fewest, for_bodies))
    return job.model_copy(update={"cloth": with_substeps(job.cloth, count)})


def told_changes(written: Job, values: Mapping[str, Value]) -> str:
    """Differences of the live parameters' values, by name, from the job as `written` that are for speed, in a line."""
    told = []
    for parameter in parameters_of(written):
        value = values.get(parameter.name, parameter.start)
        first, key = parameter.paths[0][0], parameter.paths[0][-1]
        if first != "cloth" or key not in _CHANGED_KEYS or value == parameter.start:
            continue
        if parameter.widget == "whole":
            told.append(f"{value} substeps a frame instead of {parameter.start}")
        else:
            cloth = written.cloth[int(parameter.paths[0][1])].name
            told.append(f'"{cloth}" {"collides" if value else "does not collide"} with itself')
    return f"Differs from the job: {'; '.join(told)}." if told else ""
