"""CUDA's driver, asked by its own names, in the context and the stream that Taichi uses."""

import ctypes
import functools
from typing import Any


@functools.cache
def driver() -> ctypes.CDLL:
    """The library."""
    return ctypes.CDLL("libcuda.so.1")


def ask(function: str, *arguments: Any) -> None:
    """Call a function of the driver.

    Raises:
        RuntimeError: the driver refuses, or the device has failed.
    """
    check(getattr(driver(), function)(*arguments), function)


def check(code: int, function: str) -> None:
    """Raise RuntimeError unless a function returned success."""
    if code != 0:
        name = ctypes.c_char_p()
        driver().cuGetErrorName(code, ctypes.byref(name))
        raise RuntimeError(f"{(name.value or b'CUDA_ERROR').decode()} ({code}) in {function}")
