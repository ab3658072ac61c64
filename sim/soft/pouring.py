"""Particles that come in later: all are known at the start, and wait far away until their time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.core.arrays import Vectors, on_device
from sim.core.launch import kernel
from sim.soft.transfers import AWAY, Particles

WAITING = -2  # less the number of its body, it is that of a particle that waits


@dataclass(frozen=True, eq=False)
class Poured:
    """Particles that come in, by their time."""

    position: NDArray[np.float32]  # where each comes out [m], (n, 3)
    velocity: NDArray[np.float32]  # [m/s], (n, 3)
    time_s: NDArray[np.float64]  # when, ascending [s], (n,)
    body: NDArray[np.int32]  # of which each is a part, (n,)
    dye: NDArray[np.float32]  # concentration in it [-], (n,)

    @property
    def largest_speed(self) -> float:
        """[m/s]; 0 of none."""
        return float(np.linalg.norm(self.velocity.astype(np.float64), axis=1).max(initial=0.0))

    @classmethod
    def of_layer(
        cls, position: NDArray[np.floating], velocity: NDArray[np.floating], time_s: float, body: int, dye: float
    ) -> Poured:
        """Particles of one body and dye that come at one time, (m, 3) each."""
        count = len(position)
        numbers = np.full(count, time_s), np.full(count, body, np.int32), np.full(count, dye, np.float32)
        return cls(position.astype(np.float32), velocity.astype(np.float32), *numbers)

    @classmethod
    def together(cls, layers: Sequence[Poured]) -> Poured:
        """Those of all layers."""
        none = cls.of_layer(np.empty((0, 3)), np.empty((0, 3)), 0.0, 0, 0.0)
        rows = {
            each.name: np.concatenate([getattr(layer, each.name) for layer in (none, *layers)]) for each in fields(cls)
        }
        order = np.argsort(rows["time_s"], kind="stable")
        return cls(**{name: values[order] for name, values in rows.items()})


class Pouring:
    """Lets particles in that follow those of the start in their arrays.

    Attributes:
        count: how many there are.
        here: how many of them have come.
    """

    def __init__(self, poured: Poured, first: int) -> None:
        """Prepare for particles whose rows begin at the first one."""
        self._first, self._poured = first, poured
        self._ends = np.append(np.flatnonzero(np.diff(poured.time_s)) + 1, len(poured.time_s))  # of each layer
        self._place, self._velocity = on_device(poured.position), on_device(poured.velocity)
        speed = np.linalg.norm(poured.velocity.astype(np.float64), axis=1)
        self._fastest_left = np.append(np.maximum.accumulate(speed[::-1])[::-1], 0.0)
        self.count, self.here = len(poured.body), 0

    @property
    def largest_speed(self) -> float:
        """Of those that are still to come [m/s]."""
        return float(self._fastest_left[self.here])

    def let_in(self, particles: Particles, time_s: float) -> bool:
        """Place those whose time has come by a time [s], as far on their way as they are then; whether any are."""
        before = self.here
        due = int(np.searchsorted(self._poured.time_s, time_s, side="right"))
        for end in self._ends[np.searchsorted(self._ends, self.here, side="right") :]:
            if end > due:
                break
            age = time_s - float(self._poured.time_s[self.here])
            place_layer(particles, self._place, self._velocity, self._first, self.here, int(end), age)
            self.here = int(end)
        return self.here > before


@kernel
def place_layer(
    particles: Particles, place: Vectors, velocity: Vectors, first: ti.i32, begin: ti.i32, end: ti.i32, age: ti.f32
):
    """Particles of a layer, out of their opening for a time [s]."""
    for k in range(begin, end):
        p = first + k
        particles.position[p] = place[k] + age * velocity[k]
        particles.velocity[p] = velocity[k]
        particles.body[p] = WAITING - particles.body[p]


def waiting_rows(poured: Poured) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Positions [m], velocities [m/s] and bodies of particles that wait, as their arrays have them."""
    away = np.full_like(poured.position, AWAY)
    return away, np.zeros_like(poured.velocity), WAITING - poured.body


def has_come(body: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Which particles, by their bodies, are there or have left, (n,)."""
    come: NDArray[np.bool_] = body > WAITING
    return come
