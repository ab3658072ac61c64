"""Points sorted into the cells of a grid: a counting sort, the same whatever the number of threads.

The cells are numbered along x first, so that the cells of a row are one contiguous range of the sorted points.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import bundle, func
from sim.core.launch import kernel
from sim.core.parameters import Vector3
from sim.core.scan import scan_in_parallel, scan_scratch_length

Cells = ti.types.vector(3, ti.i32)

MAX_CELLS = 2**28  # most cells of a grid: 1 GiB for each of its int32 arrays, however few the particles


@bundle
class Grid(NamedTuple):
    """A grid of cells as kernels take it."""

    origin: ti.math.vec3  # lower corner of the outermost cells [m]
    inverse_cell_size: ti.f32  # [1/m]
    shape: Cells  # number of cells along x, y, z
    reach: ti.template()  # cells to either side that a search looks into


@bundle
class SortedPoints(NamedTuple):
    """Points sorted by cell, as a search reads them; coordinates in separate arrays become vector code."""

    x: Floats  # [m], (n,)
    y: Floats
    z: Floats
    cell_start: Integers  # first point of each cell, as `CellSort` finds it, (cells + 2,)


@bundle
class SortArrays(NamedTuple):
    """Arrays of a counting sort."""

    cell_of: Integers  # cell of each point, (capacity,)
    cursor: Integers  # next place in each cell, (cells + 1,)
    scratch: Integers  # of the scan
    cell_start: Integers  # first sorted point of each cell, (cells + 2,)
    order: Integers  # index before the sort of each sorted point, (capacity,)


@dataclass(frozen=True)
class CellGrid:
    """Cubic cells that cover a box, and a search radius around it."""

    origin: Vector3  # lower corner of the outermost cells [m]
    cell_size: float  # edge of a cell, at least the search radius over `reach` [m]
    shape: tuple[int, int, int]  # number of cells along x, y, z
    reach: int = 1  # cells to either side that a search looks into

    @classmethod
    def covering(
        cls, low: NDArray[np.floating], high: NDArray[np.floating], search_radius: float, *, reach: int = 1
    ) -> "CellGrid":
        """The grid for a box from `low` to `high` [m].

        Cells of the wanted reach are used only where `MAX_CELLS` allow: smaller cells are faster, not necessary.

        Raises:
            ValueError: the box holds more than `MAX_CELLS` cells as wide as the search radius [m].
        """
        low = np.asarray(low, dtype=np.float64)
        size = np.asarray(high, dtype=np.float64) - low
        for tried in (reach, 1):
            cell_size = search_radius / tried
            # Floats, as their product may be beyond any integer.
            shape = np.maximum(np.ceil(size / cell_size), 1.0) + 2.0 * tried
            if shape.prod() <= MAX_CELLS:
                origin = low - search_radius
                return cls(tuple(origin.tolist()), cell_size, tuple(shape.astype(int).tolist()), tried)
        raise ValueError(
            f"a box of {' x '.join(f'{edge:g}' for edge in size)} m has {shape.prod():.3g} neighbour cells of "
            f"{cell_size:g} m, more than {MAX_CELLS}; give a smaller domain or a larger particle radius"
        )

    @cached_property
    def on_device(self) -> Grid:
        """The grid for kernels."""
        return Grid(self.origin, 1.0 / self.cell_size, self.shape, self.reach)

    @property
    def cell_count(self) -> int:
        """Number of cells, the outer layers included."""
        return math.prod(self.shape)


class CellSort:
    """Sort of points by cell, then by id, without those outside the box that they must stay in.

    Attributes:
        cell_start: first sorted point of each cell; entry `cell_count` is the number of points kept, (cells + 2,).
        order: index before the sort of each sorted point, (capacity,).
    """

    def __init__(self, grid: CellGrid, capacity: int) -> None:
        self.grid = grid
        # One cell more than the grid has takes the points that are dropped.
        cells, points = grid.cell_count + 1, max(capacity, 1)
        lengths = points, cells, scan_scratch_length(cells), cells + 1, points
        self._arrays = SortArrays(*(ti.ndarray(ti.i32, length) for length in lengths))
        self.cell_start, self.order = self._arrays.cell_start, self._arrays.order

    def sort(self, positions: ti.Ndarray, ids: ti.Ndarray, count: int, low: Vector3, high: Vector3) -> int:
        """Order the first `count` points by cell, then by distinct ids; returns how many of them are kept.

        Those [m] that are not in the box between two corners [m] are dropped.
        """
        dropped = sort_points_by_cell(positions, ids, count, self.grid.on_device, low, high, self._arrays)
        return count - int(dropped)

    @property
    def arrays(self) -> SortArrays:
        """For a kernel that sorts by `counting_sort` and does more."""
        return self._arrays


@func
def cell_of_point(point: ti.math.vec3, grid: Grid) -> Cells:
    """Cell of a point, moved inside the outer layers, so that all cells around it exist; a NaN lands there too."""
    cell = ti.cast(ti.floor((point - grid.origin) * grid.inverse_cell_size), ti.i32)
    return ti.max(ti.min(cell, grid.shape - 1 - grid.reach), grid.reach)


@func
def row_of_cell(cell: Cells, dy: ti.i32, dz: ti.i32, grid: Grid) -> ti.i32:
    """Index of the cell next to `cell` by (0, dy, dz)."""
    return ((cell[2] + dz) * grid.shape[1] + cell[1] + dy) * grid.shape[0] + cell[0]


@kernel
def sort_points_by_cell(
    positions: Vectors,
    ids: Integers,
    count: ti.i32,
    grid: Grid,
    keep_low: ti.math.vec3,
    keep_high: ti.math.vec3,
    arrays: SortArrays,
) -> ti.i32:
    """As `counting_sort`."""
    return counting_sort(positions, ids, count, grid, keep_low, keep_high, arrays)


@func
def counting_sort(
    positions: Vectors,
    ids: Integers,
    count: ti.i32,
    grid: Grid,
    keep_low: ti.math.vec3,
    keep_high: ti.math.vec3,
    arrays: SortArrays,
) -> ti.i32:
    """Sort by cell; returns how many points were dropped, which are in one cell more than the grid has.

    For the outermost level of a kernel: its loops then run in parallel.
    """
    cell_count = grid.shape[0] * grid.shape[1] * grid.shape[2]
    for cell in range(cell_count + 1):
        arrays.cursor[cell] = 0
    for i in range(count):
        x_i = positions[i]
        cell = row_of_cell(cell_of_point(x_i, grid), 0, 0, grid)
        if (x_i < keep_low).any() or (x_i > keep_high).any():
            cell = cell_count
        arrays.cell_of[i] = cell
        ti.atomic_add(arrays.cursor[cell], 1)
    settle_in_cells(count, cell_count, ids, True, arrays)
    return count - arrays.cell_start[cell_count]


@func
def settle_in_cells(count: ti.i32, cell_count: ti.i32, ids: Integers, by_id: ti.template(), arrays: SortArrays):
    """Sort points whose cells, and the numbers of points in these at `cursor`, are known; one cell more takes the rest.

    Points of a cell are in the order of their ids, or of their numbers. Threads race for the places in it, the
    insertion sort settles it. For the outermost level of a kernel, as `counting_sort`.
    """
    scan_in_parallel(arrays.cursor, cell_count + 1, arrays.scratch, arrays.cell_start)
    for cell in range(cell_count + 1):
        arrays.cursor[cell] = arrays.cell_start[cell]
    for i in range(count):
        slot = ti.atomic_add(arrays.cursor[arrays.cell_of[i]], 1)
        arrays.order[slot] = i
    for cell in range(cell_count):
        first = arrays.cell_start[cell]
        for k in range(first + 1, arrays.cell_start[cell + 1]):
            point = arrays.order[k]
            slot = k
            # What a function reads is read whatever stands before the `and`.
            while slot > first and is_behind(arrays.order[ti.max(slot - 1, first)], point, ids, by_id):
                arrays.order[slot] = arrays.order[slot - 1]
                slot -= 1
            arrays.order[slot] = point


@func
def is_behind(one: ti.i32, other: ti.i32, ids: Integers, by_id: ti.template()) -> ti.i32:
    """Whether a point belongs behind another one of its cell."""
    behind = one > other
    if ti.static(by_id):
        behind = ids[one] > ids[other]
    return ti.cast(behind, ti.i32)
