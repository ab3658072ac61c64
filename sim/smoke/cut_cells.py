"""Cut cells: how much of each cell, and of each of its faces, solids leave to the air (Ng, Min & Gibou 2009).

Solids are known by their signed distances at the corners of cells. Between corners, the middles of faces and those of
cells, which have the means of their corners, the distance is linear: a cell is 24 tetrahedra, a face four triangles,
and their parts outside of the solids are exact where a surface is plane. Both follow a solid that moves without jumps.

Two kinds of cells are closed as a whole:

* *Split* ones, whose corners in the air are not connected along the edges of the cell: a wall runs through, and a cell
  has one pressure and one smoke. A wall of normal n and thickness d, at least cell_size * max |n_i|, has a point of
  every edge that crosses it, so that cells of its two sides never touch through an open face.
* Those of which less than `LEAST_VOLUME` is open and that have no open face to one with more: what flows through
  them in a step is more than they hold. All others below it share what they hold with the
  largest neighbour, their *keeper*.
"""

import taichi as ti

from sim.core.arrays import Floats, Integers
from sim.core.bundles import func
from sim.core.launch import kernel
from sim.smoke.lanes import Grid, cell_counts, lane_items, lane_place, row_start, steps

FAR = 2.0  # distances from solids count up to here [cells]
ROUNDING = 2.0**-13  # distances below this are 0 [cells]: a solid that ends where cells do cuts none
LEAST_VOLUME = 0.125  # of a cell that holds its smoke alone: whatever way a plane turns, some neighbour has a sixth

# What a cell has to do with smaller ones, by the lowest bits of its word: 1 .. 6 is the direction of its own keeper.
ALONE, KEEPER = 0, 7
NEAR_SOLIDS = 8  # bit of a word: less than all of the cell or of a neighbour is open
CHANGES = 16  # bit of a word: the open part of the cell or of a neighbour has just changed


@ti.pyfunc
def is_split(outside: ti.template()):
    """Whether corners of a cell, a bit each (4 dx + 2 dy + dz), are not connected along its edges; also in kernels."""
    reached = outside & -outside
    for _ in range(4):  # a way along edges between two of eight corners that has no shortcut has four at most
        along_z = ((reached & 0x55) << 1) | ((reached & 0xAA) >> 1)
        along_y = ((reached & 0x33) << 2) | ((reached & 0xCC) >> 2)
        along_x = ((reached & 0x0F) << 4) | ((reached & 0xF0) >> 4)
        reached = (reached | along_z | along_y | along_x) & outside
    return reached != outside


@func
def _sorted(a: ti.f32, b: ti.f32, c: ti.f32, d: ti.f32):
    low, p, q, high = ti.min(a, b), ti.max(a, b), ti.min(c, d), ti.max(c, d)
    low, q = ti.min(low, q), ti.max(low, q)
    p, high = ti.min(p, high), ti.max(p, high)
    return low, ti.min(p, q), ti.max(p, q), high


@func
def _mean(a: ti.f32, b: ti.f32, c: ti.f32, d: ti.f32) -> ti.f32:
    """The same to the bit in whatever order, however a compiler orders sums."""
    low, p, q, high = _sorted(a, b, c, d)
    return 0.25 * ((low + high) + (p + q))


@func
def _open_triangle(a: ti.f32, b: ti.f32, c: ti.f32) -> ti.f32:
    """Part of a triangle on which a linear function with these values at its corners is positive."""
    low, high = ti.min(a, ti.min(b, c)), ti.max(a, ti.max(b, c))
    middle = ti.max(ti.min(a, b), ti.min(ti.max(a, b), c))
    part = 1.0
    if high <= 0.0:
        part = 0.0
    elif middle <= 0.0:
        part = high / (high - low) * (high / (high - middle))
    elif low <= 0.0:
        part = 1.0 - low / (low - middle) * (low / (low - high))
    return part


