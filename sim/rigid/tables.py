"""Arrays on the device that hold as many rows as there are now, and become larger where they have to."""

from __future__ import annotations

from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray
from taichi.lang.util import to_taichi_type

from sim.core.host_access import put, viewed
from sim.core.reductions import runs_on_gpu

SPARE = 1.5  # an array that has become too small becomes larger than it has to by this factor


def kept(numbers: NDArray[np.generic]) -> ti.Ndarray:
    """An array of these numbers, of their type, on the device."""
    array = ti.ndarray(to_taichi_type(numbers.dtype), numbers.shape)
    put(array, numbers)
    return array


def fill(array: ti.Ndarray, rows: NDArray[np.generic]) -> None:
    """Fill the first rows of an array; on a GPU the others become 0."""
    if not runs_on_gpu():
        viewed(array)[: len(rows)] = rows
        return
    everything = np.zeros(array.shape, rows.dtype)
    everything[: len(rows)] = rows
    put(array, everything)


def larger(array: ti.Ndarray | None, shape: tuple[int, ...], kind: Any) -> ti.Ndarray:
    """The array, if it has so many rows, or one of this type that has more; what is in it is lost then."""
    if array is not None and array.shape[0] >= shape[0]:
        return array
    return ti.ndarray(kind, (int(SPARE * shape[0]) + 1, *shape[1:]))


def larger_tables(kind: Any, tables: Any, columns: dict[str, int], rows: int, **others: int) -> Any:
    """A bundle of this kind, or None, with so many rows in each array, as `larger` has them.

    Args:
        columns: of those arrays that have some, by field.
        others: rows of those arrays that have another number of them.
    """
    arrays = []
    for field, annotation in kind.__bundled__.items():
        shape = (others.get(field, rows), *([columns[field]] if annotation.ndim == 2 else []))
        arrays.append(larger(getattr(tables, field, None), shape, annotation.dtype))
    return kind(*arrays)
