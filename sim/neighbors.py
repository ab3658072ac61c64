"""Neighbours within a fixed radius: one compact list for all particles.

The cells (`sim.cells`) are cubes as wide as the search radius. The list is counted before it is filled and grows
when it must, so no particle and no cell has a limit of its own.

The list reaches a skin farther than the kernel's support (Verlet 1967), and stays valid until a particle has moved
half of that skin. The order of the particles, and so of every sum over neighbours, changes only when it is rebuilt;
within a cell it is the order of the particle ids, whatever the number of threads.
"""

import taichi as ti

from sim.cells import (
    CellGrid,
    Cells,
    Floats,
    Integers,
    SortedPoints,
    Vectors,
    cell_of_point,
    row_of_cell,
)
from sim.launch import fast_launch
from sim.reductions import runs_on_gpu
from sim.scan import scan_in_parallel, scan_scratch_length

GROWTH = 1.25
WARP = 32
"""Threads of a GPU that read memory together."""

Lengths = ti.types.vector(2, ti.i32)

MAX_LIST_LENGTH = 2**31 - 1
"""Most entries of a neighbour list, as their places are int32."""

ROUNDING_MARGIN = 1.0e-5
"""Relative margin on a squared radius: far above the rounding of float32, far below the spacing of particles."""


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
            radius: search radius, at most the cell size [m].
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
            grid.origin, 1.0 / grid.cell_size, grid.shape, radius,
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
            *search, moving_index, self._slice_start, self.stride, self.stride == 1,
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


