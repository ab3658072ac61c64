"""Copies of small arrays between the host and the device, in every substep.

Taichi copies an array by a kernel, and waits for it: 0.2 ms however small it is. On a CPU the memory is the host's own;
with CUDA the driver copies, in 0.01 ms, in the order of the launches (docs/decisions/0049-launches-of-small-scenes.md).
This relies on Taichi's internals, as `sim.core.launch` does.
"""

import ctypes
import math
import threading

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang import impl
from taichi.lang.util import to_numpy_type

from sim.core.cuda_driver import ask
from sim.core.reductions import runs_on_gpu

_threads = threading.local()
"""Whether a thread has launched a kernel, since which Taichi's context is the current one in it."""


def put(array: ti.Ndarray, values: NDArray[np.generic]) -> None:
    """Fill an array with numbers of its shape, vectors and matrices along the last axes, converted to its type."""
    kind, shape = _layout(array)
    if values.shape != shape:
        raise ValueError(f"an array of shape {shape} cannot be filled with one of shape {values.shape}")
    if not runs_on_gpu():
        _memory(array)[...] = values
        return
    own = np.ascontiguousarray(values, dtype=kind)
    if _driver_copies():
        # Memory that can be swapped out is read before the call returns.
        _ask_driver("cuMemcpyHtoDAsync_v2", _address(array), ctypes.c_void_p(own.ctypes.data), own.nbytes)
    else:
        array.from_numpy(own)


def take(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array, which becomes 0."""
    values = copied(array)
    if not runs_on_gpu():
        _memory(array).fill(0)
    elif _driver_copies():
        _ask_driver("cuMemsetD8Async", _address(array), ctypes.c_ubyte(0), values.nbytes)
    else:
        array.fill(0)
    return values


def viewed(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array: its own memory on a CPU, a copy elsewhere."""
    return copied(array) if runs_on_gpu() else _memory(array)


def put_rows(array: ti.Ndarray, rows: NDArray[np.integer], new: NDArray[np.floating]) -> None:
    """Put numbers into rows of an array."""
    values = viewed(array)
    values[rows] = new
    if runs_on_gpu():
        put(array, values)


def add(array: ti.Ndarray, rows: slice | NDArray[np.integer], change: NDArray[np.floating]) -> None:
    """Add to rows of an array."""
    values = viewed(array)
    values[rows] += change.astype(values.dtype)
    if runs_on_gpu():
        put(array, values)


def copied(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array, vectors and matrices along the last axes; waits for the device."""
    if not runs_on_gpu():
        return _memory(array).copy()
    if not _driver_copies():
        return array.to_numpy()
    kind, shape = _layout(array)
    values = np.empty(shape, kind)
    _ask_driver("cuMemcpyDtoHAsync_v2", ctypes.c_void_p(values.ctypes.data), _address(array), values.nbytes)
    impl.get_runtime().prog.synchronize()
    return values


def _layout(array: ti.Ndarray) -> tuple[np.dtype[np.generic], tuple[int, ...]]:
    """Type and shape of the numbers of an array, which it never changes, and keeps from the first time on."""
    try:
        known: tuple[np.dtype[np.generic], tuple[int, ...]] = array.layout_of_numbers
    except AttributeError:
        known = np.dtype(to_numpy_type(array.dtype)), (*array.shape, *array.element_shape)
        array.layout_of_numbers = known
    return known


def _address(array: ti.Ndarray) -> ctypes.c_uint64:
    return ctypes.c_uint64(impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


def _driver_copies() -> bool:
    """Whether the driver can copy in this thread; the first copy of each is Taichi's, which takes its context there."""
    if impl.current_cfg().arch != ti.cuda:
        return False
    knows_context = getattr(_threads, "has_copied", False)
    _threads.has_copied = True
    return knows_context


def _ask_driver(function: str, *arguments: ctypes.c_uint64 | ctypes.c_void_p | ctypes.c_ubyte | int) -> None:
    """Put a copy behind the launches that were asked for, in the stream that Taichi uses."""
    *others, size = arguments
    ask(function, *others, ctypes.c_size_t(size), None)


def _memory(array: ti.Ndarray) -> NDArray[np.generic]:
    """The memory of an array on a CPU, which stays as long as it is looked at; what it holds may be anything later."""
    kind, shape = _layout(array)
    memory = (ctypes.c_char * (math.prod(shape) * kind.itemsize)).from_address(_address(array).value)
    memory.owner = array  # type: ignore[attr-defined]
    return np.frombuffer(memory, dtype=kind).reshape(shape)
