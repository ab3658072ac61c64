"""Points of others that joints hold, as nodes of a cloth: masses without extent."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.core.solver import Arrays
from sim.rigid.contacts import Array, Indices


class JointPoints:
    """Points that joints hold beside bodies; who owns them says how they move.

    Attributes:
        ends: number of the point at both ends of each joint, -1 where a body or the world is, (j, 2).
        position: [m], (h, 3).
        velocity: [m/s], (h, 3).
        acceleration: in the coming step, by all that pushes a free point but joints [m/s²], (h, 3).
        mass: [kg], (h,).
        is_free: whether joints move it; else it goes with its velocity, (h,).
    """

    def __init__(self, ends: Indices, position: Array, velocity: Array, mass: Array) -> None:
        self.ends, self.position, self.velocity, self.mass = ends, position.copy(), velocity.copy(), mass
        self.acceleration = np.zeros_like(velocity)
        self.is_free = np.ones(len(mass), dtype=bool)
        self._lag = np.zeros_like(velocity)

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def inverse_mass(self) -> Array:
        """[1/kg], (h,); 0 of those that joints do not move."""
        return np.where(self.is_free, 1.0 / self.mass, 0.0)

    def state(self) -> Array:
        """Positions and velocities, (h, 6)."""
        return np.concatenate([self.position, self.velocity], axis=1)

    def set_state(self, state: Array) -> None:
        """Take positions and velocities, (h, 6)."""
        self.position, self.velocity = state[:, :3].copy(), state[:, 3:].copy()

    def push(self, dt: float) -> None:
        """Add what accelerations change of velocities in dt [s]."""
        self.velocity = self.velocity + np.where(self.is_free[:, None], dt * self.acceleration, 0.0)

    def drift(self, dt: float, is_touched: NDArray[np.bool_]) -> Array:
        """Mean velocities in a step of dt [s] whose push they have [m/s], (h, 3): of those that were touched these,
        (h,), as of bodies in contact; they move on with them."""
        lags = self.is_free & ~is_touched
        self._lag = np.where(lags[:, None], 0.5 * dt * self.acceleration, 0.0)
        return self.velocity - self._lag

    def fly_on(self, dt: float) -> None:
        """Move for dt [s]."""
        self.position = self.position + dt * (self.velocity - self._lag)

    def checkpoint(self) -> dict[str, NDArray[np.generic]]:
        """Where they are, how they move, and which are free."""
        return {"joint_points": self.state(), "joint_points_free": self.is_free.copy()} if len(self) else {}

    def restore(self, arrays: Arrays) -> None:
        """Continue from a checkpoint. Raises ValueError when an array is missing or has another shape."""
        for name, array in self.checkpoint().items():
            if name not in arrays or arrays[name].shape != array.shape:
                raise ValueError(f"checkpoint of the rigid bodies: {name} must have shape {array.shape}")
        if len(self):
            self.set_state(np.array(arrays["joint_points"], dtype=np.float64))
            self.is_free = np.array(arrays["joint_points_free"], dtype=bool)


def no_points(joints: int) -> JointPoints:
    """No points, of so many joints."""
    nothing = np.zeros((0, 3))
    return JointPoints(np.full((joints, 2), -1), nothing, nothing, np.zeros(0))
