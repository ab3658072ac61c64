"""The fluid between two cached frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.snapshots import Snapshot

Float32Array = NDArray[np.float32]


@dataclass(frozen=True)
class FluidState:
    """Particles of a fluid, or of all fluids of a tank, at one moment."""

    particle_id: NDArray[np.int32]  # (n,) int32, ascending
    position: Float32Array  # [m], (n, 3), float32
    velocity: Float32Array  # [m/s], (n, 3), float32

    @classmethod
    def of_snapshots(cls, fluids: Sequence[Snapshot]) -> FluidState:
        """The particles of all fluids of a tank, whose ids differ."""
        particle_id = np.concatenate([fluid.arrays["particle_id"] for fluid in fluids]).astype(np.int32)
        order = np.argsort(particle_id)
        position, velocity = (
            np.concatenate([fluid.arrays[name] for fluid in fluids]).astype(np.float32)[order]
            for name in ("position", "velocity")
        )
        return cls(particle_id[order], position, velocity)


class FluidMotion:
    """Where the fluid's particles are between two frames: a cubic through both positions with both velocities.

    Velocity is that cubic's derivative, so that whatever moves with the fluid stays with its particles. A particle that
    the earlier frame does not have (an emitter made it) comes in a straight line; one that the later frame does not
    have (it left the domain) is gone.
    """

    def __init__(self, begin: FluidState, end: FluidState, frame_dt: float) -> None:
        self.frame_dt = frame_dt
        self.particle_id = end.particle_id
        self._end_position, self._end_velocity = end.position, end.velocity
        self._begin_position = end.position - np.float32(frame_dt) * end.velocity
        self._begin_velocity = end.velocity.copy()
        _, in_end, in_begin = np.intersect1d(
            end.particle_id, begin.particle_id, assume_unique=True, return_indices=True
        )
        self._begin_position[in_end] = begin.position[in_begin]
        self._begin_velocity[in_end] = begin.velocity[in_begin]

    def max_speed(self) -> float:
        """Largest speed at both frames [m/s]."""
        both = (self._begin_velocity, self._end_velocity)
        return float(np.sqrt(max(float(np.einsum("ij,ij->i", v, v).max(initial=0.0)) for v in both)))

    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of a box about the particles at both frames [m], (2, 3)."""
        if len(self.particle_id) == 0:
            return np.zeros((2, 3))
        both = np.concatenate([self._begin_position, self._end_position])
        return np.array([both.min(axis=0), both.max(axis=0)], np.float64)

    def at(self, share: float) -> FluidState:
        """The particles when a share of the time between the frames has passed (cubic Hermite interpolation)."""
        s, dt = share, self.frame_dt
        position = (
            np.float32((1.0 + 2.0 * s) * (1.0 - s) ** 2) * self._begin_position
            + np.float32(s * s * (3.0 - 2.0 * s)) * self._end_position
            + np.float32(dt * s * (1.0 - s) ** 2) * self._begin_velocity
            - np.float32(dt * s * s * (1.0 - s)) * self._end_velocity
        )
        velocity = (
            np.float32(6.0 * s * (1.0 - s) / dt) * (self._end_position - self._begin_position)
            + np.float32((1.0 - s) * (1.0 - 3.0 * s)) * self._begin_velocity
            + np.float32(s * (3.0 * s - 2.0)) * self._end_velocity
        )
        return FluidState(self.particle_id, position, velocity)