@func
def _open_tetrahedron(a: ti.f32, b: ti.f32, c: ti.f32, d: ti.f32) -> ti.f32:
    """Part of a tetrahedron in which a linear function with these values at its corners is positive."""
    low, p, q, high = _sorted(a, b, c, d)
    part = 1.0
    if high <= 0.0:
        part = 0.0
    elif q <= 0.0:
        part = high / (high - low) * (high / (high - p)) * (high / (high - q))
    elif p <= 0.0:
        low_q, low_high = low / (low - q), low / (low - high)
        p_q, p_high = p / (p - q), p / (p - high)
        part = 1.0 - (low_q * low_high + (1.0 - low_q) * low_high * p_q + (1.0 - low_high) * p_q * p_high)
    elif low <= 0.0:
        part = 1.0 - low / (low - p) * (low / (low - q)) * (low / (low - high))
    return part


@func
def open_area(distance: Floats, at: ti.i32, first: ti.i32, second: ti.i32) -> ti.f32:
    """Open part of a face whose lowest corner is at an index, with the steps to the others."""
    a, b, c, d = distance[at], distance[at + first], distance[at + second], distance[at + first + second]
    area = 1.0
    if ti.min(ti.min(a, b), ti.min(c, d)) <= 0.0:
        area = 0.0
        if ti.max(ti.max(a, b), ti.max(c, d)) > 0.0:
            middle = _mean(a, b, c, d)
            low, high = _open_triangle(middle, a, b), _open_triangle(middle, c, d)
            area = _mean(low, high, _open_triangle(middle, a, c), _open_triangle(middle, b, d))
    return area


@func
def open_volume(distance: Floats, at: ti.i32, step_x: ti.i32, step_y: ti.i32) -> ti.f32:
    """Open part of the cell whose lowest corner is at an index; 0 if it is split."""
    low, high, outside = distance[at], distance[at], 0
    for dx, dy in ti.static(ti.ndrange(2, 2)):
        here = at + dx * step_x + dy * step_y
        below, above = distance[here], distance[here + 1]
        low, high = ti.min(low, ti.min(below, above)), ti.max(high, ti.max(below, above))
        outside |= (int(below > 0.0) << ti.static(4 * dx + 2 * dy)) | (
            int(above > 0.0) << ti.static(4 * dx + 2 * dy + 1)
        )
    volume = 1.0
    if low <= 0.0:
        volume = 0.0
        if high > 0.0 and not is_split(outside):
            for axis in range(3):
                along = ti.select(axis == 0, step_x, ti.select(axis == 1, step_y, 1))
                first = ti.select(axis == 0, step_y, step_x)
                second = ti.select(axis == 2, step_y, 1)
                below = _open_pyramid(distance, at, along, first, second, 0)
                above = _open_pyramid(distance, at, along, first, second, 1)
                volume += ti.min(below, above) + ti.max(below, above)
            volume /= 6.0
    return volume


@func
def _open_pyramid(distance: Floats, at: ti.i32, along: ti.i32, first: ti.i32, second: ti.i32, side: ti.i32) -> ti.f32:
    """Open part of the sixth of a cell between its middle and one of its faces."""
    face, beyond = at + side * along, at + (1 - side) * along
    a, b, c, d = distance[face], distance[face + first], distance[face + second], distance[face + first + second]
    top, diagonal = _mean(a, b, c, d), beyond + first + second
    other = _mean(distance[beyond], distance[beyond + first], distance[beyond + second], distance[diagonal])
    middle = 0.5 * (ti.min(top, other) + ti.max(top, other))
    return _mean(
        _open_tetrahedron(middle, top, a, b),
        _open_tetrahedron(middle, top, c, d),
        _open_tetrahedron(middle, top, a, c),
        _open_tetrahedron(middle, top, b, d),
    )


