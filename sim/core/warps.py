"""What the threads of a warp, which a GPU runs as one, do together with CUDA, and each for itself elsewhere.

Atomic operations on one number are done one after the other, those on floats tried until nobody has come between. So a
warp makes one of those of its threads. All of them have to call this, in a loop from 0 on of a multiple of `WARP`.
"""

import taichi as ti
from taichi.lang import impl

from sim.core.arrays import Floats

WARP = 32


def on_cuda() -> bool:
    """Whether threads can do so."""
    return bool(impl.current_cfg().arch == ti.cuda)


@ti.func
def raise_to(values: Floats, place: ti.i32, least: ti.f32, lane: ti.i32):
    """Let a value be this at least; all threads of a warp name the same place."""
    if ti.static(on_cuda()):
        for step in ti.static((16, 8, 4, 2, 1)):
            least = ti.max(least, ti.simt.warp.shfl_down_f32(ti.u32(0xFFFFFFFF), least, step))
        if lane % WARP == 0 and least > values[place]:
            ti.atomic_max(values[place], least)
    elif least > values[place]:
        ti.atomic_max(values[place], least)
