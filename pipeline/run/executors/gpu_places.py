"""Which of the machine's GPUs a task is given: the scheduler counts them, here each of them has its place.

A simulation computes on the first one, as Taichi chooses that itself; so pictures take the highest that is free.
"""

import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import count

from pipeline.model.gpus import own_gpus, require_some


class GpuPlaces:
    """Places of GPUs, counted from 0, and how many tasks are on each. Safe to use from several threads.

    `own` are the places that tasks may be given; None: all there are.
    """

    def __init__(self, own: Sequence[int] | None) -> None:
        self._own = own
        self._tasks: Counter[int] = Counter()
        self._lock = threading.Lock()

    def take(self, warm: Iterable[int] = (), *, first: bool = False, there: int | None = None) -> int:
        """A place for one more task.

        Args:
            warm: places where Blender waits with the scene; one of these, if one is free.
            first: it computes on the first GPU whatever it is given, even one that is taken or not among the own.
            there: how many GPUs there are, where all may be given; None: unknown, and the lowest that is free is given.

        Raises PipelineError: there is none to give.
        """
        with self._lock:
            place = 0 if first else next((each for each in sorted(warm) if not self._tasks[each]), None)
            if place is None:
                place = self._best(there)
            self._tasks[place] += 1
            return place

    def _best(self, there: int | None) -> int:
        choice = range(there) if self._own is None and there is not None else self._own
        if choice is None:
            return next(each for each in count() if not self._tasks[each])
        # Beside another task only if a simulation came to a picture, or another runner knows nothing of this one.
        return min(require_some(choice), key=lambda each: (self._tasks[each], -each))

    def give_back(self, place: int) -> None:
        """A task on it has ended."""
        with self._lock:
            self._tasks[place] -= 1


@cache
def places_of_process() -> GpuPlaces:
    """Of this process: executors share them, as several runners may use one worker of a cluster."""
    return GpuPlaces(own_gpus())
