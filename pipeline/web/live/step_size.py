"""Step sizes at which a scene is fluent: substeps and self-collisions of cloth that is too slow. Told, and undone.

A film's cloth takes as many substeps as look right and collides with itself; ten thousand nodes of it take several
times longer than a hand can wait for. Only what does not fit is given up: substeps first, which make cloth softer,
then its collisions with itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.web.live.frame_cost import cloth_frame_s, fewest_for_bodies
from pipeline.web.live.parameters import Value, parameters_of, with_substeps
from sim.cloth.parameters import DEFAULT_SUBSTEPS

if TYPE_CHECKING:
    from pipeline.model.job import Job

FLUENT_FRAME_S = 1.0 / 30.0
"""Longest frame at which hands and eyes go along [s]."""

FLUENT_SLOWDOWN = 2.0
"""Most that it may be slower than real time: at 240 frames a second a thirtieth of one would be eight times."""

FEWEST_SUBSTEPS = 6
"""Nothing blows up in fewer, but cloth that hangs by its corners is drawn to a multiple of its length there: a dragged
ball draws springs beside the pins to 6 times their length in 6, to 14 in 4, to 1.6 in 20 (docs/live.md)."""

FEWEST_COLLIDING = 10
"""Where cloth collides with itself, fewer substeps gain nothing: contacts have the more to do."""

_CHANGED_KEYS = ("substeps", "self_collision")


def fluent_frame_s(job: Job) -> float:
    """Longest frame of a scene that is fluent [s]."""
    return min(FLUENT_FRAME_S, FLUENT_SLOWDOWN / job.fps)


def fluent(job: Job, *, power: float) -> Job:
    """The job in steps that run fluently, if it has any cloth that is too slow.

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


def told_changes(written: Job, values: Mapping[str, Value]) -> str:
    """Differences from the job for the sake of speed, in a line; "" if there are none.

    Args:
        written: the job.
        values: of the live parameters, by name; those left out are as in the job.
    """
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
