"""Sums and maxima over a grid that do not depend on how many threads take part.

Each row of cells along z is reduced by one thread, the rows of each x-plane are reduced next, and the host reduces the
planes in double precision: the same tree whatever the machine does. Rows stay in single precision, since Metal has no
other; a row of n cells adds at most n/2 rounding errors of 6e-8, which is far below what any caller resolves.
"""

import numpy as np
import taichi as ti


@ti.data_oriented
class RowReductions:
    """Two numbers a row, written by a caller's kernel, reduced over all rows."""

    def __init__(self, rows_x: int, rows_y: int) -> None:
        self.row = ti.Vector.field(2, ti.f32, shape=(rows_x, rows_y))
        self._plane = ti.Vector.field(2, ti.f32, shape=rows_x)
        self._rows_x, self._rows_y = rows_x, rows_y

    def sums(self) -> tuple[float, float]:
        """Sums of both numbers over all rows."""
        self._sum_planes()
        first, second = self._plane.to_numpy().sum(axis=0, dtype=np.float64)
        return float(first), float(second)

    def maxima(self) -> tuple[float, float]:
        """Maxima of both numbers over all rows; the numbers are not negative."""
        self._max_planes()
        first, second = self._plane.to_numpy().max(axis=0)
        return float(first), float(second)

    @ti.kernel
    def _sum_planes(self):
        for i in range(self._rows_x):
            total = ti.Vector([0.0, 0.0])
            for j in range(self._rows_y):
                total += self.row[i, j]
            self._plane[i] = total

    @ti.kernel
    def _max_planes(self):
        for i in range(self._rows_x):
            largest = ti.Vector([0.0, 0.0])
            for j in range(self._rows_y):
                largest = ti.max(largest, self.row[i, j])
            self._plane[i] = largest
