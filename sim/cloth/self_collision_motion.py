"""How far pieces of cloth that are near each other move against each other: less than cloth moves at all."""

import numpy as np
import taichi as ti

from sim.arrays import Integers, Vectors
from sim.cells import Cells
from sim.cloth.self_collision_kernels import range_of_vectors
from sim.launch import fast_launch

CELLS_PER_AXIS = 32
"""Most cells along an axis, two of them empty ones at the ends."""

CELL_IN_EDGES = 4.0
"""Least edge of a cell, in mean edges of the cloth: small enough for smooth motion to be nearly common in 27 cells."""

EMPTY = 1.0e30


class LocalMotion:
    """Bounds relative displacements by coarse cells: those of vertices that were in neighbouring cells.

    Args:
        vertex_count: number of vertices, n.

    Attributes:
        cell_size: edge of a cell [m]; vertices that were not in neighbouring cells were farther apart.
    """

    def __init__(self, vertex_count: int) -> None:
        self._count = vertex_count
        self._cell = ti.ndarray(ti.i32, vertex_count)
        self._shape = (1, 1, 1)
        self._low, self._high = (ti.Vector.ndarray(3, ti.f32, CELLS_PER_AXIS**3) for _ in range(2))
        self.cell_size = 0.0

    def place(self, positions: ti.Ndarray, least_cell_size: float) -> None:
        """Assign vertices to cells where they are now [m], (n,) vec3."""
        ends = np.array(range_of_vectors(positions, self._count)[:6], dtype=np.float64)
        low, high = -ends[3:], ends[:3]
        self.cell_size = max(least_cell_size, float((high - low).max()) / (CELLS_PER_AXIS - 3))
        self._shape = tuple(int(n) for n in np.floor((high - low) / self.cell_size) + 3)
        assign_cells(positions, self._count, low - self.cell_size, 1.0 / self.cell_size, self._shape, self._cell)

    def of(self, displacement: ti.Ndarray) -> float:
        """Half of how far vertices of neighbouring cells get apart from each other at most [m], an upper bound."""
        return float(
            bound_motion(displacement, self._count, self._cell, self._shape, self._low, self._high)
        )  # fmt: skip


@fast_launch
@ti.kernel
def assign_cells(
    position: Vectors, count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, cell: Integers
):
    """Number of the cell of each vertex, never one of the outermost."""
    for i in range(count):
        place = ti.cast(ti.floor((position[i] - origin) * inverse_cell_size), ti.i32)
        place = ti.math.clamp(place, 1, shape - 2)
        cell[i] = place[0] + shape[0] * (place[1] + shape[1] * place[2])


@fast_launch
@ti.kernel
def bound_motion(
    displacement: Vectors, count: ti.i32, cell: Integers, shape: Cells, low: Vectors, high: Vectors
) -> ti.f32:  # fmt: skip
    """Half the diagonal of the box of displacements in any 27 cells; minima and maxima are exact in any order."""
    for c in range(shape[0] * shape[1] * shape[2]):
        low[c], high[c] = ti.math.vec3(EMPTY), ti.math.vec3(-EMPTY)
    for i in range(count):
        c = cell[i]
        for axis in ti.static(range(3)):
            u = displacement[i][axis]
            # Most are inside of what others have spread already, which is cheaper to see than to change.
            if u < low[c][axis]:
                ti.atomic_min(low[c][axis], u)
            if u > high[c][axis]:
                ti.atomic_max(high[c][axis], u)
    largest = 0.0
    for c in range(shape[0] * shape[1] * shape[2]):
        if low[c][0] < 0.5 * EMPTY:
            least, most = ti.math.vec3(EMPTY), ti.math.vec3(-EMPTY)
            for k in range(27):
                other = c + k % 3 - 1 + shape[0] * (k // 3 % 3 - 1 + shape[1] * (k // 9 - 1))
                least, most = ti.min(least, low[other]), ti.max(most, high[other])
            ti.atomic_max(largest, 0.5 * (most - least).norm())
    return largest
