"""Cuts a duration into stable steps that land on its end, as a frame's do."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator


def landing_steps(duration: float, stable_dt: Callable[[], float]) -> Iterator[float]:
    """Lengths of the steps to take, one after the other [s].

    Args:
        duration: where they are to land [s].
        stable_dt: the largest step for the state at the time; asked before each one [s].
    """
    remaining = duration
    while remaining > 0.0:
        left = max(1, math.ceil(remaining / stable_dt() * (1.0 - 1.0e-9)))
        dt = remaining / left
        remaining = remaining - dt if left > 1 else 0.0
        yield dt
