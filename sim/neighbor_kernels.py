"""Kernels of the search for neighbours: count them, lay out the list, write it (`sim.neighbors`)."""

import taichi as ti

from sim.arrays import Floats, Integers, Vectors
from sim.cells import Cells, cell_of_point, row_of_cell
from sim.launch import fast_launch
from sim.scan import scan_in_parallel

Lengths = ti.types.vector(2, ti.i32)

MASK_BITS, MASKS_A_ROW = 32, 2
"""Candidates that one int32 has bits for, and int32 for each row of cells."""

ROUNDING_MARGIN = 1.0e-5
"""Relative margin on a squared radius: far above the rounding of float32, far below the spacing of particles."""


@ti.func
def cells_in_reach(
    point: ti.math.vec3, cell: Cells, dy: ti.i32, dz: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32,
    reach: ti.template(), radius_squared: ti.f32,
) -> ti.math.ivec2:  # fmt: skip
    """Cells of a row that the sphere around a point touches: the first, and the one after the last, from its own."""
    cell_size = 1.0 / inverse_cell_size
    y_in_cell = point[1] - origin[1] - cell[1] * cell_size
    z_in_cell = point[2] - origin[2] - cell[2] * cell_size
    gap_y = ti.max(ti.max(dy * cell_size - y_in_cell, y_in_cell - (dy + 1) * cell_size), 0.0)
    gap_z = ti.max(ti.max(dz * cell_size - z_in_cell, z_in_cell - (dz + 1) * cell_size), 0.0)
    touched = ti.math.ivec2(0)
    half_width_squared = radius_squared - gap_y * gap_y - gap_z * gap_z
    if half_width_squared > 0.0:
        half_width = ti.sqrt(half_width_squared)
        left = ti.cast(ti.floor((point[0] - half_width - origin[0]) * inverse_cell_size), ti.i32) - cell[0]
        right = ti.cast(ti.floor((point[0] + half_width - origin[0]) * inverse_cell_size), ti.i32) - cell[0]
        # Never right of the cell, nor left of it; said for a particle at NaN, which becomes any integer.
        touched[0] = ti.max(ti.min(left, 0), -reach)
        touched[1] = ti.min(ti.max(right, 0), reach) + 1
    return touched


@ti.func
def count_near(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, cell_start: Integers, cell: Cells,
    origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius_squared: ti.f32,
    on_gpu: ti.template(),
) -> ti.i32:  # fmt: skip
    """Points within the radius; without a branch on the distance, so that it becomes vector code.

    A CPU reads whole rows of cells: loops of uneven length cost it more than the points that they leave out.
    """
    near = 0
    for dz in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            row = row_of_cell(cell, dy, dz, shape)
            touched = ti.math.ivec2(-reach, reach + 1)
            if ti.static(on_gpu):
                touched = cells_in_reach(point, cell, dy, dz, origin, inverse_cell_size, reach, radius_squared)
            for j in range(cell_start[row + touched[0]], cell_start[row + touched[1]]):
                d_x, d_y, d_z = point[0] - x[j], point[1] - y[j], point[2] - z[j]
                near += ti.cast(d_x * d_x + d_y * d_y + d_z * d_z < radius_squared, ti.i32)
    return near


@ti.func
def count_neighbors(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius: ti.f32,
    on_gpu: ti.template(), fluid_count: Integers, boundary_count: Integers,
):  # fmt: skip
    """How many neighbours each particle may have, itself included, and how many boundary samples.

    The radius is a little larger than that of the list: there a distance may be rounded differently.
    """
    radius_squared = radius * radius * (1.0 + ROUNDING_MARGIN)
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = ti.math.vec3(x[i], y[i], z[i])
        cell = cell_of_point(x_i, origin, inverse_cell_size, shape, reach)
        fluid_count[i] = count_near(
            x_i, x, y, z, cell_start, cell, origin, inverse_cell_size, shape, reach, radius_squared, on_gpu
        )
        boundary_near = count_near(
            x_i, fixed_x, fixed_y, fixed_z, fixed_cell_start,
            cell, origin, inverse_cell_size, shape, reach, radius_squared, on_gpu,
        )  # fmt: skip
        if ti.static(with_moving):
            boundary_near += count_near(
                x_i, moving_x, moving_y, moving_z, moving_cell_start,
                cell, origin, inverse_cell_size, shape, reach, radius_squared, on_gpu,
            )  # fmt: skip
        boundary_count[i] = boundary_near


