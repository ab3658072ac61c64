import time

import numpy as np
import pytest
import taichi as ti
from thread_counts import result_on_threads

from pipeline.show import doctor
from sim.core import runtime, thread_pool
from sim.core.arrays import Integers
from sim.core.cuda_launch import OTHER_LAYOUT
from sim.core.launch import kernel

ROOM = 40_000


@kernel
def count_up(count: ti.i32, items: Integers, sums: Integers):
    for n in range(count):
        items[n] += n
    for n in range(count):
        ti.atomic_add(sums[0], items[n] - n)
        ti.atomic_add(sums[1], 1)


def counted() -> list[list[int]]:
    """After loops of many lengths, some of which begin when every thread has been asleep for long."""
    items, sums = ti.ndarray(ti.i32, ROOM), ti.ndarray(ti.i32, 2)
    results = []
    for turn in range(400):
        items.fill(0)
        sums.fill(0)
        count = (turn * 7919) % ROOM if turn % 2 else turn % 5
        count_up(count, items, sums)
        np.testing.assert_array_equal(items.to_numpy()[:count], np.arange(count))
        assert not items.to_numpy()[count:].any()
        results.append([count, *sums.to_numpy().tolist()])
        if turn % 50 == 0:
            time.sleep(0.01)
    return results


@pytest.mark.parametrize("threads", [1, 2, 7])
def test_every_item_of_every_loop_is_done_once_and_the_loop_ends_after_it(threads):
    assert all(rest == [0, count] for count, *rest in result_on_threads(threads, counted))


def test_a_runtime_with_another_layout_is_left_alone(taichi_cpu, monkeypatch):
    assert not runtime.slow_loops()
    monkeypatch.setattr(thread_pool, "PARALLEL_FOR", thread_pool.PARALLEL_FOR - 8)  # Taichi's pool, no function
    with pytest.raises(RuntimeError, match="another layout"):
        thread_pool._parallel_for_of(thread_pool._runtime())


def test_loops_that_taichi_does_itself_are_told(monkeypatch):
    monkeypatch.setattr(runtime, "available_devices", lambda: {"cpu": "ok"})
    [found] = doctor._examine_devices()
    assert (found.status, found.detail) == ("ok", "computes; loops have threads of our own")
    moved = "import sim.core.thread_pool as pool; pool.PARALLEL_FOR -= 8; initialize("
    probe = doctor._THREADS_PROBE.replace("initialize(", moved, 1)
    monkeypatch.setattr(doctor, "_THREADS_PROBE", probe)
    [found] = doctor._examine_devices()
    assert (found.status, found.detail.partition(": ")[2]) == ("ok", OTHER_LAYOUT)
