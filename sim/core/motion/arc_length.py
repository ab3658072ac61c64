"""Arc lengths of the paths of kinematic bodies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ArcLength:
    """Upper bound of the arc length that points of a body travel, linear between times; at rest before the first.

    Attributes:
        times: ascending [s], (n,).
        lengths: travelled by then [m], (n,), not descending.
        speed: after the last time [m/s].
    """

    times: NDArray[np.float64]
    lengths: NDArray[np.float64]
    speed: float

    def time_of_travel(self, distance: float, start_s: float) -> float:
        """Time [s] from `start_s` [s] on in which a point may travel a distance > 0 [m]; infinite if never."""
        last_s, last = float(self.times[-1]), float(self.lengths[-1])
        begun = float(np.interp(start_s, self.times, self.lengths)) + self.speed * max(start_s - last_s, 0.0)
        goal = begun + distance
        if goal < last:
            return float(np.interp(goal, self.lengths, self.times)) - start_s
        return last_s + (goal - last) / self.speed - start_s if self.speed > 0.0 else math.inf
