import numpy as np
import taichi as ti

from sim.core.arrays import Floats
from sim.core.launch import kernel
from sim.core.warps import WARP, raise_to


@kernel
def gather(values: Floats, largest: Floats):
    """The largest value of every 32."""
    for i in range(values.shape[0]):
        raise_to(largest, i // WARP, values[i], i)


def test_warps_find_the_largest_as_their_threads_would(taichi_cpu):
    numbers = np.random.default_rng(0).normal(0.0, 1.0e12, (4, WARP)).astype(np.float32)
    values, largest = ti.ndarray(ti.f32, numbers.size), ti.ndarray(ti.f32, 4)
    values.from_numpy(numbers.ravel())
    largest.fill(-1.0e30)
    gather(values, largest)
    np.testing.assert_array_equal(largest.to_numpy(), numbers.max(axis=1))
