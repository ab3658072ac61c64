"""How the kernels of a smoke share out the cells of a row among threads, on a CPU and on a GPU.

Rows run along z, where neighbours in memory are neighbours in space. A thread of a CPU takes a whole row, which the
compiler turns into vector instructions; on a GPU `GPU_LANES` threads walk along it together, so that neighbouring
threads read neighbouring places. One form of loop serves both, as a CPU has one lane:

    for i, j, lane in ti.ndrange((1, nx + 1), (1, ny + 1), lane_count()):
        for n in range(lane_items(nz, lane)):
            at = row_of_i_j + lane_place(n, lane)

The first loop must be the outermost of its kernel.

Loops that store are not vectorized in that form: to the compiler each value that is stored may be the address of a
field, which it then loads anew for the next cell. In a large grid a thread of a CPU therefore computes a *run* of
cells, keeps the results with itself, where they are no address, and stores them when all are there; what is left of the
row it stores one by one, as all of it in a small grid and on a GPU. `in_runs` is known when the kernel is compiled:

    if ti.static(in_runs):
        for run in range(lane_runs(nz)):
            first = row_of_i_j + run_start(run)
            values = new_run()
            for m in range(RUN):
                values[m] = compute(first + m)
            for m in range(RUN):
                field[first + m] = values[m]
    for n in range(rest_items(nz, lane, in_runs)):
        at = row_of_i_j + rest_place(nz, n, lane, in_runs)
        field[at] = compute(at)

Nothing that is computed may depend on what the same run stores.
"""

import math

import taichi as ti

from sim.core.reductions import runs_on_gpu

GPU_LANES = 32
"""As many as the threads of a GPU that run in step: together they read whole lines of memory."""

RUN = 16
"""Cells of a run: two vectors of eight, few enough that short rows have some, and so many that the compiler makes a
loop of vectors of it and does not unroll it cell by cell."""

LEAST_CELLS_IN_RUNS = 48**3
"""Of smaller grids the kernels are compiled without runs, as that takes half as long again with them: 3.6 s of
processor time more when they are new, 1.5 s when they were kept, which a grid of 48^3 saves in some hundred steps."""


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


def has_runs(cells: tuple[int, int, int]) -> bool:
    """Whether the kernels of a grid of so many cells take its rows in runs."""
    return not runs_on_gpu() and math.prod(cells) >= LEAST_CELLS_IN_RUNS


@ti.func
def lane_runs(length: ti.i32) -> ti.i32:
    """How many whole runs there are in a row."""
    return length // RUN


@ti.func
def run_start(run: ti.i32) -> ti.i32:
    """The place, counted from 1, of the first cell of a run."""
    return run * RUN + 1


@ti.func
def new_run():
    """Room for the values of a run."""
    return ti.Vector.zero(ti.f32, RUN)


@ti.func
def rest_items(length: ti.i32, lane: ti.i32, in_runs: ti.template()) -> ti.i32:
    """How many of the places 1 .. length belong to a lane and to no run."""
    return length % RUN if ti.static(in_runs) else lane_items(length, lane)


@ti.func
def rest_place(length: ti.i32, item: ti.i32, lane: ti.i32, in_runs: ti.template()) -> ti.i32:
    """The place, counted from 1, of such an item of a lane."""
    return (length // RUN * RUN if ti.static(in_runs) else 0) + lane_place(item, lane)
