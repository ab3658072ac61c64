"""Reductions and tests whose result does not depend on the order in which threads run.

Sums of floating-point numbers depend on their order, so none is done with atomics here; maxima of non-negative
numbers do not, and are.
"""

import taichi as ti


@ti.func
def is_finite(value: ti.f32) -> ti.i32:
    """Whether a number is neither NaN nor infinite; looks at the bits, as `fast_math` folds `x != x` to false."""
    return ti.cast((ti.bit_cast(value, ti.i32) & 0x7F800000) != 0x7F800000, ti.i32)


@ti.kernel
def sum_integers(values: ti.types.ndarray(dtype=ti.i32, ndim=1)) -> ti.i32:
    """Sum of integers, exact in any order."""
    total = 0
    for i in range(values.shape[0]):
        total += values[i]
    return total
