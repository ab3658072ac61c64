"""Arrays on the device, and their types as kernels take them."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
LongIntegers = ti.types.ndarray(dtype=ti.i64, ndim=1)
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=ti.math.mat3, ndim=1)


def on_device(rows: NDArray[np.generic]) -> ti.Ndarray:
    """Device array of numbers (n,) or vectors (n, k), int32 or float32; one zero where n is 0, as kernels need one."""
    is_whole = np.issubdtype(rows.dtype, np.integer)
    filled = rows if len(rows) else np.zeros((1, *rows.shape[1:]))
    values = np.ascontiguousarray(filled, dtype=np.int32 if is_whole else np.float32)
    dtype = ti.i32 if is_whole else ti.f32
    array = ti.ndarray(dtype, len(values)) if rows.ndim == 1 else ti.Vector.ndarray(rows.shape[1], dtype, len(values))
    array.from_numpy(values)
    return array
