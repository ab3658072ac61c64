import numpy as np
import pytest
import taichi as ti
from thread_counts import result_on_threads

from sim.core.arrays import Integers
from sim.core.scheduling import begin_sharing, next_item, workers_for

SHARE = 4

PATIENCE = 500_000_000
"""Looks at another item's mark until that counts as not come, some ten seconds: a thread may wait for a processor."""


@ti.kernel
def count_visits(count: ti.i32, workers: ti.i32, taken: Integers, visits: Integers):
    begin_sharing(taken, 0)
    begin_sharing(taken, 1)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, SHARE)
        while item < count:
            ti.atomic_add(visits[item], 1)
            item = next_item(item, worker, taken, 0, SHARE)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 1, 1)
        while item < count:
            ti.atomic_add(visits[item], 10)
            item = next_item(item, worker, taken, 1, 1)


@ti.kernel
def meet(workers: ti.i32, taken: Integers, marks: Integers):
    """Two items, each of which waits for the other."""
    begin_sharing(taken, 0)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, 1)
        while item < 2:
            ti.atomic_add(marks[item], 1)
            looks = 0
            while looks < PATIENCE and ti.atomic_add(marks[1 - item], 0) == 0:
                looks += 1
            ti.atomic_add(marks[2], ti.cast(looks < PATIENCE, ti.i32))
            item = next_item(item, worker, taken, 0, 1)


@pytest.mark.parametrize("count", [0, 1, SHARE - 1, SHARE, 513, 5000])
def test_every_item_is_taken_once_by_each_loop_whatever_their_number(taichi_cpu, count):
    taken, visits = ti.ndarray(ti.i32, 2), ti.ndarray(ti.i32, count + SHARE)
    for _ in range(2):  # what the call before took is forgotten
        visits.fill(0)
        count_visits(count, workers_for(count), taken, visits)
        np.testing.assert_array_equal(visits.to_numpy(), np.repeat([11, 0], [count, SHARE]))


def marks_of_a_meeting() -> list[int]:
    taken, marks = ti.ndarray(ti.i32, 1), ti.ndarray(ti.i32, 3)
    marks.fill(0)
    meet(workers_for(2), taken, marks)
    return marks.to_numpy().tolist()


def test_two_items_are_done_at_the_same_time_by_two_threads():
    """Taichi by itself gives a thread 512 items at least, so that one thread would have both, one after the other."""
    assert result_on_threads(2, marks_of_a_meeting) == [1, 1, 2]
