"""Which of the machine's GPUs a task is given: the scheduler counts them, here each of them has its place.

A simulation takes the first one, as Taichi does, and is there before any picture; so pictures take the lowest that is
free.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import count

from pipeline.gpus import own_gpus


class GpuPlaces:
    """Places of GPUs, counted from 0, and how many tasks are on each. Safe to use from several threads.

    Args:
        own: the places that tasks may be given; None: all there are, as many as the scheduler lets be in use.
    """

    def __init__(self, own: Sequence[int] | None) -> None:
        self._own = own
        self._tasks: Counter[int] = Counter()
        self._lock = threading.Lock()

    def take(self, warm: Iterable[int] = ()) -> int:
        """A place for one more task.

        Args:
            warm: places where Blender waits with the scene; one of these, if one is free.
        """
        with self._lock:
            place = next((each for each in sorted(warm) if not self._tasks[each]), None)
            if place is None and self._own:
                # More tasks than places are there only if two runners know nothing of each other.
                place = min(self._own, key=lambda each: self._tasks[each])
            elif place is None:
                place = next(each for each in count() if not self._tasks[each])
            self._tasks[place] += 1
            return place

    def give_back(self, place: int) -> None:
        """A task on it has ended."""
        with self._lock:
            self._tasks[place] -= 1


@cache
def places_of_process() -> GpuPlaces:
    """Of this process: executors share them, as several runners may use one worker of a cluster."""
    return GpuPlaces(own_gpus())
