"""Numbers from the host into arrays of the device, and back."""

import gc

import numpy as np
import pytest
import taichi as ti

from sim.core import host_access
from sim.core.host_access import add, put, take, viewed


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


@pytest.mark.parametrize("copies", [False, True], ids=["own memory", "copies, as on a GPU"])
def test_what_is_added_to_rows_is_seen_and_the_others_stay(taichi_cpu, monkeypatch, copies):
    monkeypatch.setattr(host_access, "runs_on_gpu", lambda: copies)
    vectors = ti.Vector.ndarray(3, ti.f32, 4)
    vectors.from_numpy(np.arange(12, dtype=np.float32).reshape(4, 3))
    add(vectors, slice(1, 3), np.array([0.5, 0.0, -0.5]))
    add(vectors, np.array([3]), np.array([[1.0, 2.0, 3.0]]))
    expected = np.arange(12, dtype=np.float32).reshape(4, 3)
    expected[1:3] += [0.5, 0.0, -0.5]
    expected[3] += [1.0, 2.0, 3.0]
    np.testing.assert_array_equal(vectors.to_numpy(), expected)
    np.testing.assert_array_equal(viewed(vectors), expected)
    assert np.shares_memory(viewed(vectors), viewed(vectors)) is not copies


def test_what_is_viewed_outlives_the_array(taichi_cpu):
    def ones():
        array = ti.ndarray(ti.f32, 1000)
        array.fill(1.0)
        return viewed(array)

    kept = ones()
    gc.collect()
    others = [ti.ndarray(ti.f32, 1000) for _ in range(20)]
    for other in others:
        other.fill(2.0)
    assert (kept == 1.0).all()
