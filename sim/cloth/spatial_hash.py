"""Spheres sorted into the cells of an unbounded grid, whose cells share a table of fixed size.

The cells of a row along x lie next to each other in the table (modulo its size), so that the three cells of a row
which a search visits are one range, or two where the table ends. Teschner et al. 2003 hash every cell apart.
"""

import taichi as ti

from sim.arrays import Integers
from sim.launch import fast_launch
from sim.scan import scan_in_parallel, scan_scratch_length

Spheres = ti.types.ndarray(dtype=ti.math.vec4, ndim=1)
Cell = ti.types.vector(3, ti.i32)

SLOTS_PER_SPHERE = 2
"""Size of the table over the number of spheres, at least: few rows then share their slots."""


class SpatialHash:
    """Sorts spheres by the cell of their centre; the order within a slot of the table is arbitrary.

    Attributes:
        spheres: the sorted spheres, centre and radius [m], (capacity,) of 4-vectors.
        index: number before the sort of each sorted sphere, (capacity,).
        slot_start: first sorted sphere of each slot, (slots + 1,).
        mask: number of slots, a power of two, minus one.
    """

    def __init__(self, capacity: int) -> None:
        slots = 1 << max(SLOTS_PER_SPHERE * capacity - 1, 3).bit_length()
        self.mask = slots - 1
        self.spheres = ti.Vector.ndarray(4, ti.f32, max(capacity, 1))
        self.index = ti.ndarray(ti.i32, max(capacity, 1))
        self.slot_start = ti.ndarray(ti.i32, slots + 1)
        self._cursor = ti.ndarray(ti.i32, slots)
        self._scratch = ti.ndarray(ti.i32, scan_scratch_length(slots))

    def sort(self, spheres: ti.Ndarray, count: int, cell_size: float) -> None:
        """Sort the first `count` spheres.

        Args:
            spheres: centre and radius [m], at least (count,) of 4-vectors.
            count: number of spheres.
            cell_size: edge of a cell, at least the distance at which centres are searched for [m].
        """
        sort_spheres(
            spheres, count, 1.0 / cell_size, self.mask,
            self._cursor, self._scratch, self.slot_start, self.spheres, self.index,
        )  # fmt: skip


@ti.func
def cell_of(sphere: ti.math.vec4, inverse_cell_size: ti.f32) -> Cell:
    """The cell of a sphere's centre."""
    return ti.cast(ti.floor(sphere.xyz * inverse_cell_size), ti.i32)


@ti.func
def slot_of(x: ti.i32, y: ti.i32, z: ti.i32, mask: ti.i32) -> ti.i32:
    """Slot of a cell; the next cell along x has the next slot."""
    return (x + ((y * 73856093) ^ (z * 19349663))) & mask


@fast_launch
@ti.kernel
def sort_spheres(
    spheres: Spheres, count: ti.i32, inverse_cell_size: ti.f32, mask: ti.i32,
    cursor: Integers, scratch: Integers, slot_start: Integers, result: Spheres, index: Integers,
):  # fmt: skip
    """Count the spheres of each slot, sum the counts up, and put the spheres of a slot next to each other."""
    for slot in range(mask + 1):
        cursor[slot] = 0
    for k in range(count):
        cell = cell_of(spheres[k], inverse_cell_size)
        ti.atomic_add(cursor[slot_of(cell[0], cell[1], cell[2], mask)], 1)
    scan_in_parallel(cursor, mask + 1, scratch, slot_start)
    for slot in range(mask + 1):
        cursor[slot] = slot_start[slot]
    for k in range(count):
        cell = cell_of(spheres[k], inverse_cell_size)
        place = ti.atomic_add(cursor[slot_of(cell[0], cell[1], cell[2], mask)], 1)
        result[place] = spheres[k]
        index[place] = k
