"""Division of the loops of kernels among the threads of a CPU.

Loops whose items differ much in work are shared out while they run. Taichi cuts a loop into one run of neighbouring
items for each thread, of 512 at least, and waits for the thread with the heaviest run. Here a kernel loops over workers
instead, enough for every thread to have one, and every worker takes the next few items that nobody has taken:

    begin_sharing(taken, 0)
    for worker in range(workers):
        item = next_item(-1, worker, taken, 0, SHARE)
        while item < count:
            ...
            item = next_item(item, worker, taken, 0, SHARE)

with `workers` from `workers_for(count)`. On a GPU each worker has the item of its own number. Which thread has an item
differs from run to run; so what is done for an item may depend on no other.

Where few items are alike in work, a CPU's loop may have `LEAST_RUN` places for each, of which the first does it; so
threads get single ones.
"""

import taichi as ti
from taichi.lang import impl

from sim.core.arrays import Integers
from sim.core.reductions import runs_on_gpu

LEAST_RUN = 512  # fewest items of a loop that Taichi gives to a thread of a CPU, where there are so many
NO_MORE = 2**31 - 1  # number of the item after the last


def workers_for(count: int) -> int:
    """Workers for so many items: as many on a GPU; on a CPU so many that Taichi gives some to each thread."""
    return count if runs_on_gpu() else LEAST_RUN * int(impl.current_cfg().cpu_max_num_threads)


@ti.func
def begin_sharing(taken: Integers, slot: ti.template()):
    """Nothing is taken of a loop yet; outside of loops. Loops of one kernel have slots of their own."""
    if ti.static(not runs_on_gpu()):
        taken[slot] = 0


@ti.func
def next_item(item: ti.i32, worker: ti.i32, taken: Integers, slot: ti.template(), share: ti.template()) -> ti.i32:
    """The item that a worker has after `item`, which is -1 at first; beyond the last where none is left.

    `taken` counts the taken items by slot; a worker takes `share` neighbouring ones, a power of two, at a time.
    """
    following = item + 1
    if ti.static(runs_on_gpu()):
        following = worker if item < 0 else NO_MORE
    elif following & (share - 1) == 0:
        following = ti.atomic_add(taken[slot], share)
    return following
