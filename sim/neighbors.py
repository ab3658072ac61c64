"""Neighbours within a fixed radius: one compact list for all particles.

The cells (`sim.cells`) are cubes as wide as the search radius, or half as wide (`cells_per_radius`). The list is
counted before it is filled and grows when it must, so no particle and no cell has a limit of its own.

The list reaches a skin farther than the kernel's support (Verlet 1967), and stays valid until a particle has moved
half of that skin. The order of the particles, and so of every sum over neighbours, changes only when it is rebuilt;
within a cell it is the order of the particle ids, whatever the number of threads.
"""

import taichi as ti

from sim.cells import CellGrid, SortedPoints
from sim.neighbor_kernels import count_pairs, list_neighbors, measure_lists
from sim.reductions import runs_on_gpu
from sim.scan import scan_scratch_length

GROWTH = 1.25
WARP = 32
"""Threads of a GPU that read memory together."""

MAX_LIST_LENGTH = 2**31 - 1
"""Most entries of a neighbour list, as their places are int32."""

LEAST_FINE_SUPPORT = 3.0
"""Support radius in particle spacings from which on a GPU searches in cells of half a radius."""


class NeighborList:
    """For every particle the fluid particles, then the boundary samples, within a radius.

    Neighbour k of particle i is `indices[start[i] + k * stride]`: the first `fluid_count[i]` of them are sorted
    particles, the `boundary_count[i]` that follow are boundary samples. On a CPU the stride is 1 and the list is a
    compressed sparse row array. On a GPU it is 32, the lists of 32 particles interleaved (sliced ELLPACK, Monakov et
    al. 2010): the threads of a warp then read neighbouring addresses, which halves the time of a sum over neighbours.

    Attributes:
        stride: distance of a particle's entries in `indices`, a power of two.
        start: place of the first entry of each particle, (capacity,).
        fluid_count: fluid neighbours of each particle, itself excluded, (capacity,).
        boundary_count: boundary samples near each particle, (capacity,).
        indices: the entries; grows when it must.
        length: places in use, the padding of a stride above 1 included.
    """

    def __init__(self, grid: CellGrid, capacity: int, *, stride: int) -> None:
        self.grid, self.stride = grid, stride
        self.start = ti.ndarray(ti.i32, max(capacity, 1))
        self.fluid_count = ti.ndarray(ti.i32, max(capacity, 1))
        self.boundary_count = ti.ndarray(ti.i32, max(capacity, 1))
        self.indices = ti.ndarray(ti.i32, 1)
        self.length = 0
        slices = _slice_count(capacity, stride)
        self._slice_room = ti.ndarray(ti.i32, slices)
        self._slice_start = ti.ndarray(ti.i32, slices + 1)
        self._scratch = ti.ndarray(ti.i32, scan_scratch_length(slices))

    def build(
        self,
        radius: float,
        points: SortedPoints,
        count: int,
        fixed: SortedPoints,
        moving: SortedPoints | None,
        moving_index: ti.Ndarray,
    ) -> None:
        """Find all neighbours of the first `count` particles, themselves excluded.

        Args:
            radius: search radius, at most the size of as many cells as the grid's reach [m].
            points: the particles.
            count: number of particles.
            fixed: boundary samples that never move; their place among the sorted is their index.
            moving: boundary samples that move, or None.
            moving_index: index of each of the sorted moving samples.

        Raises:
            OverflowError: there are more neighbours than `MAX_LIST_LENGTH`.
        """
        grid = self.grid
        # Kernels take no None: without moving samples the fixed ones stand in, and are not read.
        movers = moving or fixed
        search = (
            *points.coordinates, points.cell_start, *fixed.coordinates, fixed.cell_start,
            *movers.coordinates, movers.cell_start, moving is not None, count,
            grid.origin, 1.0 / grid.cell_size, grid.shape, grid.reach, radius, self.stride > 1,
        )  # fmt: skip
        slices = _slice_count(count, self.stride)
        self.length, thousands = measure_lists(
            *search, self.fluid_count, self.boundary_count, self.stride, slices,
            self._slice_room, self._scratch, self._slice_start,
        )  # fmt: skip
        # Past the largest int32 the sum is negative; twice as far it would be positive again.
        if self.length < 0 or 1000.0 * thousands > 1.5 * MAX_LIST_LENGTH:
            raise OverflowError(
                f"{count} particles have more than {MAX_LIST_LENGTH} neighbours within {radius:g} m; "
                "give fewer particles, or start them farther apart"
            )
        if self.length > self.indices.shape[0]:
            self.indices = ti.ndarray(ti.i32, min(int(self.length * GROWTH), MAX_LIST_LENGTH))
        list_neighbors(
            *search, moving_index, self._slice_start, self.stride,
            self.start, self.fluid_count, self.boundary_count, self.indices,
        )  # fmt: skip

    def pairs_within(self, radius: float, positions: ti.Ndarray, count: int) -> int:
        """Ordered pairs of particles that are now nearer than `radius` [m], at most that of the list."""
        return int(
            count_pairs(positions, count, self.start, self.fluid_count, self.indices, self.stride, radius * radius)
        )


def list_stride() -> int:
    """The stride that suits the device Taichi runs on: 1 on a CPU, the width of a warp on a GPU."""
    return WARP if runs_on_gpu() else 1


def cells_per_radius(support_in_spacings: float) -> int:
    """Cells that a search radius spans to either side, as is fastest on the device Taichi runs on.

    On a GPU half as large cells leave out a third of the candidates, and bring particles of a warp nearer together.
    They pay where they still hold several particles.
    """
    return 2 if runs_on_gpu() and support_in_spacings >= LEAST_FINE_SUPPORT else 1


def _slice_count(count: int, stride: int) -> int:
    return max((count + stride - 1) // stride, 1)