@func
def way(box: Grid, direction: ti.i32) -> ti.i32:
    """To the neighbour in one of six directions, -x, +x, -y, .. in flat arrays."""
    return steps(box)[direction // 2] * (2 * (direction % 2) - 1)


@func
def keeper_of(word: ti.i32, at: ti.i32, box: Grid) -> ti.i32:
    """The cell that keeps what a cell of this word holds: it does itself unless it is small."""
    code, keeper = word & 7, at
    if code > ALONE and code < KEEPER:
        keeper += way(box, code - 1)
    return keeper


@kernel
def measure_volumes(box: Grid, distance: Floats, volume: Floats, before: Floats):
    """Set the open parts of all cells, and leave the former ones in `before`."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            before[at] = volume[at]
            volume[at] = open_volume(distance, at, box.step_x, box.step_y)


@kernel
def find_keepers(
    box: Grid,
    distance: Floats,
    distance_before: Floats,
    volume: Floats,
    before: Floats,
    words: Integers,
    moving: ti.template(),
):
    """Find who keeps what small cells hold, those that have just been covered among them; close those without."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            k = lane_place(box, n, lane)
            at, here = row_start(box, i, j) + k, ti.Vector([i, j, k])
            word = ALONE
            is_kept = volume[at] > 0.0
            if ti.static(moving):
                is_kept = is_kept or before[at] > 0.0
            if volume[at] < LEAST_VOLUME and is_kept:
                largest, largest_before, word_before = 0.0, 0.0, ALONE
                for direction in ti.static(range(6)):
                    axis, upward = ti.static(direction // 2, direction % 2)
                    first, second = ti.static(((1, 2), (0, 2), (0, 1))[direction // 2])
                    there, face = at + way(box, direction), at + upward * steps(box)[axis]
                    is_inside = (here[axis] < cell_counts(box)[axis]) if ti.static(upward == 1) else (here[axis] > 1)
                    # Others may close `there` meanwhile, but only where it is small.
                    if is_inside and volume[there] >= LEAST_VOLUME:
                        along, across = steps(box)[first], steps(box)[second]
                        if volume[there] > largest and open_area(distance, face, along, across) > 0.0:
                            largest, word = volume[there], direction + 1
                        if ti.static(moving):
                            was_air = before[at] > 0.0 and before[there] > 0.0 and volume[there] > largest_before
                            if was_air and open_area(distance_before, face, along, across) > 0.0:
                                largest_before, word_before = volume[there], direction + 1
                # What is open now depends on what is now alone.
                if word == ALONE or volume[at] == 0.0:
                    volume[at], word = 0.0, word_before
            words[at] = word


@kernel
def mark_keepers(box: Grid, volume: Floats, before: Floats, words: Integers):
    """Mark the cells that keep what others hold, and those near solids and near solids that move."""
    for i, j, lane in ti.ndrange((1, box.nx + 1), (1, box.ny + 1), box.lanes):
        for n in range(lane_items(box, box.nz, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            # Ghosts are whole. Others only add what is not looked at here.
            is_near, is_keeper, changes = volume[at] < 1.0, False, volume[at] != before[at]
            for direction in ti.static(range(6)):
                there = at + way(box, direction)
                is_near = is_near or volume[there] < 1.0
                changes = changes or volume[there] != before[there]
                is_keeper = is_keeper or (words[there] & 7) == ti.static((direction ^ 1) + 1)
            word = ti.select(is_keeper, KEEPER, 0) | ti.select(is_near, NEAR_SOLIDS, 0) | ti.select(changes, CHANGES, 0)
            words[at] |= word


@kernel
def measure_areas(
    axis: ti.template(),
    box: Grid,
    distance: Floats,
    distance_before: Floats,
    volume: Floats,
    before: Floats,
    area: Floats,
    moving: ti.template(),
):
    """Set the open parts of the faces across an axis: where solids move the means of before and after."""
    extra_x, extra_y, extra_z = ti.static(int(axis == 0), int(axis == 1), int(axis == 2))
    for i, j, lane in ti.ndrange((1, box.nx + 1 + extra_x), (1, box.ny + 1 + extra_y), box.lanes):
        for n in range(lane_items(box, box.nz + extra_z, lane)):
            at = row_start(box, i, j) + lane_place(box, n, lane)
            part = _area_between(axis, box, distance, volume, at)
            if ti.static(moving):
                part = 0.5 * (part + _area_between(axis, box, distance_before, before, at))
            area[at] = part


@func
def _area_between(axis: ti.template(), box: Grid, distance: Floats, volume: Floats, at: ti.i32) -> ti.f32:
    """Open part of the face before the p-th cell along an axis; none beside a cell that is closed."""
    first, second = ti.static(((1, 2), (0, 2), (0, 1))[axis])
    part = open_area(distance, at, steps(box)[first], steps(box)[second])
    # Ghosts are whole.
    is_open = volume[at] > 0.0 and volume[at - steps(box)[axis]] > 0.0
    return ti.select(is_open, part, 0.0)
