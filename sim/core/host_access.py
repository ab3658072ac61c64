"""Copies of small arrays between the host and the device, in every substep.

Taichi copies an array by a kernel, which takes 0.2 ms however small it is. On a CPU the memory is the host's own.
This relies on Taichi's internals, as `sim.core.launch` does.
"""

import ctypes
import math

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang import impl
from taichi.lang.util import to_numpy_type

from sim.core.reductions import runs_on_gpu


def put(array: ti.Ndarray, values: NDArray[np.generic]) -> None:
    """Fill an array with numbers of its shape, vectors and matrices along the last axes, converted to its type."""
    if not runs_on_gpu():
        own = _memory(array)
        if values.shape != own.shape:
            raise ValueError(f"an array of shape {own.shape} cannot be filled with one of shape {values.shape}")
        own[...] = values
    else:
        array.from_numpy(np.ascontiguousarray(values, dtype=to_numpy_type(array.dtype)))


def take(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array, which becomes 0."""
    if not runs_on_gpu():
        own = _memory(array)
        values = own.copy()
        own.fill(0)
    else:
        values = array.to_numpy()
        array.fill(0)
    return values


def viewed(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array: its own memory on a CPU, a copy elsewhere."""
    return array.to_numpy() if runs_on_gpu() else _memory(array)


def add(array: ti.Ndarray, rows: slice | NDArray[np.integer], change: NDArray[np.floating]) -> None:
    """Add to rows of an array."""
    values = viewed(array)
    values[rows] += change.astype(values.dtype)
    if runs_on_gpu():
        array.from_numpy(values)


def copied(array: ti.Ndarray) -> NDArray[np.generic]:
    """The numbers of an array, vectors and matrices along the last axes."""
    return array.to_numpy() if runs_on_gpu() else _memory(array).copy()


def _memory(array: ti.Ndarray) -> NDArray[np.generic]:
    """The memory of an array on a CPU, which stays as long as it is looked at; what it holds may be anything later."""
    kind = np.dtype(to_numpy_type(array.dtype))
    shape = (*array.shape, *array.element_shape)
    address = impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr)
    memory = (ctypes.c_char * (math.prod(shape) * kind.itemsize)).from_address(address)
    memory.owner = array  # type: ignore[attr-defined]
    return np.frombuffer(memory, dtype=kind).reshape(shape)