@fast_launch
@ti.kernel
def measure_lists(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius: ti.f32,
    on_gpu: ti.template(), fluid_count: Integers, boundary_count: Integers, stride: ti.i32, slices: ti.i32,
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
        count, origin, inverse_cell_size, shape, reach, radius, on_gpu, fluid_count, boundary_count,
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
def list_range(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, first: ti.i32, last: ti.i32,
    own: ti.i32, radius_squared: ti.f32, start: ti.i32, found: ti.i32, stride: ti.i32, indices: Integers,
) -> ti.i32:  # fmt: skip
    """Append the points of a range within the radius, but `own`; returns how many there are now.

    Every candidate is written, and the place moves on only for those inside: a CPU would mispredict a branch for every
    third candidate.
    """
    n = found
    for j in range(first, last):
        d_x, d_y, d_z = point[0] - x[j], point[1] - y[j], point[2] - z[j]
        inside = ti.cast(d_x * d_x + d_y * d_y + d_z * d_z < radius_squared, ti.i32) & ti.cast(j != own, ti.i32)
        indices[start + n * stride] = j
        n += inside
    return n


@ti.func
def list_range_by_masks(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, first: ti.i32, last: ti.i32,
    own: ti.i32, radius_squared: ti.f32, start: ti.i32, found: ti.i32, stride: ti.i32, indices: Integers,
) -> ti.i32:  # fmt: skip
    """As `list_range`, for a GPU: 32 candidates are tested without a branch before those inside are written."""
    n = found
    group = first
    while group < last:
        mask = mask_of_near(point, x, y, z, group, last, own, radius_squared)
        while mask != 0:
            k = ti.math.clz(mask)
            mask ^= 1 << (MASK_BITS - 1 - k)
            indices[start + n * stride] = group + k
            n += 1
        group += MASK_BITS
    return n


@ti.func
def list_row_by_row(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, cell_start: Integers, cell: Cells,
    origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius_squared: ti.f32,
    own: ti.i32, start: ti.i32, found: ti.i32, stride: ti.i32, on_gpu: ti.template(), indices: Integers,
) -> ti.i32:  # fmt: skip
    """Append the points within the radius, but `own`; returns how many entries there are now."""
    n = found
    for dz in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            touched = cells_in_reach(point, cell, dy, dz, origin, inverse_cell_size, reach, radius_squared)
            row = row_of_cell(cell, dy, dz, shape)
            first, last = cell_start[row + touched[0]], cell_start[row + touched[1]]
            if ti.static(on_gpu):
                n = list_range_by_masks(point, x, y, z, first, last, own, radius_squared, start, n, stride, indices)
            else:
                n = list_range(point, x, y, z, first, last, own, radius_squared, start, n, stride, indices)
    return n


@ti.func
def mask_of_near(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, first: ti.i32, last: ti.i32, own: ti.i32,
    radius_squared: ti.f32,
) -> ti.i32:  # fmt: skip
    """Which of the first 32 points of a range are within the radius, but `own`, from the highest bit down."""
    mask = 0
    for k in range(ti.min(last - first, MASK_BITS)):
        j = first + k
        d_x, d_y, d_z = point[0] - x[j], point[1] - y[j], point[2] - z[j]
        inside = ti.cast(d_x * d_x + d_y * d_y + d_z * d_z < radius_squared, ti.i32) & ti.cast(j != own, ti.i32)
        mask |= inside << (MASK_BITS - 1 - k)
    return mask


@ti.func
def list_in_step(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, cell_start: Integers, cell: Cells,
    origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius_squared: ti.f32,
    own: ti.i32, start: ti.i32, found: ti.i32, stride: ti.i32, indices: Integers,
) -> ti.i32:  # fmt: skip
    """As `list_row_by_row`, for a GPU: all candidates are tested before those within the radius are written.

    The threads of a warp, whose lists are interleaved, then write their first entries at one time and at neighbouring
    addresses, then their second ones, and so on; written as they are found, every entry is an access of its own. This
    pays from hundreds of neighbours on. Rows of more candidates than the masks hold take more than one turn.
    """
    width = ti.static(2 * reach + 1)
    n = found
    passed = 0
    while passed >= 0:
        masks = ti.Vector([0] * (MASKS_A_ROW * width * width))
        firsts = ti.Vector([0] * (width * width))
        entries = 0
        next_passed = -1
        for r in range(width * width):
            dy, dz = r % width - reach, r // width - reach
            touched = cells_in_reach(point, cell, dy, dz, origin, inverse_cell_size, reach, radius_squared)
            row = row_of_cell(cell, dy, dz, shape)
            first, last = cell_start[row + touched[0]] + passed, cell_start[row + touched[1]]
            firsts[r] = first
            for part in ti.static(range(MASKS_A_ROW)):
                mask = mask_of_near(point, x, y, z, first + part * MASK_BITS, last, own, radius_squared)
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
            indices[start + n * stride] = firsts[group // MASKS_A_ROW] + group % MASKS_A_ROW * MASK_BITS + k
            n += 1
        passed = next_passed
    return n


@ti.func
def list_near(
    point: ti.math.vec3, x: Floats, y: Floats, z: Floats, cell_start: Integers, cell: Cells,
    origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius_squared: ti.f32,
    own: ti.i32, start: ti.i32, found: ti.i32, stride: ti.i32, on_gpu: ti.template(), indices: Integers,
) -> ti.i32:  # fmt: skip
    """Append the points within the radius, but `own`; returns how many entries there are now."""
    n = found
    if ti.static(on_gpu and reach > 1):
        n = list_in_step(
            point, x, y, z, cell_start, cell, origin, inverse_cell_size, shape, reach, radius_squared,
            own, start, found, stride, indices,
        )  # fmt: skip
    else:
        n = list_row_by_row(
            point, x, y, z, cell_start, cell, origin, inverse_cell_size, shape, reach, radius_squared,
            own, start, found, stride, on_gpu, indices,
        )  # fmt: skip
    return n


@fast_launch
@ti.kernel
def list_neighbors(
    x: Floats, y: Floats, z: Floats, cell_start: Integers,
    fixed_x: Floats, fixed_y: Floats, fixed_z: Floats, fixed_cell_start: Integers,
    moving_x: Floats, moving_y: Floats, moving_z: Floats, moving_cell_start: Integers, with_moving: ti.template(),
    count: ti.i32, origin: ti.math.vec3, inverse_cell_size: ti.f32, shape: Cells, reach: ti.template(), radius: ti.f32,
    on_gpu: ti.template(), moving_index: Integers, slice_start: Integers, stride: ti.i32,
    start: Integers, fluid_count: Integers, boundary_count: Integers, indices: Integers,
):  # fmt: skip
    """Write the neighbours of each particle; `boundary_count` holds an upper bound of its boundary samples before.

    Candidates are those of the rows of cells, as far along x as the sphere reaches into the row.
    """
    radius_squared = radius * radius
    ti.loop_config(block_dim=128)
    for i in range(count):
        x_i = ti.math.vec3(x[i], y[i], z[i])
        cell = cell_of_point(x_i, origin, inverse_cell_size, shape, reach)
        first = slice_start[i // stride] + i % stride
        fluid_found = list_near(
            x_i, x, y, z, cell_start, cell, origin, inverse_cell_size, shape, reach, radius_squared,
            i, first, 0, stride, on_gpu, indices,
        )  # fmt: skip
        found = fluid_found
        if boundary_count[i] > 0:
            found = list_near(
                x_i, fixed_x, fixed_y, fixed_z, fixed_cell_start,
                cell, origin, inverse_cell_size, shape, reach, radius_squared,
                -1, first, fluid_found, stride, on_gpu, indices,
            )  # fmt: skip
            if ti.static(with_moving):
                fixed_found = found
                found = list_near(
                    x_i, moving_x, moving_y, moving_z, moving_cell_start,
                    cell, origin, inverse_cell_size, shape, reach, radius_squared,
                    -1, first, fixed_found, stride, on_gpu, indices,
                )  # fmt: skip
                for k in range(fixed_found, found):
                    place = first + k * stride
                    indices[place] = moving_index[indices[place]]
        start[i] = first
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
