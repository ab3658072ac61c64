"""Types of what kernels of rigid bodies work in: float64, as bodies at rest move by less than float32 tells."""

import taichi as ti

Vector3 = ti.types.vector(3, ti.f64)
Numbers = ti.types.ndarray(dtype=ti.f64, ndim=1)
Rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)
WholeRows = ti.types.ndarray(dtype=ti.i32, ndim=2)
LongRows = ti.types.ndarray(dtype=ti.i64, ndim=2)
Velocities = ti.types.ndarray(dtype=ti.types.vector(6, ti.f64), ndim=1)  # v and omega, or impulse and its moment
Eases = ti.types.ndarray(dtype=ti.types.vector(7, ti.f64), ndim=1)  # see `ContactSystem.ease`
