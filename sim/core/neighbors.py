"""Neighbours within a fixed radius: one compact list for all particles.

The cells (`sim.core.cells`) are cubes as wide as the search radius, or half as wide (`cells_per_radius`). The list is
counted before it is filled and grows when it must, so no particle and no cell has a limit of its own. Within a cell
particles are in the order of their ids, whatever the number of threads.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Integers
from sim.core.bundles import bundle, func
from sim.core.cells import CellGrid, Cells, Grid, SortedPoints, cell_of_point, row_of_cell
from sim.core.launch import kernel
from sim.core.reductions import runs_on_gpu
from sim.core.scan import scan_in_parallel, scan_scratch_length

GROWTH = 1.25
WARP = 32  # threads of a GPU that read memory together
MAX_LIST_LENGTH = 2**31 - 1  # most entries of a neighbour list, as their places are int32
LEAST_FINE_SUPPORT = 3.0  # support radius in particle spacings from which on a GPU searches in cells of half a radius
MASK_BITS, MASKS_A_ROW = 32, 2  # candidates that one int32 has bits for, and int32 for each row of cells
ROUNDING_MARGIN = 1.0e-5  # on a squared radius: far above the rounding of float32, far below spacings

Lengths = ti.types.vector(2, ti.i32)
Point = ti.math.vec3


@bundle
class Neighbors(NamedTuple):
    """The neighbour list as kernels read it; entry k of particle i is `indices[start[i] + k * stride]`."""

    start: Integers  # place of the first entry of each particle, (capacity,)
    fluid_count: Integers  # fluid neighbours of each particle, itself excluded, which come first, (capacity,)
    boundary_count: Integers  # boundary samples near each particle, which follow, (capacity,)
    indices: Integers  # the entries
    stride: ti.template()  # distance of a particle's entries: 1, or the width of a warp on a GPU


@bundle
class Search(NamedTuple):
    """Points among which neighbours are searched."""

    points: SortedPoints  # the particles
    fixed: SortedPoints  # boundary samples that never move; their place among the sorted is their index
    moving: SortedPoints  # boundary samples that move
    moving_index: Integers  # index of each of the sorted moving samples
    with_moving: ti.template()  # whether there are any
    grid: Grid
    count: ti.i32  # number of particles
    radius: ti.f32  # [m]


@bundle
class Slices(NamedTuple):
    """Layout of the list: as many particles as the stride share a slice."""

    count: ti.i32
    room: Integers  # places of each slice, (slices,)
    start: Integers  # place of its first entry, (slices + 1,)
    scratch: Integers  # of the scan


class NeighborList:
    """For every particle the fluid particles, then the boundary samples, within a radius.

    On a CPU the stride is 1 and the list is a compressed sparse row array. On a GPU it is 32, the lists of 32 particles
    interleaved (sliced ELLPACK, Monakov et al. 2010): the threads of a warp then read neighbouring addresses, which
    halves the time of a sum over neighbours.

    Attributes:
        stride: distance of a particle's entries, a power of two.
        lists: the list as kernels read it; its `indices` are other ones when they had to grow.
        length: places in use, the padding of a stride above 1 included.
    """

    def __init__(self, grid: CellGrid, capacity: int, *, stride: int) -> None:
        self.grid, self.stride = grid, stride
        start, fluid_count, boundary_count = (ti.ndarray(ti.i32, max(capacity, 1)) for _ in range(3))
        self.lists = Neighbors(start, fluid_count, boundary_count, ti.ndarray(ti.i32, 1), stride)
        self.length = 0
        slices = _slice_count(capacity, stride)
        self._slices = Slices(
            count=slices,
            room=ti.ndarray(ti.i32, slices),
            start=ti.ndarray(ti.i32, slices + 1),
            scratch=ti.ndarray(ti.i32, scan_scratch_length(slices)),
        )

    def build(
        self,
        radius: float,
        points: SortedPoints,
        count: int,
        fixed: SortedPoints,
        moving: SortedPoints | None,
        moving_index: ti.Ndarray,
    ) -> None:
        """Find all neighbours of the first `count` particles within a radius [m]; see `Search`.

        Raises:
            OverflowError: there are more neighbours than `MAX_LIST_LENGTH`.
        """
        # Kernels take no None: without moving samples the fixed ones stand in, and are not read.
        search = Search(
            points, fixed, moving or fixed, moving_index, moving is not None, self.grid.on_device, count, radius
        )
        slices = self._slices._replace(count=_slice_count(count, self.stride))
        self.length, thousands = measure_lists(search, self.lists, slices)
        # Past the largest int32 the sum is negative; twice as far it would be positive again.
        if self.length < 0 or 1000.0 * thousands > 1.5 * MAX_LIST_LENGTH:
            raise OverflowError(
                f"{count} particles have more than {MAX_LIST_LENGTH} neighbours within {radius:g} m; "
                "give fewer particles, or start them farther apart"
            )
        if self.length > self.lists.indices.shape[0]:
            room = min(int(self.length * GROWTH), MAX_LIST_LENGTH)
            self.lists = self.lists._replace(indices=ti.ndarray(ti.i32, room))
        list_neighbors(search, self.lists, slices)


def list_stride() -> int:
    """The stride that suits the device Taichi runs on: 1 on a CPU, the width of a warp on a GPU."""
    return WARP if runs_on_gpu() else 1


def cells_per_radius(support_in_spacings: float) -> int:
    """Cells that a search radius spans to either side, as is fastest on the device Taichi runs on.

    On a GPU half as large cells leave out a third of the candidates; they pay where they still hold several particles.
    """
    return 2 if runs_on_gpu() and support_in_spacings >= LEAST_FINE_SUPPORT else 1


def _slice_count(count: int, stride: int) -> int:
    return max((count + stride - 1) // stride, 1)


@func
def cells_in_reach(
    point: Point, cell: Cells, dy: ti.i32, dz: ti.i32, grid: Grid, radius_squared: ti.f32
) -> ti.math.ivec2:
    """Cells of a row that the sphere around a point touches: the first, and the one after the last, from its own."""
    cell_size = 1.0 / grid.inverse_cell_size
    y_in_cell = point[1] - grid.origin[1] - cell[1] * cell_size
    z_in_cell = point[2] - grid.origin[2] - cell[2] * cell_size
    gap_y = ti.max(ti.max(dy * cell_size - y_in_cell, y_in_cell - (dy + 1) * cell_size), 0.0)
    gap_z = ti.max(ti.max(dz * cell_size - z_in_cell, z_in_cell - (dz + 1) * cell_size), 0.0)
    touched = ti.math.ivec2(0)
    half_width_squared = radius_squared - gap_y * gap_y - gap_z * gap_z
    if half_width_squared > 0.0:
        half_width = ti.sqrt(half_width_squared)
        left = ti.cast(ti.floor((point[0] - half_width - grid.origin[0]) * grid.inverse_cell_size), ti.i32) - cell[0]
        right = ti.cast(ti.floor((point[0] + half_width - grid.origin[0]) * grid.inverse_cell_size), ti.i32) - cell[0]
        # Never right of the cell, nor left of it; said for a particle at NaN, which becomes any integer.
        touched[0] = ti.max(ti.min(left, 0), -grid.reach)
        touched[1] = ti.min(ti.max(right, 0), grid.reach) + 1
    return touched


@func
def count_near(point: Point, points: SortedPoints, first: ti.i32, last: ti.i32, radius_squared: ti.f32) -> ti.i32:
    """Number of a range's points within the radius; no branch on the distance, so that it becomes vector code."""
    near = 0
    for j in range(first, last):
        d_x, d_y, d_z = point[0] - points.x[j], point[1] - points.y[j], point[2] - points.z[j]
        near += ti.cast(d_x * d_x + d_y * d_y + d_z * d_z < radius_squared, ti.i32)
    return near


