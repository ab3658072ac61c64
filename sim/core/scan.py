"""Prefix sums of integers, exact and so the same in any order."""

import taichi as ti

from sim.core.arrays import Integers
from sim.core.bundles import func
from sim.core.launch import kernel

RUN = 32  # values that a thread adds up: int32 of one cache line of a GPU
LEVELS = 3  # levels of the tree of runs, besides the values; one thread adds up what is left


def scan_scratch_length(length: int) -> int:
    """Numbers that a scan over so many values needs to work with."""
    total, level = 0, length
    for _ in range(LEVELS):
        level = (level + RUN - 1) // RUN
        total += level
    return max(total, 1)


@func
def add_up(values: Integers, first: ti.i32, last: ti.i32) -> ti.i32:
    """Sum of values[first:last]."""
    total = 0
    for k in range(first, last):
        total += values[k]
    return total


@func
def scan_run(values: Integers, first: ti.i32, last: ti.i32, before: ti.i32):
    """Replace values[first:last] by the sums of those before each, which start at `before`."""
    running = before
    for k in range(first, last):
        value = values[k]
        values[k] = running
        running += value


@func
def scan_in_parallel(values: Integers, length: ti.i32, scratch: Integers, result: Integers) -> ti.i32:
    """As `exclusive_scan`, for the outermost level of a kernel: its loops then run in parallel, one after the other.

    Sums of runs, of runs of runs and of runs of those, then all of them from the top down.
    """
    runs = (length + RUN - 1) // RUN
    runs_of_runs = (runs + RUN - 1) // RUN
    top = (runs_of_runs + RUN - 1) // RUN
    second = runs
    third = runs + runs_of_runs
    for r in range(runs):
        scratch[r] = add_up(values, r * RUN, ti.min((r + 1) * RUN, length))
    for r in range(runs_of_runs):
        scratch[second + r] = add_up(scratch, r * RUN, ti.min((r + 1) * RUN, runs))
    for r in range(top):
        scratch[third + r] = add_up(scratch, second + r * RUN, second + ti.min((r + 1) * RUN, runs_of_runs))
    total = 0
    ti.loop_config(serialize=True)
    for r in range(top):
        value = scratch[third + r]
        scratch[third + r] = total
        total += value
    for r in range(top):
        scan_run(scratch, second + r * RUN, second + ti.min((r + 1) * RUN, runs_of_runs), scratch[third + r])
    for r in range(runs_of_runs):
        scan_run(scratch, r * RUN, ti.min((r + 1) * RUN, runs), scratch[second + r])
    for r in range(runs):
        running = scratch[r]
        for k in range(r * RUN, ti.min((r + 1) * RUN, length)):
            result[k] = running
            running += values[k]
    result[length] = total
    return total


@kernel
def exclusive_scan(values: Integers, length: ti.i32, scratch: Integers, result: Integers) -> ti.i32:
    """result[k] = sum of values[:k] for k = 0 ... length; returns the last of them.

    `scratch` has at least `scan_scratch_length(length)` elements.
    """
    return scan_in_parallel(values, length, scratch, result)
