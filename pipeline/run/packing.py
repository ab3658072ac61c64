"""Which of the tasks that are ready gets its resources next: the most urgent that fits, and none is starved.

Part of the scheduler, and as pure: it does no input or output and has no clock.
"""

import heapq
from collections import defaultdict
from dataclasses import replace

from pipeline.base.task import Resources, TaskId

Priority = tuple[int, int, int]
"""The lower, the more urgent; no two tasks have the same."""


class Packing:
    """The tasks that are ready, in their order, and what those that have been taken leave free.

    One task may need no more than `machine` has; `capacity` is what may be used at a time, where that is more. What is
    `free` is less than nothing where a machine went whose tasks still count.
    """

    def __init__(self, *, machine: Resources, capacity: Resources) -> None:
        self.machine = machine
        self._capacity = capacity.at_least(machine)  # a task that claims a machine which went waits for it
        self.free = self._capacity
        self._ready: defaultdict[Resources, list[tuple[Priority, TaskId]]] = defaultdict(list)
        self._blocked: tuple[TaskId, Resources] | None = None
        self._overtakers: dict[TaskId, Resources] = {}

    @property
    def has_ready(self) -> bool:
        """Whether any task waits to be taken."""
        return any(self._ready.values())

    def resize(self, offered: Resources) -> None:
        """Machines came or went: all that there are now offer this much together."""
        capacity = offered.at_least(self.machine)
        self.free = self.free + capacity - self._capacity
        self._capacity = capacity

    def keep_gpus(self, left: int) -> None:
        """Of the machine's GPUs so many are left."""
        self.machine = replace(self.machine, gpus=left)
        self.resize(replace(self._capacity, gpus=left))

    def add(self, task_id: TaskId, *, need: Resources, priority: Priority) -> None:
        """A task is ready."""
        heapq.heappush(self._ready[need], (priority, task_id))

    def give_back(self, task_id: TaskId, need: Resources) -> None:
        """A task that was taken occupies nothing any more."""
        self._overtakers.pop(task_id, None)
        self.free += need

    def take(self) -> TaskId | None:
        """Take the most urgent task that fits; it occupies its need.

        When the most urgent task does not fit, others may overtake it only as long as it would fit beside all who did:
        once those end that ran before it was blocked, it starts.
        """
        heaps = sorted(((need, heap) for need, heap in self._ready.items() if heap), key=lambda each: each[1][0])
        for position, (need, heap) in enumerate(heaps):
            candidate = (heap[0][1], need)
            if position == 0 and self._blocked != candidate:
                self._blocked = None
            if not need.fits(self.free):
                if position == 0 and self._blocked is None:
                    self._blocked = candidate
                    self._overtakers = {}
                continue
            if self._blocked not in (None, candidate) and self._would_delay_blocked(need):
                continue
            if candidate == self._blocked:
                self._blocked = None
            elif self._blocked is not None:
                self._overtakers[heap[0][1]] = need
            self.free -= need
            return heapq.heappop(heap)[1]
        return None

    def _would_delay_blocked(self, need: Resources) -> bool:
        assert self._blocked is not None
        left = self._capacity - self._blocked[1]
        for taken in self._overtakers.values():
            left -= taken
        return not need.fits(left)
