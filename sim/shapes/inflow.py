"""Inflow: how far fluid has come through an opening at each time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ROUND_OFF = 1.0e-9  # of a length, by which it may fall short of what it is meant to be


@dataclass(frozen=True, eq=False)
class Inflow:
    """Speed of the fluid in an opening over time: linear between times, and what that comes to.

    Before the first time nothing flows, after the last the speed stays. One that is 0 for good has ended.
    """

    times: NDArray[np.float64]  # ascending, from its start on [s], (n,)
    speeds: NDArray[np.float64]  # then [m/s], (n,)
    travels: NDArray[np.float64]  # how far the fluid has come by then [m], (n,)
    end_s: float  # when it stops, whatever the speed [s]; infinite if never

    @classmethod
    def of(
        cls,
        speed: float,
        strengths: Sequence[tuple[float, float]],
        start_s: float,
        end_s: float | None,
        most: float,
    ) -> Inflow:
        """Inflow at parts of a speed [m/s] by time [s], constant beyond these, up to a time or a travel [m]."""
        given_times, given = np.array(strengths or [(start_s, 1.0)]).T
        times = np.array([start_s, *(time for time in given_times if time > start_s)])
        speeds = speed * np.interp(times, given_times, given)
        steps = 0.5 * (speeds[1:] + speeds[:-1]) * np.diff(times)
        endless = cls(times, speeds, np.concatenate([[0.0], np.cumsum(steps)]), math.inf)
        flowing = np.flatnonzero(speeds)
        last = flowing[-1] + 1 if len(flowing) else 0
        dry_s = float(times[last]) if last < len(times) else math.inf
        stop_s = min(math.inf if end_s is None else end_s, endless.time_of(most), dry_s)
        return cls(times, speeds, endless.travels, stop_s)

    @property
    def start_s(self) -> float:
        """When it begins [s]."""
        return float(self.times[0])

    @property
    def largest_speed(self) -> float:
        """Its largest speed up to its end [m/s]."""
        return max(self.speed_at(self.end_s), float(self.speeds[self.times <= self.end_s].max(initial=0.0)))

    @property
    def total_travel(self) -> float:
        """How far the fluid comes in all [m]; infinite where it never stops."""
        return math.inf if math.isinf(self.end_s) else self.travel_at(self.end_s)

    def is_open(self, time_s: float) -> bool:
        """Whether it has begun by a time [s] and has not ended."""
        return self.start_s <= time_s < self.end_s

    def speed_at(self, time_s: float) -> float:
        """Speed at a time [s] if it has begun by then [m/s]; that at its end from then on."""
        return float(np.interp(min(time_s, self.end_s), self.times, self.speeds))

    def travel_at(self, time_s: float) -> float:
        """How far the fluid has come by a time [s] [m]."""
        time_s = min(time_s, self.end_s)
        if time_s <= self.start_s:
            return 0.0
        k = int(np.searchsorted(self.times, time_s, side="right")) - 1
        mean = 0.5 * (float(self.speeds[k]) + self.speed_at(time_s))
        return float(self.travels[k]) + mean * (time_s - float(self.times[k]))

    def time_of(self, travel: float) -> float:
        """When the fluid has come so far [m] at the latest, its end left aside [s]; infinite if never."""
        if math.isinf(travel):
            return math.inf
        k = min(int(np.searchsorted(self.travels, travel, side="left")), len(self.times)) - 1
        k = max(k, 0)
        rest, speed = travel - float(self.travels[k]), float(self.speeds[k])
        slope = 0.0
        if k + 1 < len(self.times):
            slope = (float(self.speeds[k + 1]) - speed) / float(self.times[k + 1] - self.times[k])
        # The root of speed t + slope t²/2 = rest, written such that nothing cancels.
        divisor = speed + math.sqrt(max(speed * speed + 2.0 * slope * rest, 0.0))
        if divisor == 0.0:
            return float(self.times[k]) if rest <= ROUND_OFF * travel else math.inf
        return float(self.times[k]) + 2.0 * rest / divisor