def _slice_count(count: int, stride: int) -> int:
    return max((count + stride - 1) // stride, 1)


@ti.func
def count_in_row(
    x_i: ti.f32, y_i: ti.f32, z_i: ti.f32, x: Floats, y: Floats, z: Floats, first: ti.i32, last: ti.i32,
    radius_squared: ti.f32,
) -> ti.i32:  # fmt: skip
    """Number of points of a range within the radius; without a branch, so that it becomes vector code."""
    near = 0
    for j in range(first, last):
        dx, dy, dz = x_i - x[j], y_i - y[j], z_i - z[j]
        near += ti.cast(dx * dx + dy * dy + dz * dz < radius_squared, ti.i32)
    return near


@ti.func
def count_neighbors(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, radius: ti.f32,
    fluid_count: Integers, boundary_count: Integers,
):  # fmt: skip
    """How many neighbours each particle may have, itself included, and how many boundary samples.

    The radius is a little larger than that of the list: there a distance may be rounded differently.
    """
    radius_squared = radius * radius * (1.0 + ROUNDING_MARGIN)
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, y_i, z_i = x[i], y[i], z[i]
        cell = cell_of_point(ti.math.vec3(x_i, y_i, z_i), origin, inverse_cell_size, shape)
        fluid_near = 0
        boundary_near = 0
        for dz in ti.static(range(-1, 2)):
            for dy in ti.static(range(-1, 2)):
                row = row_of_cell(cell, dy, dz, shape)
                fluid_near += count_in_row(
                    x_i, y_i, z_i, x, y, z, cell_start[row - 1], cell_start[row + 2], radius_squared
                )
                boundary_near += count_in_row(
                    x_i, y_i, z_i, fixed_x, fixed_y, fixed_z,
                    fixed_cell_start[row - 1], fixed_cell_start[row + 2], radius_squared,
                )  # fmt: skip
                if ti.static(with_moving):
                    boundary_near += count_in_row(
                        x_i, y_i, z_i, moving_x, moving_y, moving_z,
                        moving_cell_start[row - 1], moving_cell_start[row + 2], radius_squared,
                    )  # fmt: skip
        fluid_count[i] = fluid_near
        boundary_count[i] = boundary_near


@fast_launch
@ti.kernel
def measure_lists(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, radius: ti.f32,
    fluid_count: Integers, boundary_count: Integers, stride: ti.i32, slices: ti.i32,
    room: Integers, scratch: Integers, slice_start: Integers,
) -> Lengths:  # fmt: skip
    """Count neighbours, and lay out the list: each slice of `stride` particles gets `stride` times its longest list.

    Returns the places of all slices, as int32, and roughly the thousands of them, which do not overflow.

    The count includes the particle itself: the list uses that place to write before it knows whether to keep.
    A particle at NaN is not even near itself, and needs the place too.
    """
    count_neighbors(
        x, y, z, cell_start, fixed_x, fixed_y, fixed_z, fixed_cell_start,
        moving_x, moving_y, moving_z, moving_cell_start, with_moving,
        count, origin, inverse_cell_size, shape, radius, fluid_count, boundary_count,
    )  # fmt: skip
    total = 0.0
    for s in range(slices):
        longest = 1
        for i in range(s * stride, ti.min((s + 1) * stride, count)):
            longest = ti.max(longest, fluid_count[i] + boundary_count[i])
        room[s] = longest * stride
        total += ti.cast(longest * stride, ti.f32)
    length = scan_in_parallel(room, slices, scratch, slice_start)
    return Lengths(length, ti.cast(total / 1000.0, ti.i32))


@ti.func
def list_row(
    x_i: ti.f32, y_i: ti.f32, z_i: ti.f32, x: Floats, y: Floats, z: Floats, first: ti.i32, last: ti.i32,
    own: ti.i32, radius_squared: ti.f32, start: ti.i32, found: ti.i32, stride: ti.i32, branchless: ti.template(),
    indices: Integers,
) -> ti.i32:  # fmt: skip
    """Append the points of a range within the radius, but `own`; returns how many there are now.

    On a CPU every candidate is written, and the place moves on only for those inside: a branch would be mispredicted
    for every third candidate. On a GPU the writes would cost more than the branch.
    """
    n = found
    for j in range(first, last):
        dx, dy, dz = x_i - x[j], y_i - y[j], z_i - z[j]
        inside = ti.cast(dx * dx + dy * dy + dz * dz < radius_squared, ti.i32) & ti.cast(j != own, ti.i32)
        if ti.static(branchless):
            indices[start + n * stride] = j
            n += inside
        elif inside != 0:
            indices[start + n * stride] = j
            n += 1
    return n


@fast_launch
@ti.kernel
def list_neighbors(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, radius: ti.f32,
    moving_index: Integers, slice_start: Integers, stride: ti.i32, branchless: ti.template(),
    start: Integers, fluid_count: Integers, boundary_count: Integers, indices: Integers,
):  # fmt: skip
    """Write the neighbours of each particle; `boundary_count` holds an upper bound of its boundary samples before.

    Candidates are those of the rows of cells, as far along x as the sphere reaches into the row.
    """
    radius_squared = radius * radius
    cell_size = 1.0 / inverse_cell_size
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i, y_i, z_i = x[i], y[i], z[i]
        cell = cell_of_point(ti.math.vec3(x_i, y_i, z_i), origin, inverse_cell_size, shape)
        y_in_cell = y_i - origin[1] - cell[1] * cell_size
        z_in_cell = z_i - origin[2] - cell[2] * cell_size
        gap_y = ti.math.vec3(y_in_cell, 0.0, cell_size - y_in_cell)
        gap_z = ti.math.vec3(z_in_cell, 0.0, cell_size - z_in_cell)
        first_place = slice_start[i // stride] + i % stride
        found = 0
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
                    found = list_row(
                        x_i, y_i, z_i, x, y, z, cell_start[row + left], cell_start[row + 1 + right],
                        i, radius_squared, first_place, found, stride, branchless, indices,
                    )  # fmt: skip
        fluid_found = found
        if boundary_count[i] > 0:
            for dz in ti.static(range(-1, 2)):
                for dy in ti.static(range(-1, 2)):
                    row = row_of_cell(cell, dy, dz, shape)
                    found = list_row(
                        x_i, y_i, z_i, fixed_x, fixed_y, fixed_z,
                        fixed_cell_start[row - 1], fixed_cell_start[row + 2],
                        -1, radius_squared, first_place, found, stride, branchless, indices,
                    )  # fmt: skip
            if ti.static(with_moving):
                fixed_found = found
                for dz in ti.static(range(-1, 2)):
                    for dy in ti.static(range(-1, 2)):
                        row = row_of_cell(cell, dy, dz, shape)
                        found = list_row(
                            x_i, y_i, z_i, moving_x, moving_y, moving_z,
                            moving_cell_start[row - 1], moving_cell_start[row + 2],
                            -1, radius_squared, first_place, found, stride, branchless, indices,
                        )  # fmt: skip
                for k in range(fixed_found, found):
                    place = first_place + k * stride
                    indices[place] = moving_index[indices[place]]
        start[i] = first_place
        fluid_count[i] = fluid_found
        boundary_count[i] = found - fluid_found


@ti.kernel
def count_pairs(
    positions: Vectors, count: ti.i32, start: Integers, fluid_count: Integers, indices: Integers, stride: ti.i32,
    radius_squared: ti.f32,
) -> ti.i64:  # fmt: skip
    """Entries of the list that are within the radius."""
    pairs = ti.cast(0, ti.i64)
    for i in range(count):
        near = 0
        for k in range(fluid_count[i]):
            x_ij = positions[i] - positions[indices[start[i] + k * stride]]
            near += ti.cast(x_ij.norm_sqr() < radius_squared, ti.i32)
        pairs += near
    return pairs
