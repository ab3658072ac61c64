"""Neighbours within a fixed radius: a counting sort into cells, then one compact list for all particles.

The cells are cubes as wide as the search radius, numbered along x first, so that the three cells of a row are one
contiguous range of the sorted particles. The list is a compressed sparse row array: it is counted before it is
filled and grows when it must, so no particle and no cell has a limit of its own.

The list reaches a skin farther than the kernel's support (Verlet 1967), and stays valid until a particle has moved
half of that skin. The order of the particles, and so of every sum over neighbours, changes only when it is rebuilt;
within a cell it is the order of the particle ids, whatever the number of threads.
"""

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
Cells = ti.types.vector(3, ti.i32)

SCAN_BLOCK = 1024
GROWTH = 1.25
MAX_CELLS = 2**28
"""Most cells of a grid: 1 GiB for each of its int32 arrays, however few the particles."""

MAX_LIST_LENGTH = 2**31 - 1
"""Most entries of a neighbour list, as their places are int32."""

ROUNDING_MARGIN = 1.0e-5
"""Relative margin on a squared radius: far above the rounding of float32, far below the spacing of particles."""


@dataclass(frozen=True)
class CellGrid:
    """Cubic cells that cover a box, with one more layer of cells around it.

    Attributes:
        origin: lower corner of the outermost cells [m].
        cell_size: edge of a cell, at least the search radius [m].
        shape: number of cells along x, y, z.
    """

    origin: tuple[float, float, float]
    cell_size: float
    shape: tuple[int, int, int]

    @classmethod
    def covering(cls, low: NDArray[np.floating], high: NDArray[np.floating], cell_size: float) -> "CellGrid":
        """The grid for a box from `low` to `high` [m].

        Raises:
            ValueError: the box holds more than `MAX_CELLS` cells, wherever the points are.
        """
        size = np.asarray(high, dtype=np.float64) - np.asarray(low, dtype=np.float64)
        shape = np.maximum(np.ceil(size / cell_size), 1.0) + 2.0
        if not shape.prod() <= MAX_CELLS:
            raise ValueError(
                f"a box of {' x '.join(f'{edge:g}' for edge in size)} m has {shape.prod():.3g} neighbour cells of "
                f"{cell_size:g} m, more than {MAX_CELLS}; give a smaller domain or a larger particle radius"
            )
        origin = np.asarray(low, dtype=np.float64) - cell_size
        return cls(tuple(origin.tolist()), cell_size, tuple(shape.astype(int).tolist()))

    @property
    def cell_count(self) -> int:
        """Number of cells, the outer layer included."""
        nx, ny, nz = self.shape
        return nx * ny * nz


class CellSort:
    """Sorts points by cell, then by id; drops those outside the box that they must stay in.

    Attributes:
        cell_start: first sorted point of each cell; entry `cell_count` is the number of points kept, (cells + 2,).
        order: index before the sort of each sorted point, (capacity,).
    """

    def __init__(self, grid: CellGrid, capacity: int) -> None:
        self.grid = grid
        # One cell more than the grid has takes the points that are dropped.
        self.cell_start = ti.ndarray(ti.i32, grid.cell_count + 2)
        self._cursor = ti.ndarray(ti.i32, grid.cell_count + 1)
        self._block_sums = ti.ndarray(ti.i32, _block_count(grid.cell_count + 1))
        self._cell_of = ti.ndarray(ti.i32, max(capacity, 1))
        self.order = ti.ndarray(ti.i32, max(capacity, 1))

    def sort(
        self,
        positions: ti.Ndarray,
        ids: ti.Ndarray,
        count: int,
        keep_low: tuple[float, float, float],
        keep_high: tuple[float, float, float],
    ) -> int:
        """Order the first `count` points; returns how many of them are kept.

        Args:
            positions: points [m], at least (count,) of 3-vectors.
            ids: distinct numbers that decide the order within a cell, at least (count,).
            count: number of points.
            keep_low: points below this on any axis are dropped [m].
            keep_high: points above this on any axis are dropped [m].
        """
        grid = self.grid
        dropped = count_points_per_cell(
            positions,
            count,
            ti.math.vec3(*grid.origin),
            1.0 / grid.cell_size,
            Cells(*grid.shape),
            ti.math.vec3(*keep_low),
            ti.math.vec3(*keep_high),
            self._cell_of,
            self._cursor,
        )
        exclusive_scan(self._cursor, grid.cell_count + 1, self._block_sums, self.cell_start)
        order_points_by_cell(self._cell_of, ids, count, grid.cell_count, self.cell_start, self._cursor, self.order)
        return count - int(dropped)


