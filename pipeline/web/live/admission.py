"""Admission: jobs that can run live, as they are simulated then, and how large they may be."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pipeline.base.errors import PipelineError
from pipeline.kinds.cloth import count_cloth_nodes
from pipeline.kinds.table import KINDS
from pipeline.web.live.frame_cost import fewest_for_bodies, frame_s, steps_a_frame
from pipeline.web.live.parameters import PARAMETERS, with_substeps
from sim.cloth.parameters import DEFAULT_SUBSTEPS

if TYPE_CHECKING:
    from pipeline.model.job import Job

GPU_CORES = 20
"""A GPU counts as so many cores: scenes that fit here are too small to fill it."""

MOST_FRAME_S = 0.25
"""Longest frame [s]: slower than four pictures a second nobody can steer anything."""

MOST_SLOWDOWN = 15.0
"""Most that it may be slower than real time, which is as much at 60 frames a second: where things hardly move, nobody
sees what a drag has done."""


def live_job(job: Job, *, substeps: int | None = None) -> Job:
    """The job as it is simulated live: bodies that rest can be moved where there is no fluid, and steps are as asked.

    Raises:
        PipelineError: live does not run what the job has.
    """
    for kind in KINDS:
        if getattr(job, kind) and kind not in PARAMETERS:
            raise PipelineError(f"{job.name}: {kind} does not run live; `pipeline animatic` draws it fast")
    if not (job.cloth or job.fluid or job.moving_bodies):
        raise PipelineError(f"{job.name}: nothing moves in it; live runs cloth, rigid bodies and fluids")
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


def computing_power(*, cores: int, on_gpu: bool) -> int:
    """Cores that compute a scene, with a GPU as so many."""
    return GPU_CORES if on_gpu else cores


def require_small(job: Job, particles: int, *, cores: int, on_gpu: bool) -> None:
    """Refuse a scene whose frames would take too long.

    Args:
        job: as it is simulated live.
        particles: that its fluids will have, as the checks count them: of emitters, what flows in during the film.
        cores: of the processor.
        on_gpu: whether a GPU computes it.

    Raises:
        PipelineError: says about how long a frame takes, and what would fit.
    """
    nodes = count_cloth_nodes(job)
    power = computing_power(cores=cores, on_gpu=on_gpu)
    took_s = frame_s(job, particles, power=power)
    most_s = min(MOST_FRAME_S, MOST_SLOWDOWN / job.fps)
    if took_s <= most_s:
        return
    share = most_s / took_s
    sizes, remedies = [], []
    if nodes:
        for_bodies = fewest_for_bodies(job)
        substeps = max(job.cloth[0].substeps or DEFAULT_SUBSTEPS, for_bodies)
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
    where = "the GPU" if on_gpu else f"{cores} cores"
    raise PipelineError(
        f"{job.name} is too large to steer: {' and '.join(sizes)} take some {took_s:.2g} s a frame on "
        f"{where}, {most_s:.2g} s at most; {', '.join(remedies)} (--preview may do); --anyway runs it"
    )
