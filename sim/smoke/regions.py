"""Regions of air that no open side ends: pressure cannot change how much air flows into one of them.

Regions are the connected components of cells with air in them through open faces, found on the device by joining trees
of neighbours (Komura 2015; Playne & Hawick 2018): each cell points to one of a lower index, and the root of a component
is its lowest cell, whatever order threads take. Sums over a region are integers, exact and so the same in any order.
"""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers, LongIntegers
from sim.core.bundles import func
from sim.core.host_access import copied, put
from sim.core.launch import kernel
from sim.smoke.lanes import Grid, lane_items, lane_place, row_start
from sim.smoke.obstacles import Obstacles, Solids, flux_part, mean_volume

NO_REGION = -1  # number of what is in no closed region: solids, and air that is connected with an open side
OUTSIDE = 0  # root of the air that is connected with an open side; the index is that of a ghost, so of no cell
VOLUME_BITS = 24  # volumes count in units of 2^-24 cells
SUM_BITS = 30  # sums count in units of 2^-30 of the largest speed: that is below single precision, and 2^29 cells fit


class ClosedRegions:
    """The closed regions of a grid with the obstacles as they are, single cells included.

    Attributes:
        count: how many there are.
        number: the region that each cell is in, from 0 on, or `NO_REGION`, flat; nothing to rely on if there is none.
            None where there never will be one.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        grid = obstacles.grid
        self._obstacles = obstacles
        self._open = tuple(grid.is_open(axis, side) for axis in range(3) for side in (0, 1))
        self.count = 0
        self.number: ti.Ndarray | None = None
        # Without obstacles all air is connected, and with an open side as well.
        if obstacles.solids.cuts or not any(self._open):
            self.number = ti.ndarray(ti.i32, grid.size)
            self._allocate(1)
            self.find()

    def find(self) -> None:
        """Find the regions anew, as the obstacles changed."""
        if self.number is None:
            return
        _start_rows(self._obstacles.box, self._obstacles.solids, self.number)
        _join_rows(self._open, self._obstacles.box, self._obstacles.solids, self.number)
        self.count = int(_count_roots(self._obstacles.box, self.number))
        if self.count == 0:
            return
        if self.count > self._roots.shape[0]:
            # Twice as many as now, as more will come: a splash shuts bubbles in.
            self._allocate(2 * self.count)
        self._volumes.fill(0)
        _list_roots(self._obstacles.box, self.number, self._roots, self._volumes)
        # Threads list them in any order.
        roots = copied(self._roots)
        roots[: self.count].sort()
        put(self._roots, roots)
        self._volumes.fill(0)
        given = self._obstacles.box, self._obstacles.solids, self.number, self.count
        _number_cells(*given, self._roots, self._volumes)

    def subtract_means(self, values: ti.Ndarray, largest: float) -> float:
        """Take the mean over each region, times a cell's open part, off the values in it; returns the largest |mean|.

        Values are sums over cells, 0 in solid ones, and their magnitude is `largest` at most; a mean is over the air of
        a region.
        """
        if self.number is None or self.count == 0 or not 0.0 < largest < math.inf:
            return 0.0
        unit = math.ldexp(1.0, math.frexp(largest)[1] - SUM_BITS)
        self._sums.fill(0)
        _sum_up(self._obstacles.box, self.number, values, 1.0 / unit, self._sums)
        means = np.zeros(self._means.shape[0], np.float32)
        volumes = np.ldexp(np.maximum(copied(self._volumes)[: self.count], 1).astype(np.float64), -VOLUME_BITS)
        means[: self.count] = copied(self._sums)[: self.count] * unit / volumes
        put(self._means, means)
        _shift(self._obstacles.box, self._obstacles.solids, self.number, values, self._means)
        return float(np.abs(means).max())

    def _allocate(self, room: int) -> None:
        self._roots, self._means = ti.ndarray(ti.i32, room), ti.ndarray(ti.f32, room)
        self._volumes, self._sums = (ti.ndarray(ti.i64, room) for _ in range(2))


@func
def _find_root(number: Integers, at: ti.i32):
    root = at
    parent = number[root]
    while parent != root:
        root = parent
        parent = number[root]
    return root


@func
def _join(number: Integers, first: ti.i32, second: ti.i32):
    """Make one component of two: the higher root points to the lower, unless another thread was faster."""
    high, low = _find_root(number, first), _find_root(number, second)
    while high != low:
        if high < low:
            high, low = low, high
        before = ti.atomic_min(number[high], low)
        if before == high:
            high = low
        else:
            high, low = _find_root(number, before), _find_root(number, low)


@func
def _is_air(solids: Solids, at: ti.i32):
    return int(mean_volume(solids, at) > 0.0)


@kernel
def _start_rows(box: Grid, solids: Solids, number: Integers):
    """Each run of air along z points to its first cell."""
    number[OUTSIDE] = OUTSIDE
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        first = NO_REGION
        for k in range(1, box.nz + 1):
            goes_on = first != NO_REGION and flux_part(solids, 2, row + k) > 0.0
            first = ti.select(_is_air(solids, row + k) > 0, ti.select(goes_on, first, row + k), NO_REGION)
            number[row + k] = first


@kernel
def _join_rows(is_open: ti.template(), box: Grid, solids: Solids, number: Integers):
    """Join neighbours across x and y, and what is beside an open side with the outside.

    Where the cells before along z are joined, and each with the next, so are the two runs already.
    """
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        open_x_low, open_x_high = ti.static(is_open[0:2])
        open_y_low, open_y_high = ti.static(is_open[2:4])
        open_z_low, open_z_high = ti.static(is_open[4:6])
        was_joined_x, was_joined_y = 0, 0
        for k in range(1, box.nz + 1):
            at = row + k
            joined_x = int(i > 1 and flux_part(solids, 0, at) > 0.0)
            joined_y = int(j > 1 and flux_part(solids, 1, at) > 0.0)
            goes_on = int(flux_part(solids, 2, at) > 0.0)
            if joined_x > was_joined_x * goes_on * int(flux_part(solids, 2, at - box.step_x) > 0.0):
                _join(number, at, at - box.step_x)
            if joined_y > was_joined_y * goes_on * int(flux_part(solids, 2, at - box.step_y) > 0.0):
                _join(number, at, at - box.step_y)
            was_joined_x, was_joined_y = joined_x, joined_y
            is_beside_outside = (
                (open_x_low and i == 1 and flux_part(solids, 0, at) > 0.0)
                or (open_x_high and i == box.nx and flux_part(solids, 0, at + box.step_x) > 0.0)
                or (open_y_low and j == 1 and flux_part(solids, 1, at) > 0.0)
                or (open_y_high and j == box.ny and flux_part(solids, 1, at + box.step_y) > 0.0)
                or (open_z_low and k == 1 and flux_part(solids, 2, at) > 0.0)
                or (open_z_high and k == box.nz and flux_part(solids, 2, at + 1) > 0.0)
            )
            if is_beside_outside:
                _join(number, at, OUTSIDE)


@kernel
def _count_roots(box: Grid, number: Integers) -> ti.i32:
    """Let every cell point to its root, and count the roots that are not the outside."""
    count = 0
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        in_row = 0
        for k in range(1, box.nz + 1):
            at = row + k
            if number[at] != NO_REGION:
                root = _find_root(number, at)
                number[at] = root
                in_row += int(root == at)
        count += in_row
    return count


@kernel
def _list_roots(box: Grid, number: Integers, roots: Integers, listed: LongIntegers):
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        for k in range(1, box.nz + 1):
            if number[row + k] == row + k:
                roots[ti.cast(ti.atomic_add(listed[0], ti.cast(1, ti.i64)), ti.i32)] = row + k


@kernel
def _number_cells(box: Grid, solids: Solids, number: Integers, count: ti.i32, roots: Integers, volumes: LongIntegers):
    """Replace roots by their places in a sorted list, and sum up the air of each region."""
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        known_root, region, run = NO_REGION, NO_REGION, ti.cast(0, ti.i64)
        for k in range(1, box.nz + 1):
            root = number[row + k]
            if root != known_root:
                if region != NO_REGION:
                    ti.atomic_add(volumes[region], run)
                known_root, region, run = root, NO_REGION, ti.cast(0, ti.i64)
                if root > OUTSIDE:
                    low, high = 0, count - 1
                    while low < high:
                        middle = (low + high) // 2
                        if roots[middle] < root:
                            low = middle + 1
                        else:
                            high = middle
                    region = low
            number[row + k] = region
            run += ti.cast(mean_volume(solids, row + k) * ti.static(2.0**VOLUME_BITS), ti.i64)
        if region != NO_REGION:
            ti.atomic_add(volumes[region], run)


@kernel
def _sum_up(box: Grid, number: Integers, values: Floats, units: ti.f32, sums: LongIntegers):
    for i, j in ti.ndrange((1, box.nx + 1), (1, box.ny + 1)):
        row = row_start(box, i, j)
        region = NO_REGION
        total = ti.cast(0, ti.i64)
        for k in range(1, box.nz + 1):
            here = number[row + k]
            if here != region:
                if region != NO_REGION:
                    ti.atomic_add(sums[region], total)
                region, total = here, ti.cast(0, ti.i64)
            total += ti.cast(units * values[row + k], ti.i64)
        if region != NO_REGION:
            ti.atomic_add(sums[region], total)


@kernel
def _shift(box: Grid, solids: Solids, number: Integers, values: Floats, means: Floats):
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        row = row_start(box, i, j)
        for n in range(lane_items(box, box.nz, lane)):
            at = row + lane_place(box, n, lane)
            if number[at] != NO_REGION:
                values[at] -= mean_volume(solids, at) * means[number[at]]