class NeighborList:
    """For every particle the fluid particles, then the boundary samples, within a radius.

    Particle i has `indices[start[i] : boundary_start[i]]` of the sorted particles, and
    `indices[boundary_start[i] : end[i]]` of the sorted boundary samples.
    """

    def __init__(self, grid: CellGrid, capacity: int, expected_neighbors: int) -> None:
        self.grid = grid
        self.start = ti.ndarray(ti.i32, capacity + 1)
        self.boundary_start = ti.ndarray(ti.i32, max(capacity, 1))
        self.end = ti.ndarray(ti.i32, max(capacity, 1))
        self.indices = ti.ndarray(ti.i32, max(capacity * expected_neighbors, 1))
        self.length = 0
        self._room = ti.ndarray(ti.i32, max(capacity, 1))
        self._block_sums = ti.ndarray(ti.i32, _block_count(capacity))

    def build(
        self,
        radius: float,
        points: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray],
        cell_start: ti.Ndarray,
        count: int,
        boundary_points: tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray],
        boundary_cell_start: ti.Ndarray,
    ) -> None:
        """Find all neighbours of the first `count` particles, themselves excluded.

        Args:
            radius: search radius, at most the cell size [m].
            points: x, y and z of the particles, sorted by cell [m].
            cell_start: their cell ranges.
            count: number of particles.
            boundary_points: x, y and z of the boundary samples, sorted by cell [m].
            boundary_cell_start: their cell ranges.

        Raises:
            OverflowError: there are more neighbours than `MAX_LIST_LENGTH`.
        """
        grid = self.grid
        search = (
            *points, *boundary_points, cell_start, boundary_cell_start, count,
            ti.math.vec3(*grid.origin), 1.0 / grid.cell_size, Cells(*grid.shape), radius,
        )  # fmt: skip
        count_neighbors(*search, self._room, self.end)
        self.length = int(exclusive_scan(self._room, count, self._block_sums, self.start))
        if self.length < 0:  # the sum has passed the largest int32
            raise OverflowError(
                f"{count} particles have more than {MAX_LIST_LENGTH} neighbours within {radius:g} m; "
                "give fewer particles, or start them farther apart"
            )
        if self.length > self.indices.shape[0]:
            self.indices = ti.ndarray(ti.i32, min(int(self.length * GROWTH), MAX_LIST_LENGTH))
        list_neighbors(*search, self.start, self.boundary_start, self.end, self.indices)


