"""Memory of arrays that nobody holds any longer.

Taichi 1.7.4 frees an array of scalars in whichever thread gives it up. The garbage collector runs in any of them, and
with CUDA the process ends if that one has never launched a kernel. Arrays of vectors and matrices it never frees. Here
all of them are freed by one thread.
"""

import threading
from collections import deque
from typing import Any

from taichi.lang import impl
from taichi.lang._ndarray import Ndarray, ScalarNdarray

_given_up: deque[Any] = deque()
"""What the runtime knows arrays by."""


def free_in_this_thread() -> None:
    """Have all arrays freed by the thread that calls: at once those that it gives up, and others with them."""
    owner = threading.get_ident()

    def give_up(array: Any) -> None:
        _given_up.append(array.arr)
        if threading.get_ident() == owner:
            free_given_up()

    if "__del__" in vars(ScalarNdarray):
        del ScalarNdarray.__del__
    Ndarray.__del__ = give_up


def free_given_up() -> None:
    """Free the arrays that were given up; to be called by the thread that frees them."""
    program = impl.get_runtime().prog
    while _given_up:
        known = _given_up.popleft()
        if program is not None:  # whose end frees all
            program.delete_ndarray(known)
