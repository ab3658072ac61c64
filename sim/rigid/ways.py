"""How far a kinematic body gets along its path, and when."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Way:
    """Upper bound of the way of the points of a body, linear between times; at rest before the first.

    Attributes:
        times: ascending [s], (n,).
        lengths: of the way by then [m], (n,), not descending.
        speed: with which it goes on after the last [m/s].
    """

    times: NDArray[np.float64]
    lengths: NDArray[np.float64]
    speed: float

    def time_of_travel(self, distance: float, start_s: float) -> float:
        """Time [s] from a moment [s] on until some point has come a distance > 0 [m]; infinite if none ever does."""
        last_s, last = float(self.times[-1]), float(self.lengths[-1])
        begun = float(np.interp(start_s, self.times, self.lengths)) + self.speed * max(start_s - last_s, 0.0)
        goal = begun + distance
        if goal < last:
            return float(np.interp(goal, self.lengths, self.times)) - start_s
        return last_s + (goal - last) / self.speed - start_s if self.speed > 0.0 else math.inf