def _block_count(length: int) -> int:
    return max((length + SCAN_BLOCK - 1) // SCAN_BLOCK, 1)


@ti.func
def cell_of_point(point: ti.math.vec3, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells) -> Cells:
    """Cell of a point, moved inside the outer layer, so that all 27 cells around it exist; a NaN lands there too."""
    cell = ti.cast(ti.floor((point - origin) * inverse_cell_size), ti.i32)
    return ti.max(ti.min(cell, shape - 2), 1)


@ti.func
def row_of_cell(cell: Cells, dy: ti.i32, dz: ti.i32, shape: Cells) -> ti.i32:
    """Index of the cell next to `cell` by (0, dy, dz)."""
    return ((cell[2] + dz) * shape[1] + cell[1] + dy) * shape[0] + cell[0]


@ti.kernel
def count_points_per_cell(
    positions: Vectors,
    count: ti.i32,
    origin: ti.math.vec3,
    inverse_cell_size: ti.f32,
    shape: Cells,
    keep_low: ti.math.vec3,
    keep_high: ti.math.vec3,
    cell_of: Integers,
    points_in_cell: Integers,
) -> ti.i32:
    """Cell of each point and number of points per cell; the last cell counts, and the result is, the dropped ones."""
    cell_count = shape[0] * shape[1] * shape[2]
    for cell in range(cell_count + 1):
        points_in_cell[cell] = 0
    dropped = 0
    for i in range(count):
        x_i = positions[i]
        cell = row_of_cell(cell_of_point(x_i, origin, inverse_cell_size, shape), 0, 0, shape)
        if (x_i < keep_low).any() or (x_i > keep_high).any():
            cell = cell_count
            dropped += 1
        cell_of[i] = cell
        ti.atomic_add(points_in_cell[cell], 1)
    return dropped


@ti.kernel
def exclusive_scan(values: Integers, length: ti.i32, block_sums: Integers, result: Integers) -> ti.i32:
    """result[k] = sum of values[:k] for k = 0 ... length; returns the last of them."""
    block_count = (length + SCAN_BLOCK - 1) // SCAN_BLOCK
    for block in range(block_count):
        block_sum = 0
        for k in range(block * SCAN_BLOCK, ti.min((block + 1) * SCAN_BLOCK, length)):
            block_sum += values[k]
        block_sums[block] = block_sum
    total = 0
    ti.loop_config(serialize=True)
    for block in range(block_count):
        block_sum = block_sums[block]
        block_sums[block] = total
        total += block_sum
    for block in range(block_count):
        running = block_sums[block]
        for k in range(block * SCAN_BLOCK, ti.min((block + 1) * SCAN_BLOCK, length)):
            result[k] = running
            running += values[k]
    result[length] = total
    return total


@ti.kernel
def order_points_by_cell(
    cell_of: Integers,
    ids: Integers,
    count: ti.i32,
    cell_count: ti.i32,
    cell_start: Integers,
    cursor: Integers,
    order: Integers,
):
    """Put the points of a cell next to each other, by id: threads race for the slots, the insertion sort settles it."""
    for cell in range(cell_count + 1):
        cursor[cell] = cell_start[cell]
    for i in range(count):
        slot = ti.atomic_add(cursor[cell_of[i]], 1)
        order[slot] = i
    for cell in range(cell_count):
        first = cell_start[cell]
        for k in range(first + 1, cell_start[cell + 1]):
            point = order[k]
            slot = k
            while slot > first and ids[order[slot - 1]] > ids[point]:
                order[slot] = order[slot - 1]
                slot -= 1
            order[slot] = point


@ti.kernel
def count_neighbors(
    x: Floats, y: Floats, z: Floats,
    boundary_x: Floats, boundary_y: Floats, boundary_z: Floats,
    cell_start: Integers, boundary_cell_start: Integers,
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, radius: ti.f32,
    room: Integers, boundary_count: Integers,
):  # fmt: skip
    """Room that each particle's neighbours need in the list, and how many of them may be boundary samples.

    Coordinates are separate arrays and the loops have no branch, so that compilers turn them into vector code. The
    radius is a little larger than that of the list: there a distance may be rounded differently.
    """
    radius_squared = radius * radius * (1.0 + ROUNDING_MARGIN)
    ti.loop_config(block_dim=256)
    for i in range(count):
        x_i, y_i, z_i = x[i], y[i], z[i]
        cell = cell_of_point(ti.math.vec3(x_i, y_i, z_i), origin, inverse_cell_size, shape)
        fluid_near = 0
        boundary_near = 0
        for dz in ti.static(range(-1, 2)):
            for dy in ti.static(range(-1, 2)):
                row = row_of_cell(cell, dy, dz, shape)
                for j in range(cell_start[row - 1], cell_start[row + 2]):
                    dx_ij, dy_ij, dz_ij = x_i - x[j], y_i - y[j], z_i - z[j]
                    inside = dx_ij * dx_ij + dy_ij * dy_ij + dz_ij * dz_ij < radius_squared
                    fluid_near += ti.cast(inside, ti.i32)
                for b in range(boundary_cell_start[row - 1], boundary_cell_start[row + 2]):
                    dx_ib, dy_ib, dz_ib = x_i - boundary_x[b], y_i - boundary_y[b], z_i - boundary_z[b]
                    inside = dx_ib * dx_ib + dy_ib * dy_ib + dz_ib * dz_ib < radius_squared
                    boundary_near += ti.cast(inside, ti.i32)
        # The count includes the particle itself: the list uses that place to write before it knows whether to keep.
        # A particle at NaN is not even near itself, and needs the place too.
        room[i] = ti.max(fluid_near + boundary_near, 1)
        boundary_count[i] = boundary_near


@ti.kernel
def list_neighbors(
    x: Floats, y: Floats, z: Floats,
    boundary_x: Floats, boundary_y: Floats, boundary_z: Floats,
    cell_start: Integers, boundary_cell_start: Integers,
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, radius: ti.f32,
    start: Integers, boundary_start: Integers, end: Integers, indices: Integers,
):  # fmt: skip
    """Write the neighbours of each particle; `end` holds its number of boundary samples before.

    Every candidate is written, and the place moves on only for those inside: a branch would be mispredicted for every
    third candidate. Candidates are those of the rows of cells, as far along x as the sphere reaches into the row.
    """
    radius_squared = radius * radius
    cell_size = 1.0 / inverse_cell_size
    ti.loop_config(block_dim=256)
    for i in range(count):
        x_i, y_i, z_i = x[i], y[i], z[i]
        cell = cell_of_point(ti.math.vec3(x_i, y_i, z_i), origin, inverse_cell_size, shape)
        y_in_cell = y_i - origin[1] - cell[1] * cell_size
        z_in_cell = z_i - origin[2] - cell[2] * cell_size
        gap_y = ti.math.vec3(y_in_cell, 0.0, cell_size - y_in_cell)
        gap_z = ti.math.vec3(z_in_cell, 0.0, cell_size - z_in_cell)
        slot = start[i]
        for dz in ti.static(range(-1, 2)):
            for dy in ti.static(range(-1, 2)):
                reach_squared = radius_squared - gap_y[dy + 1] ** 2 - gap_z[dz + 1] ** 2
                if reach_squared > 0.0:
                    reach = ti.sqrt(reach_squared)
                    left = ti.cast(ti.floor((x_i - reach - origin[0]) * inverse_cell_size), ti.i32) - cell[0]
                    right = ti.cast(ti.floor((x_i + reach - origin[0]) * inverse_cell_size), ti.i32) - cell[0]
                    # Never right of the cell, nor left of it; said for a particle at NaN, which becomes any integer.
                    left = ti.max(ti.min(left, 0), -1)
                    right = ti.min(ti.max(right, 0), 1)
                    row = row_of_cell(cell, dy, dz, shape)
                    for j in range(cell_start[row + left], cell_start[row + 1 + right]):
                        dx_ij, dy_ij, dz_ij = x_i - x[j], y_i - y[j], z_i - z[j]
                        inside = dx_ij * dx_ij + dy_ij * dy_ij + dz_ij * dz_ij < radius_squared
                        indices[slot] = j
                        slot += ti.cast(inside, ti.i32) & ti.cast(j != i, ti.i32)
        boundary_start[i] = slot
        if end[i] > 0:
            for dz in ti.static(range(-1, 2)):
                for dy in ti.static(range(-1, 2)):
                    row = row_of_cell(cell, dy, dz, shape)
                    for b in range(boundary_cell_start[row - 1], boundary_cell_start[row + 2]):
                        dx_ib, dy_ib, dz_ib = x_i - boundary_x[b], y_i - boundary_y[b], z_i - boundary_z[b]
                        inside = dx_ib * dx_ib + dy_ib * dy_ib + dz_ib * dz_ib < radius_squared
                        indices[slot] = b
                        slot += ti.cast(inside, ti.i32)
        end[i] = slot
