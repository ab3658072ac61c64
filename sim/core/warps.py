"""What the threads of a warp, which a GPU runs as one, do together with CUDA, and each for itself elsewhere.

Atomic operations on one number are done one after the other: 300,000 of 64 bits take 0.2 ms of an H200, and those on
floats, which are tried until nobody has come between, more. So a warp makes one of those of its threads.

All threads of a warp have to call these, in a loop from 0 on of `whole_warps` items or of a multiple of `WARP`.
"""

import taichi as ti
from taichi.lang import impl

from sim.core.arrays import Floats, LongIntegers

WARP = 32


def on_cuda() -> bool:
    """Whether threads can do so."""
    return bool(impl.current_cfg().arch == ti.cuda)


@ti.func
def whole_warps(count: ti.i32) -> ti.i32:
    """Items of a loop of so many, and as many more as it takes for whole warps."""
    if ti.static(on_cuda()):
        count = (count + WARP - 1) // WARP * WARP
    return count


@ti.func
def raise_to(values: Floats, place: ti.i32, least: ti.f32, lane: ti.i32, lanes: ti.template()):
    """Let a value be this at least; so many neighbouring threads of a warp, a power of two, name the same place."""
    if ti.static(on_cuda()):
        for step in ti.static([step for step in (16, 8, 4, 2, 1) if step < lanes]):
            least = ti.max(least, ti.simt.warp.shfl_down_f32(ti.u32(0xFFFFFFFF), least, step))
        if lane % lanes == 0 and least > values[place]:
            ti.atomic_max(values[place], least)
    elif least > values[place]:
        ti.atomic_max(values[place], least)


@ti.func
def largest_in_warp(value: ti.i32) -> ti.i32:
    """Of all threads, for each of them."""
    if ti.static(on_cuda()):
        for step in ti.static((16, 8, 4, 2, 1)):
            value = ti.max(value, ti.simt.warp.shfl_xor_i32(ti.u32(0xFFFFFFFF), value, step))
    return value


@ti.func
def add_to(sums: LongIntegers, place: ti.i32, summand: ti.i64, item: ti.i32):
    """Add what each thread has to a sum; all threads of a warp name the same place."""
    if ti.static(on_cuda()):
        for step in ti.static((16, 8, 4, 2, 1)):
            low = ti.simt.warp.shfl_down_i32(ti.u32(0xFFFFFFFF), ti.cast(summand, ti.i32), step)
            high = ti.simt.warp.shfl_down_i32(ti.u32(0xFFFFFFFF), ti.cast(summand >> 32, ti.i32), step)
            summand += (ti.cast(high, ti.i64) << 32) + ti.cast(ti.bit_cast(low, ti.u32), ti.i64)
    if (ti.static(not on_cuda()) or item % WARP == 0) and summand != 0:
        ti.atomic_add(sums[place], summand)
