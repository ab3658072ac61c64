"""Numbers from the host into arrays of the device, and back."""

import numpy as np
import pytest
import taichi as ti

from sim.core.host_access import put, take


def test_what_is_put_is_what_taichi_reads_and_what_is_taken_leaves_zeros(taichi_cpu):
    matrices = ti.Matrix.ndarray(3, 3, ti.f32, 2)
    values = np.arange(18, dtype=np.float64).reshape(2, 3, 3) / 7.0
    put(matrices, values)
    np.testing.assert_array_equal(matrices.to_numpy(), values.astype(np.float32))
    vectors = ti.Vector.ndarray(3, ti.f32, 4)
    vectors.from_numpy(np.ones((4, 3), np.float32))
    np.testing.assert_array_equal(take(vectors), np.ones((4, 3), np.float32))
    assert not vectors.to_numpy().any()
    sums = ti.ndarray(ti.i64, 6)
    sums.from_numpy(np.arange(6) * 10**12)
    np.testing.assert_array_equal(take(sums), np.arange(6) * 10**12)


def test_numbers_of_another_shape_are_refused(taichi_cpu):
    with pytest.raises(ValueError, match="shape"):
        put(ti.Vector.ndarray(3, ti.f32, 4), np.zeros((1, 3)))
