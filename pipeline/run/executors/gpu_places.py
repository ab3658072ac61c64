"""Which of the machine's GPUs a task is given: the scheduler counts them, here each of them has its place.

A simulation takes the lowest that is free, which any back end of Taichi finds by itself; pictures take the highest.
"""

import threading
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from functools import cache
from itertools import count

from pipeline.base.errors import PipelineError
from pipeline.model.gpus import own_gpus, require_some


class NoGpuLeftError(PipelineError):
    """Every GPU that tasks may be given has failed."""


class GpuPlaces:
    """Places of GPUs, counted from 0, and how many tasks are on each. Safe to use from several threads.

    `own` are the places that tasks may be given; None: all there are.
    """

    def __init__(self, own: Sequence[int] | None) -> None:
        self._own = own
        self._tasks: Counter[int] = Counter()
        self._lock = threading.Lock()

    def take(
        self,
        warm: Iterable[int] = (),
        *,
        lowest: bool = False,
        there: int | None = None,
        failed: Collection[int] = (),
    ) -> int:
        """A place for one more task.

        Args:
            warm: places where Blender waits with the scene; one of these, if one is free.
            lowest: the lowest that is free instead of the highest; any, where the own are none.
            there: how many GPUs there are, where all may be given; None: unknown, and the lowest that is free is given.
            failed: places that are given no more.

        Raises:
            NoGpuLeftError: all have failed.
            PipelineError: there is none to give.
        """
        with self._lock:
            free = (each for each in sorted(warm) if not self._tasks[each] and each not in failed)
            place = next(free, None)
            if place is None:
                place = self._best(lowest, there, failed)
            self._tasks[place] += 1
            return place

    def _best(self, lowest: bool, there: int | None, failed: Collection[int]) -> int:
        own = self._own or None if lowest else self._own
        choice = range(there) if own is None and there is not None else own
        if choice is None:
            return next(each for each in count() if not self._tasks[each] and each not in failed)
        # Beside another task only if another runner knows nothing of this one.
        left = [each for each in require_some(choice) if each not in failed]
        if not left:
            raise NoGpuLeftError("no GPU is left: all have failed in this run")
        return min(left, key=lambda each: (self._tasks[each], each if lowest else -each))

    def give_back(self, place: int) -> None:
        """A task on it has ended."""
        with self._lock:
            self._tasks[place] -= 1


@cache
def places_of_process() -> GpuPlaces:
    """Of this process: executors share them, as several runners may use one worker of a cluster."""
    return GpuPlaces(own_gpus())