@func
def count_in_row(
    point: Point, points: SortedPoints, row: ti.i32, touched: ti.math.ivec2, radius_squared: ti.f32
) -> ti.i32:
    """Number of points within the radius in the touched cells of a row."""
    first, last = points.cell_start[row + touched[0]], points.cell_start[row + touched[1]]
    return count_near(point, points, first, last, radius_squared)


@func
def count_neighbors(search: Search, lists: Neighbors, slices: Slices):
    """Upper bounds of the numbers of neighbours, the particle itself included, and of boundary samples.

    The room of a slice becomes the longest list in it. A CPU reads whole rows of cells: loops of uneven length cost it
    more.
    """
    # A little more than the radius of the list, where a distance may be rounded differently.
    radius_squared = search.radius * search.radius * (1.0 + ROUNDING_MARGIN)
    # Every particle has one place to write to before it knows whether to keep; one at NaN is not even near itself.
    for s in range(slices.count):
        slices.room[s] = 1
    ti.loop_config(block_dim=128)
    for i in range(search.count):
        x_i = Point(search.points.x[i], search.points.y[i], search.points.z[i])
        cell = cell_of_point(x_i, search.grid)
        fluid_near, boundary_near = 0, 0
        for dz in range(-search.grid.reach, search.grid.reach + 1):
            for dy in range(-search.grid.reach, search.grid.reach + 1):
                row = row_of_cell(cell, dy, dz, search.grid)
                touched = ti.math.ivec2(-search.grid.reach, search.grid.reach + 1)
                if ti.static(lists.stride > 1):
                    touched = cells_in_reach(x_i, cell, dy, dz, search.grid, radius_squared)
                fluid_near += count_in_row(x_i, search.points, row, touched, radius_squared)
                boundary_near += count_in_row(x_i, search.fixed, row, touched, radius_squared)
                if ti.static(search.with_moving):
                    boundary_near += count_in_row(x_i, search.moving, row, touched, radius_squared)
        lists.fluid_count[i] = fluid_near
        lists.boundary_count[i] = boundary_near
        if ti.static(lists.stride > 1):
            ti.atomic_max(slices.room[i // lists.stride], fluid_near + boundary_near)
        else:
            slices.room[i] = ti.max(fluid_near + boundary_near, 1)


@kernel
def measure_lists(search: Search, lists: Neighbors, slices: Slices) -> Lengths:
    """Count neighbours, and lay out the list: each slice of `stride` particles gets `stride` times its longest list.

    Returns the places of all slices, as int32, and roughly the thousands of them, which do not overflow.
    """
    count_neighbors(search, lists, slices)
    total = 0.0
    for s in range(slices.count):
        slices.room[s] *= lists.stride
        total += ti.cast(slices.room[s], ti.f32)
    length = scan_in_parallel(slices.room, slices.count, slices.scratch, slices.start)
    return Lengths(length, ti.cast(total / 1000.0, ti.i32))


@func
def is_inside(point: Point, points: SortedPoints, j: ti.i32, own: ti.i32, radius_squared: ti.f32) -> ti.i32:
    """Whether a candidate is within the radius, and not `own`."""
    d_x, d_y, d_z = point[0] - points.x[j], point[1] - points.y[j], point[2] - points.z[j]
    return ti.cast(d_x * d_x + d_y * d_y + d_z * d_z < radius_squared, ti.i32) & ti.cast(j != own, ti.i32)


@func
def mask_of_near(
    point: Point, points: SortedPoints, first: ti.i32, last: ti.i32, own: ti.i32, radius_squared: ti.f32
) -> ti.i32:
    """Which of the first 32 points of a range are within the radius, but `own`, from the highest bit down."""
    mask = 0
    for k in range(ti.min(last - first, MASK_BITS)):
        mask |= is_inside(point, points, first + k, own, radius_squared) << (MASK_BITS - 1 - k)
    return mask


@func
def list_row_by_row(
    point: Point, points: SortedPoints, search: Search, own: ti.i32, lists: Neighbors, start: ti.i32, found: ti.i32
) -> ti.i32:
    """Append the points within the radius, but `own`; returns how many entries there are now.

    A CPU writes every candidate, and the place moves on only for those inside, without a branch to mispredict. A GPU
    tests 32 candidates before it writes those inside.
    """
    n = found
    radius_squared = search.radius * search.radius
    cell = cell_of_point(point, search.grid)
    for dz in range(-search.grid.reach, search.grid.reach + 1):
        for dy in range(-search.grid.reach, search.grid.reach + 1):
            touched = cells_in_reach(point, cell, dy, dz, search.grid, radius_squared)
            row = row_of_cell(cell, dy, dz, search.grid)
            first, last = points.cell_start[row + touched[0]], points.cell_start[row + touched[1]]
            if ti.static(lists.stride > 1):
                group = first
                while group < last:
                    mask = mask_of_near(point, points, group, last, own, radius_squared)
                    while mask != 0:
                        k = ti.math.clz(mask)
                        mask ^= 1 << (MASK_BITS - 1 - k)
                        lists.indices[start + n * lists.stride] = group + k
                        n += 1
                    group += MASK_BITS
            else:
                for j in range(first, last):
                    inside = is_inside(point, points, j, own, radius_squared)
                    lists.indices[start + n * lists.stride] = j
                    n += inside
    return n


@func
def list_in_step(
    point: Point, points: SortedPoints, search: Search, own: ti.i32, lists: Neighbors, start: ti.i32, found: ti.i32
) -> ti.i32:
    """As `list_row_by_row`, for a GPU: all candidates are tested before those within the radius are written.

    The threads of a warp, whose lists are interleaved, then write at neighbouring addresses at one time. This pays from
    hundreds of neighbours on. Rows of more candidates than the masks hold take more than one turn.
    """
    width = ti.static(2 * search.grid.reach + 1)
    radius_squared = search.radius * search.radius
    cell = cell_of_point(point, search.grid)
    n = found
    passed = 0
    while passed >= 0:
        masks = ti.Vector([0] * (MASKS_A_ROW * width * width))
        firsts = ti.Vector([0] * (width * width))
        entries = 0
        next_passed = -1
        for r in range(width * width):
            dy, dz = r % width - search.grid.reach, r // width - search.grid.reach
            touched = cells_in_reach(point, cell, dy, dz, search.grid, radius_squared)
            row = row_of_cell(cell, dy, dz, search.grid)
            first, last = points.cell_start[row + touched[0]] + passed, points.cell_start[row + touched[1]]
            firsts[r] = first
            for part in ti.static(range(MASKS_A_ROW)):
                mask = mask_of_near(point, points, first + part * MASK_BITS, last, own, radius_squared)
                masks[r * MASKS_A_ROW + part] = mask
                entries += ti.math.popcnt(mask)
            if first + MASKS_A_ROW * MASK_BITS < last:
                next_passed = passed + MASKS_A_ROW * MASK_BITS
        group = -1
        mask = 0
        for _ in range(entries):
            while mask == 0:
                group += 1
                mask = masks[group]
            k = ti.math.clz(mask)
            mask ^= 1 << (MASK_BITS - 1 - k)
            lists.indices[start + n * lists.stride] = firsts[group // MASKS_A_ROW] + group % MASKS_A_ROW * MASK_BITS + k
            n += 1
        passed = next_passed
    return n


@func
def list_near(
    point: Point, points: SortedPoints, search: Search, own: ti.i32, lists: Neighbors, start: ti.i32, found: ti.i32
) -> ti.i32:
    """Append the points within the radius, but `own`, as suits the list; returns how many entries there are now."""
    n = found
    if ti.static(lists.stride > 1 and search.grid.reach > 1):
        n = list_in_step(point, points, search, own, lists, start, found)
    else:
        n = list_row_by_row(point, points, search, own, lists, start, found)
    return n


@kernel
def list_neighbors(search: Search, lists: Neighbors, slices: Slices):
    """Write the neighbours of each particle; `boundary_count` holds an upper bound of its boundary samples before."""
    ti.loop_config(block_dim=128)
    for i in range(search.count):
        x_i = Point(search.points.x[i], search.points.y[i], search.points.z[i])
        first = slices.start[i // lists.stride] + i % lists.stride
        fluid_found = list_near(x_i, search.points, search, i, lists, first, 0)
        found = fluid_found
        if lists.boundary_count[i] > 0:
            found = list_near(x_i, search.fixed, search, -1, lists, first, fluid_found)
            if ti.static(search.with_moving):
                fixed_found = found
                found = list_near(x_i, search.moving, search, -1, lists, first, fixed_found)
                for k in range(fixed_found, found):
                    place = first + k * lists.stride
                    lists.indices[place] = search.moving_index[lists.indices[place]]
        lists.start[i] = first
        lists.fluid_count[i] = fluid_found
        lists.boundary_count[i] = found - fluid_found
