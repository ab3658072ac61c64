"""Types of the arrays that kernels take."""

import taichi as ti

Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
LongIntegers = ti.types.ndarray(dtype=ti.i64, ndim=1)
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Vectors = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=ti.math.mat3, ndim=1)
