"""How the kernels of a smoke share out the cells of a row among threads, on a CPU and on a GPU.

Rows run along z, where neighbours in memory are neighbours in space. A thread of a CPU takes a whole row, which the
compiler turns into vector instructions; on a GPU `GPU_LANES` threads walk along it together, so that neighbouring
threads read neighbouring places. One form of loop serves both, as a CPU has one lane:

    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)

The first loop must be the outermost of its kernel.

Loops that store are not vectorized in that form: to the compiler each value that is stored may be the address of an
array, which it then loads anew for the next cell. Where a row has one lane, `fill_row` and `fill_rows` therefore
compute a *run* of cells, keep the results in a local array, which is no address, and store them when all are there.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.reductions import runs_on_gpu
from sim.smoke.arrays import Faces

GPU_LANES = 32  # as many as the threads of a GPU that run in step: together they read whole lines of memory
RUN = 16  # cells of a run: two vectors of eight, few enough that short rows have some


@bundle
class Grid(NamedTuple):
    """A grid of cells as kernels take it; cells count from 1, and have a layer of ghosts around them."""

    offset: ti.i32  # where it begins in flat arrays
    nx: ti.i32  # cells along x, y, z
    ny: ti.i32
    nz: ti.i32
    step_x: ti.i32  # to the next cell along x in flat arrays
    step_y: ti.i32
    lanes: ti.template()  # threads that share a row


def device_grid(cells: tuple[int, int, int], *, offset: int = 0) -> Grid:
    """A grid of cells, counted along x, y, z, as the device shares out its rows."""
    nx, ny, nz = cells
    return Grid(offset, nx, ny, nz, (ny + 2) * (nz + 2), nz + 2, GPU_LANES if runs_on_gpu() else 1)


@func
def row_start(box: Grid, i: ti.i32, j: ti.i32) -> ti.i32:
    """Flat index of the ghost before the first cell of a row."""
    return box.offset + i * box.step_x + j * box.step_y


@func
def cell_counts(box: Grid):
    """Cells along x, y, z."""
    return ti.Vector([box.nx, box.ny, box.nz])


@func
def steps(box: Grid):
    """To the next cell along x, y, z in flat arrays."""
    return ti.Vector([box.step_x, box.step_y, 1])


@func
def lane_items(box: Grid, length: ti.i32, lane: ti.i32) -> ti.i32:
    """How many of the places 1 .. length belong to a lane."""
    items = length
    if ti.static(box.lanes > 1):
        items = (length + ti.static(box.lanes - 1) - lane) // ti.static(box.lanes)
    return items


@func
def lane_place(box: Grid, item: ti.i32, lane: ti.i32) -> ti.i32:
    """The place, counted from 1, of an item of a lane."""
    place = item + 1
    if ti.static(box.lanes > 1):
        place += lane + item * ti.static(box.lanes - 1)
    return place


@func
def new_run():
    """Room for the values of a run."""
    return ti.Vector.zero(ti.f32, RUN)


@func
def rest_items(box: Grid, length: ti.i32, lane: ti.i32) -> ti.i32:
    """How many of the places 1 .. length belong to a lane and to no run."""
    return length % RUN if ti.static(box.lanes == 1) else lane_items(box, length, lane)


@func
def rest_place(box: Grid, length: ti.i32, item: ti.i32, lane: ti.i32) -> ti.i32:
    """The place, counted from 1, of such an item of a lane."""
    return (length // RUN * RUN if ti.static(box.lanes == 1) else 0) + lane_place(box, item, lane)


@func
def fill_row(
    box: Grid, out: Floats, row: ti.i32, length: ti.i32, lane: ti.i32, compute: ti.template(), given: ti.template()
):
    """out[row + k] = compute(k, *given) at a lane's places k; nothing computed may depend on what the row stores."""
    if ti.static(box.lanes == 1):
        for run in range(length // RUN):
            first = run * RUN + 1
            values = new_run()
            for m in range(RUN):
                values[m] = compute(first + m, *given)
            for m in range(RUN):
                out[row + first + m] = values[m]
    for n in range(rest_items(box, length, lane)):
        k = rest_place(box, length, n, lane)
        out[row + k] = compute(k, *given)


@func
def fill_rows(
    box: Grid,
    outs: ti.template(),
    row: ti.i32,
    length: ti.i32,
    lane: ti.i32,
    compute: ti.template(),
    given: ti.template(),
):
    """As `fill_row`, of some values at a time, which go to an array each."""
    count = ti.static(len(outs))
    if ti.static(box.lanes == 1):
        for run in range(length // RUN):
            first = run * RUN + 1
            values = [new_run() for _ in range(count)]
            for m in range(RUN):
                found = compute(first + m, *given)
                for c in ti.static(range(count)):
                    values[c][m] = found[c]
            for c in ti.static(range(count)):
                for m in range(RUN):
                    outs[c][row + first + m] = values[c][m]
    for n in range(rest_items(box, length, lane)):
        k = rest_place(box, length, n, lane)
        found = compute(k, *given)
        for c in ti.static(range(count)):
            outs[c][row + k] = found[c]


@kernel
def clear_ghosts(box: Grid, values: Faces):
    """Set the layer around the cells to 0 in three arrays."""
    for i, j, lane in ti.ndrange(box.nx + 2, box.ny + 2, box.lanes):
        # Of rows of cells only both ends are ghosts.
        count, step = box.nz + 2, 1
        if 1 <= i <= box.nx and 1 <= j <= box.ny:
            count, step = 2, box.nz + 1
        for n in range(lane_items(box, count, lane)):
            at = row_start(box, i, j) + (lane_place(box, n, lane) - 1) * step
            values.x[at] = 0.0
            values.y[at] = 0.0
            values.z[at] = 0.0
