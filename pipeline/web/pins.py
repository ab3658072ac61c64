"""Pins of a job's cloths: their nodes and when they are released, found as the simulation finds them."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pipeline.model.job import Job


class JobPin(NamedTuple):
    """A pin as the job has it."""

    cloth: str
    nodes: NDArray[np.int64]  # in the cloth's own numbers, (p,)
    release_s: float  # infinite if never

    def holds(self, time_s: float) -> bool:
        """Whether it holds its nodes at a time [s]."""
        from sim.cloth.pins import holds

        return holds(self.release_s, time_s)


def pins_of_job(job: Job) -> list[JobPin]:
    """All pins of a job, in the order of its file. Raises ShapeError, ValueError, OSError: a cloth cannot be built."""
    from sim.cloth.start import pins_of

    return [
        JobPin(cloth.name, nodes, math.inf if pin.release_s is None else pin.release_s)
        for cloth in job.cloth
        for pin, nodes in zip(cloth.pin, pins_of(cloth), strict=True)
    ]
