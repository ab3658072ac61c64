"""How the kernels of a smoke share out the cells of a row among threads, on a CPU and on a GPU.

Rows run along z, where neighbours in memory are neighbours in space. A thread of a CPU takes a whole row, which the
compiler turns into vector instructions; on a GPU `GPU_LANES` threads walk along it together, so that neighbouring
threads read neighbouring places. One form of loop serves both, as a CPU has one lane:

    for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), lane_count()):
        for n in range(lane_items(nz, lane)):
            at = row_of_i_j + lane_place(n, lane)

The first loop must be the outermost of its kernel.
"""

import taichi as ti

from sim.reductions import runs_on_gpu

GPU_LANES = 32
"""As many as the threads of a GPU that run in step: together they read whole lines of memory."""


def lane_count() -> int:
    """How many threads share a row on the device that Taichi runs on."""
    return GPU_LANES if runs_on_gpu() else 1


@ti.func
def lane_items(length: ti.i32, lane: ti.i32) -> ti.i32:
    """How many of the places 1 .. length belong to a lane."""
    items = length
    if ti.static(lane_count() > 1):
        items = (length + ti.static(lane_count() - 1) - lane) // ti.static(lane_count())
    return items


@ti.func
def lane_place(item: ti.i32, lane: ti.i32) -> ti.i32:
    """The place, counted from 1, of an item of a lane."""
    place = item + 1
    if ti.static(lane_count() > 1):
        place += lane + item * ti.static(lane_count() - 1)
    return place
