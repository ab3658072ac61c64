"""Threads of a CPU that take the parallel loops of kernels, in place of Taichi's.

Taichi's threads sleep between two loops, and so does the one that launches: a loop costs 40 to 70 us beyond its work,
and on a busy machine as long as it takes until the system lets the slowest of them run. Here the launching thread takes
tasks as all others do, which look for the next loop a while before they sleep: 1 us, and nobody is waited for who has
no task. They are machine code, as no Python may run there; LLVM makes it of `thread_pool.ll` when Taichi starts.
Measurements: docs/decisions/0065-own-threads.md.

This relies on Taichi's internals, as `sim.core.launch` does.
"""

import ctypes
import sys
import threading
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import taichi as ti
from taichi._lib import core as _ti_core
from taichi.lang import impl

from sim.core.cuda_launch import OTHER_LAYOUT, HostBuffers

LOOKS = 300  # for a loop, before a thread sleeps: some 100 us, which two launches are apart
PARALLEL_FOR = 8 * 1036  # where Taichi's runtime keeps what does parallel loops [bytes]
RUNTIME = 8  # where a launch has its runtime [bytes]


class _Place(ctypes.Structure):
    """Dl_info of dladdr(3): the library of an address."""

    _fields_ = (
        ("library", ctypes.c_char_p),
        ("base", ctypes.c_void_p),
        ("symbol", ctypes.c_char_p),
        ("address", ctypes.c_void_p),
    )


def take_over(threads: int) -> None:
    """Have so many threads, the launching one among them, take all parallel loops from now on; once, after `ti.init`.

    Raises:
        OSError: the system has no POSIX threads.
        RuntimeError: Taichi's runtime looks otherwise in memory than that of release 1.7.4.
    """
    prepare, serve, run = _machine_code("prepare", "serve", "run")
    place = _parallel_for_of(_runtime())
    ctypes.CFUNCTYPE(None)(prepare)()
    serving = ctypes.CFUNCTYPE(None, ctypes.c_int32, ctypes.c_int32)(serve)
    for thread in range(1, threads):
        threading.Thread(target=serving, args=(thread, LOOKS), name=f"loops-{thread}", daemon=True).start()
    place.value = run


def _machine_code(*functions: str) -> list[int]:
    """Addresses of these functions of `thread_pool.ll`, for as long as the process."""
    if sys.platform == "win32":
        raise OSError("Windows has no POSIX threads")
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = llvm.parse_assembly(Path(__file__).with_suffix(".ll").read_text("utf-8"))
    engine = llvm.create_mcjit_compiler(module, llvm.Target.from_default_triple().create_target_machine(opt=2))
    engine.finalize_object()
    addresses = [engine.get_function_address(function) for function in functions]
    engine.detach()  # nothing frees it: threads run its code until the process ends
    return addresses


@ti.kernel
def _nothing():
    pass


def _runtime() -> int:
    """Address of Taichi's runtime, which a launch notes."""
    program, primal = impl.get_runtime().prog, _nothing._primal
    kernel = primal.compiled_kernels[primal.ensure_compiled()]
    context = kernel.make_launch_context()
    program.launch_kernel(program.compile_kernel(program.config(), program.get_device_caps(), kernel), context)
    return ctypes.c_uint64.from_address(HostBuffers(context).read + RUNTIME).value


def _parallel_for_of(runtime: int) -> Any:
    """The pointer to what does parallel loops, which is a function of Taichi's library."""
    pointer = ctypes.c_uint64.from_address(runtime + PARALLEL_FOR)
    found = _Place()
    is_known = ctypes.CDLL(None).dladdr(ctypes.c_void_p(pointer.value), ctypes.byref(found))
    if not is_known or Path((found.library or b"").decode()) != Path(_ti_core.__file__):
        raise RuntimeError(OTHER_LAYOUT)
    return pointer
