"""Regions of air that no open side ends: pressure cannot change how much air flows into one of them.

Regions are the connected components of the air cells, found on the device by joining trees of neighbours (Komura 2015;
Playne & Hawick 2018): each cell points to one of a lower index, and the root of a component is its lowest cell,
whatever order threads take. Sums over a region are integers, exact and so the same in any order.
"""

import math

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers, LongIntegers
from sim.smoke.lanes import lane_count, lane_items, lane_place
from sim.smoke.obstacles import AIR, Obstacles

NO_REGION = -1
"""Number of what is in no closed region: solids, and air that is connected with an open side."""

OUTSIDE = 0
"""Root of the air that is connected with an open side; the index is that of a ghost, so of no cell."""

SUM_BITS = 30
"""Sums count in units of 2^-30 of the largest speed: that is below single precision, and 2^29 cells fit."""


@ti.data_oriented
class ClosedRegions:
    """The closed regions of a grid with the obstacles as they are, single cells included.

    Attributes:
        count: how many there are.
        number: the region that each cell is in, from 0 on, or `NO_REGION`, flat; nothing to rely on if there is none.
        fields: what it has allocated for each cell, four bytes a value.
    """

    def __init__(self, obstacles: Obstacles) -> None:
        grid = obstacles.grid
        self._obstacles = obstacles
        self._lanes = lane_count()
        self._nx, self._ny, self._nz = grid.cells
        self._step_x, self._step_y = grid.padded[1] * grid.padded[2], grid.padded[2]
        self._open = tuple(grid.is_open(axis, side) for axis in range(3) for side in (0, 1))
        self.count = 0
        # Without obstacles all air is connected, and with an open side as well.
        self._may_exist = obstacles.moving or bool(grid.solid.any()) or not any(self._open)
        self.fields: list[ti.Field] = []
        if self._may_exist:
            self.number = ti.field(ti.i32, shape=grid.size)
            self.fields.append(self.number)
            self._roots, self._cells = (ti.ndarray(ti.i32, 1) for _ in range(2))
            self._sums, self._means = ti.ndarray(ti.i64, 1), ti.ndarray(ti.f32, 1)
            self.find()

    def find(self) -> None:
        """Find the regions anew, as the obstacles changed."""
        if not self._may_exist:
            return
        self._start_rows()
        self._join_rows()
        self.count = int(self._count_roots())
        if self.count == 0:
            return
        if self.count > self._roots.shape[0]:
            # Twice as many as now, as more will come: a splash shuts bubbles in.
            self._allocate(2 * self.count)
        self._cells.fill(0)
        self._list_roots(self._roots, self._cells)
        # Threads list them in any order.
        roots = self._roots.to_numpy()
        roots[: self.count].sort()
        self._roots.from_numpy(roots)
        self._cells.fill(0)
        self._number_cells(self.count, self._roots, self._cells)

    def subtract_means(self, values: ti.Field, largest: float) -> float:
        """Take the mean over each region off the values in it.

        Args:
            values: flat field; 0 in solid cells.
            largest: a bound of their magnitude.

        Returns:
            The largest magnitude of a mean.
        """
        if self.count == 0 or not 0.0 < largest < math.inf:
            return 0.0
        unit = math.ldexp(1.0, math.frexp(largest)[1] - SUM_BITS)
        self._sums.fill(0)
        self._sum_up(values, 1.0 / unit, self._sums)
        means = np.zeros(self._means.shape[0], np.float32)
        cells = self._cells.to_numpy()[: self.count]
        means[: self.count] = self._sums.to_numpy()[: self.count] * unit / cells
        self._means.from_numpy(means)
        self._shift(values, self._means)
        return float(np.abs(means).max())

    def _allocate(self, room: int) -> None:
        self._roots, self._cells = (ti.ndarray(ti.i32, room) for _ in range(2))
        self._sums, self._means = ti.ndarray(ti.i64, room), ti.ndarray(ti.f32, room)

    @ti.func
    def _find_root(self, at: ti.i32):
        root = at
        parent = self.number[root]
        while parent != root:
            root = parent
            parent = self.number[root]
        return root

    @ti.func
    def _join(self, first: ti.i32, second: ti.i32):
        """Make one component of two: the higher root points to the lower, unless another thread was faster."""
        high, low = self._find_root(first), self._find_root(second)
        while high != low:
            if high < low:
                high, low = low, high
            before = ti.atomic_min(self.number[high], low)
            if before == high:
                high = low
            else:
                high, low = self._find_root(before), self._find_root(low)

    @ti.func
    def _is_air(self, at: ti.i32):
        return int(self._obstacles.state[at] == AIR)

    @ti.kernel
    def _start_rows(self):
        """Each run of air along z points to its first cell."""
        self.number[OUTSIDE] = OUTSIDE
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            first = NO_REGION
            for k in range(1, self._nz + 1):
                first = ti.select(self._is_air(row + k) > 0, ti.select(first == NO_REGION, row + k, first), NO_REGION)
                self.number[row + k] = first

    @ti.kernel
    def _join_rows(self):
        """Join neighbours across x and y, and what is beside an open side with the outside.

        Where the cells before along z are neighbours of the same kind, they have joined the two runs already.
        """
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            open_x_low, open_x_high = ti.static(self._open[0:2])
            open_y_low, open_y_high = ti.static(self._open[2:4])
            open_z_low, open_z_high = ti.static(self._open[4:6])
            is_beside_outside = (
                (open_x_low and i == 1)
                or (open_x_high and i == self._nx)
                or (open_y_low and j == 1)
                or (open_y_high and j == self._ny)
            )
            was_air, was_air_x, was_air_y = 0, 0, 0
            for k in range(1, self._nz + 1):
                at = row + k
                is_air = self._is_air(at)
                is_air_x = is_air * int(i > 1) * self._is_air(at - self._step_x)
                is_air_y = is_air * int(j > 1) * self._is_air(at - self._step_y)
                if is_air_x > was_air_x:
                    self._join(at, at - self._step_x)
                if is_air_y > was_air_y:
                    self._join(at, at - self._step_y)
                if is_air > was_air and is_beside_outside:
                    self._join(at, OUTSIDE)
                if is_air > 0 and ((open_z_low and k == 1) or (open_z_high and k == self._nz)):
                    self._join(at, OUTSIDE)
                was_air, was_air_x, was_air_y = is_air, is_air_x, is_air_y

    @ti.kernel
    def _count_roots(self) -> ti.i32:
        """Let every cell point to its root, and count the roots that are not the outside."""
        count = 0
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            in_row = 0
            for k in range(1, self._nz + 1):
                at = row + k
                if self.number[at] != NO_REGION:
                    root = self._find_root(at)
                    self.number[at] = root
                    in_row += int(root == at)
            count += in_row
        return count

    @ti.kernel
    def _list_roots(self, roots: Integers, listed: Integers):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            for k in range(1, self._nz + 1):
                if self.number[row + k] == row + k:
                    roots[ti.atomic_add(listed[0], 1)] = row + k

    @ti.kernel
    def _number_cells(self, count: ti.i32, roots: Integers, cells: Integers):
        """Replace roots by their places in a sorted list, and count the cells of each region."""
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            known_root, number, run = NO_REGION, NO_REGION, 0
            for k in range(1, self._nz + 1):
                root = self.number[row + k]
                if root != known_root:
                    if number != NO_REGION:
                        ti.atomic_add(cells[number], run)
                    known_root, number, run = root, NO_REGION, 0
                    if root > OUTSIDE:
                        low, high = 0, count - 1
                        while low < high:
                            middle = (low + high) // 2
                            if roots[middle] < root:
                                low = middle + 1
                            else:
                                high = middle
                        number = low
                self.number[row + k] = number
                run += 1
            if number != NO_REGION:
                ti.atomic_add(cells[number], run)

    @ti.kernel
    def _sum_up(self, values: ti.template(), units: ti.f32, sums: LongIntegers):
        for i, j in ti.ndrange((1, self._nx + 1), (1, self._ny + 1)):
            row = i * self._step_x + j * self._step_y
            number = NO_REGION
            total = ti.cast(0, ti.i64)
            for k in range(1, self._nz + 1):
                here = self.number[row + k]
                if here != number:
                    if number != NO_REGION:
                        ti.atomic_add(sums[number], total)
                    number, total = here, ti.cast(0, ti.i64)
                total += ti.cast(units * values[row + k], ti.i64)
            if number != NO_REGION:
                ti.atomic_add(sums[number], total)

    @ti.kernel
    def _shift(self, values: ti.template(), means: Floats):
        for i, j, lane in ti.ndrange((1, self._nx + 1), (1, self._ny + 1), self._lanes):
            row = i * self._step_x + j * self._step_y
            for n in range(lane_items(self._nz, lane)):
                at = row + lane_place(n, lane)
                if self.number[at] != NO_REGION:
                    values[at] -= means[self.number[at]]
