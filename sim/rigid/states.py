"""The state of the bodies that move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.rotation import Array


class MovingBodies:
    """Poses and velocities of all moving bodies, dynamic and kinematic, in the order of the job; all float64.

    Attributes:
        names: (n,).
        is_dynamic: (n,) bool; the others are kinematic.
        position: centre of mass [m], (n, 3).
        orientation: unit quaternion w, x, y, z, body axes to world axes, (n, 4).
        velocity: of the centre of mass [m/s], (n, 3).
        angular_velocity: about world axes [rad/s], (n, 3).
        mass: [kg], (n,); infinite for bodies that no force moves.
        is_lost: (n,) bool: so far outside of the domain that it was stopped; no force moves it any more.
        is_pushed: (n,) bool: got an impulse since the last step; the step that takes it in resets it.
    """

    def __init__(
        self,
        names: Sequence[str],
        mass: Array,
        inertia: Array,
        *,
        position: Array,
        orientation: Array,
        velocity: Array,
        angular_velocity: Array,
    ) -> None:
        """Bodies with inertia tensors about their centres of mass in their own axes [kg m²], (n, 3, 3)."""
        n = len(names)
        self.names, self.mass, self._tensor = tuple(names), mass, inertia
        self.position, self.orientation = position, rotation.normalized(orientation)
        self.velocity, self.angular_velocity = velocity, angular_velocity
        self.is_dynamic = np.isfinite(self.mass)
        self.is_lost, self.is_pushed = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
        self._inverse_tensor = np.zeros((n, 3, 3))
        self._inverse_tensor[self.is_dynamic] = np.linalg.inv(self._tensor[self.is_dynamic])
        self.principal_moments, axes = np.linalg.eigh(self._tensor)
        axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
        self.principal_orientation = np.stack([rotation.from_matrix(each) for each in axes])

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_free(self) -> NDArray[np.bool_]:
        """Whether forces move it, (n,)."""
        return self.is_dynamic & ~self.is_lost

    def are_free(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether forces move the bodies of these numbers, (k,); those from n on are static, or the domain."""
        return np.append(self.is_free, False)[np.minimum(numbers, len(self))]

    @property
    def inverse_mass(self) -> Array:
        """[1/kg], (n,); 0 for kinematic and lost bodies."""
        return np.where(self.is_free, 1.0 / self.mass, 0.0)

    def scale_mass(self, number: int, factor: float) -> None:
        """Multiply the mass of a dynamic body by a factor; it keeps its shape and velocities."""
        self.mass[number] *= factor
        self._tensor[number] *= factor
        self._inverse_tensor[number] /= factor
        self.principal_moments[number] *= factor

    def rotation(self) -> Array:
        """Rotation matrices, body axes to world axes, (n, 3, 3)."""
        return rotation.matrices(self.orientation)

    def inverse_inertia(self) -> Array:
        """Inverse inertia tensors in world axes [1/(kg m²)], (n, 3, 3); 0 for kinematic and lost bodies."""
        if not self.is_dynamic.any():
            return np.zeros_like(self._inverse_tensor)
        turned = self.rotation()
        inverse = np.einsum("nij,njk,nlk->nil", turned, self._inverse_tensor, turned)
        return np.where(self.is_free[:, None, None], inverse, 0.0)

    def angular_momentum(self) -> Array:
        """Spin I omega about the centres of mass in world axes [kg m²/s], (n, 3); means nothing if kinematic."""
        turned = self.rotation()
        in_body = np.einsum("nji,nj->ni", turned, self.angular_velocity)
        return np.einsum("nij,nj->ni", turned, np.einsum("njk,nk->nj", self._tensor, in_body))

    def set_angular_momentum(self, momentum: Array) -> None:
        """Set the angular velocity of the free bodies to that of a spin in world axes [kg m²/s], (n, 3)."""
        turned = self.rotation()
        in_body = np.einsum("nji,nj->ni", turned, momentum)
        angular_velocity = np.einsum("nij,nj->ni", turned, np.einsum("njk,nk->nj", self._inverse_tensor, in_body))
        self.angular_velocity = np.where(self.is_free[:, None], angular_velocity, self.angular_velocity)

    def apply_impulses(self, linear: Array, angular: Array) -> None:
        """Change the velocities of the dynamic bodies by linear [N s] and angular impulses [N m s], (n, 3) each."""
        if not self.is_dynamic.any():
            return
        self.is_pushed = self.is_pushed | linear.any(axis=1)
        self.velocity = self.velocity + self.inverse_mass[:, None] * linear
        self.angular_velocity = self.angular_velocity + np.einsum("nij,nj->ni", self.inverse_inertia(), angular)
