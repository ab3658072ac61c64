import numpy as np
import pytest
import taichi as ti

from sim.core.scan import LEVELS, RUN, exclusive_scan, scan_scratch_length

TREE = RUN**LEVELS


@pytest.mark.parametrize("length", [1, RUN - 1, RUN, RUN + 1, RUN**2, RUN**2 + 1, TREE, TREE + 1, 3 * TREE + 5])
def test_exclusive_scan_equals_numpy(taichi_cpu, length):
    numbers = np.random.default_rng(length).integers(0, 9, length).astype(np.int32)
    values, scratch = ti.ndarray(ti.i32, length), ti.ndarray(ti.i32, scan_scratch_length(length))
    values.from_numpy(numbers)
    result = ti.ndarray(ti.i32, length + 1)
    total = exclusive_scan(values, length, scratch, result)
    np.testing.assert_array_equal(result.to_numpy(), np.concatenate([[0], np.cumsum(numbers)]))
    assert total == numbers.sum()
    np.testing.assert_array_equal(values.to_numpy(), numbers)
