"""How a scene is made fast enough to be played with, and how that is told: nothing of it is silent, all can be undone.

A film's cloth takes as many substeps as look right and collides with itself; ten thousand nodes of it take several
times longer than a hand can wait for. Only what does not fit is given up: substeps first, which make cloth softer,
then its collisions with itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.live.knobs import Value, knobs_of, with_substeps
from pipeline.stages.inputs import count_cloth_nodes
from sim.cloth.parameters import DEFAULT_SUBSTEPS

if TYPE_CHECKING:
    from pipeline.job.models import Job

NODE_SUBSTEP_S = 1.4e-6
"""Core time of a node in a substep of cloth in contact [s]. Twice what the scene alone was measured to take (10 000
nodes, 20 substeps: 101 to 144 ms of processor time, docs/live.md): threads wait for each other, and page and browser
want their share of the cores."""

APART_SHARE = 0.4
"""Of it, where cloth does not collide with itself: measured are 0.25 to 0.35 on two cores."""

FLUENT_FRAME_S = 1.0 / 30.0
"""What a frame of the scene may take for hands and eyes to go along [s]."""

FLUENT_SLOWDOWN = 2.0
"""And how much slower than real time it may be: at 240 frames a second a thirtieth of one would be eight times."""

FEWEST_SUBSTEPS = 6
"""Nothing blows up in fewer, but cloth that hangs by its corners is drawn to a multiple of its length there: a dragged
ball draws springs beside the pins to 6 times their length in 6, to 14 in 4, to 1.6 in 20 (docs/live.md)."""

FEWEST_COLLIDING = 10
"""Where cloth collides with itself, fewer substeps gain nothing: contacts have the more to do."""

_PACE_KEYS = ("substeps", "self_collision")


def fewest_for_bodies(job: Job) -> int:
    """Substeps a frame that the bodies of a scene ask for: its cloths take as many, however few they ask for."""
    from sim.rigid.solver import largest_dt

    return max(1, math.ceil(1.0 / (job.fps * largest_dt(job.rigid))))


def cloth_frame_s(job: Job, *, power: float) -> float:
    """About how long a frame of the cloths takes [s], on so many cores."""
    if not job.cloth:
        return 0.0
    substeps = max(job.cloth[0].substeps or DEFAULT_SUBSTEPS, fewest_for_bodies(job))
    meets = any(cloth.self_collision for cloth in job.cloth) or len(job.cloth) > 1
    return count_cloth_nodes(job) * substeps * NODE_SUBSTEP_S * (1.0 if meets else APART_SHARE) / power


def fluent_frame_s(job: Job) -> float:
    """What a frame may take for the scene to be fluent [s]."""
    return min(FLUENT_FRAME_S, FLUENT_SLOWDOWN / job.fps)


def fluent(job: Job, *, power: float) -> Job:
    """The job with what it takes to run fluently given up, if it has any cloth that is too slow.

    Args:
        job: as it is simulated live.
        power: cores that compute it.
    """
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
    substeps, for_bodies = job.cloth[0].substeps or DEFAULT_SUBSTEPS, fewest_for_bodies(job)
    fitting = int(max(substeps, for_bodies) * fluent_frame_s(job) / cloth_frame_s(job, power=power))
    count = min(substeps, max(fitting, fewest, for_bodies))
    return job.model_copy(update={"cloth": with_substeps(job.cloth, count)})


def told_pace(written: Job, values: Mapping[str, Value]) -> str:
    """What is otherwise than in the job for the sake of speed, in a line; "" if nothing is.

    Args:
        written: the job.
        values: of the scene's knobs, by name; what is left out is as in the job.
    """
    told = []
    for knob in knobs_of(written):
        value = values.get(knob.name, knob.start)
        if knob.paths[0][0] != "cloth" or knob.paths[0][-1] not in _PACE_KEYS or value == knob.start:
            continue
        if knob.kind == "whole":
            told.append(f"{value} substeps a frame instead of {knob.start}")
        else:
            cloth = written.cloth[int(knob.paths[0][1])].name
            told.append(f'"{cloth}" {"collides" if value else "does not collide"} with itself')
    return f"Other than in the job: {'; '.join(told)}." if told else ""
