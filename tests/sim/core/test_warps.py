import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers, LongIntegers
from sim.core.launch import kernel
from sim.core.warps import WARP, add_to, largest_in_warp, raise_to, whole_warps


@kernel
def gather(values: Floats, kinds: Integers, count: ti.i32, sums: LongIntegers, largest: Floats):
    """The largest value of every 32, and the sum of all in units of 1, by the largest kind among those."""
    end = whole_warps(count)
    for i in range(end):
        value, kind = -1.0e30, -1
        if i < count:
            value, kind = values[i], kinds[i]
        raise_to(largest, i // WARP, value, i, WARP)
        common = largest_in_warp(kind)
        add_to(sums, common, ti.select(i < count, ti.round(value, ti.i64), ti.cast(0, ti.i64)), i)


def test_warps_find_the_largest_and_sum_up_as_their_threads_would(taichi_cpu):
    count = 3 * WARP + 5
    generator = np.random.default_rng(0)
    numbers = generator.normal(0.0, 1.0e12, count).astype(np.float32)
    kinds = np.arange(count) // WARP
    values, of = ti.ndarray(ti.f32, count), ti.ndarray(ti.i32, count)
    values.from_numpy(numbers)
    of.from_numpy(kinds.astype(np.int32))
    sums, largest = ti.ndarray(ti.i64, 4), ti.ndarray(ti.f32, 4)
    largest.fill(-1.0e30)
    sums.fill(0)
    gather(values, of, count, sums, largest)
    np.testing.assert_array_equal(largest.to_numpy(), [numbers[kinds == kind].max() for kind in range(4)])
    np.testing.assert_array_equal(sums.to_numpy(), [numbers[kinds == kind].astype(np.int64).sum() for kind in range(4)])
