"""The state of the bodies that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Inertia:
    """Mass of one body and its inertia about the centre of mass, in the body's axes.

    Attributes:
        mass: [kg]; infinite for a body that no force moves.
        tensor: inertia tensor [kg m²], (3, 3).
    """

    mass: float
    tensor: Array


class MovingBodies:
    """Poses and velocities of all moving bodies, dynamic and kinematic, in the order of the job; all float64.

    Attributes:
        names: (n,).
        is_dynamic: (n,) bool; the others are kinematic.
        position: centre of mass [m], (n, 3).
        orientation: unit quaternion w, x, y, z, body axes to world axes, (n, 4).
        velocity: of the centre of mass [m/s], (n, 3).
        angular_velocity: about world axes [rad/s], (n, 3).
        is_lost: (n,) bool: so far outside of the domain that it was stopped; no force moves it any more.
        is_pushed: (n,) bool: got an impulse since the last step; the step that takes it in resets it.
    """

    def __init__(
        self,
        names: Sequence[str],
        inertias: Sequence[Inertia],
        *,
        position: Array,
        orientation: Array,
        velocity: Array,
        angular_velocity: Array,
    ) -> None:
        n = len(names)
        self.names = tuple(names)
        self.position = np.asarray(position, dtype=np.float64).reshape(n, 3)
        self.orientation = rotation.normalized(np.asarray(orientation, dtype=np.float64).reshape(n, 4))
        self.velocity = np.asarray(velocity, dtype=np.float64).reshape(n, 3)
        self.angular_velocity = np.asarray(angular_velocity, dtype=np.float64).reshape(n, 3)
        self.mass = np.array([inertia.mass for inertia in inertias])
        self.is_dynamic = np.isfinite(self.mass)
        self.is_lost = np.zeros(n, dtype=bool)
        self.is_pushed = np.zeros(n, dtype=bool)
        self._tensor = np.stack([inertia.tensor for inertia in inertias])
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
        free: NDArray[np.bool_] = self.is_dynamic & ~self.is_lost
        return free

    def are_free(self, numbers: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Whether forces move the bodies of these numbers, (k,); those from n on are static, or the domain."""
        free: NDArray[np.bool_] = np.append(self.is_free, False)[np.minimum(numbers, len(self))]
        return free

    @property
    def inverse_mass(self) -> Array:
        """[1/kg], (n,); 0 for kinematic and lost bodies."""
        return np.where(self.is_free, 1.0 / self.mass, 0.0)

    def scale_mass(self, number: int, factor: float) -> None:
        """Make a dynamic body so many times heavier, with the same shape and velocities."""
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
        momentum: Array = np.einsum("nij,nj->ni", turned, np.einsum("njk,nk->nj", self._tensor, in_body))
        return momentum

    def set_angular_momentum(self, momentum: Array) -> None:
        """Set the angular velocity of the free bodies to that of a spin in world axes [kg m²/s], (n, 3)."""
        turned = self.rotation()
        in_body = np.einsum("nji,nj->ni", turned, momentum)
        angular_velocity = np.einsum("nij,nj->ni", turned, np.einsum("njk,nk->nj", self._inverse_tensor, in_body))
        self.angular_velocity = np.where(self.is_free[:, None], angular_velocity, self.angular_velocity)

    def apply_impulses(self, linear: Array, angular: Array) -> None:
        """Change the velocities of the dynamic bodies at once.

        Args:
            linear: [N s], (n, 3).
            angular: about the centres of mass [N m s], (n, 3).
        """
        if not self.is_dynamic.any():
            return
        self.is_pushed = self.is_pushed | linear.any(axis=1)
        self.velocity = self.velocity + self.inverse_mass[:, None] * linear
        self.angular_velocity = self.angular_velocity + np.einsum("nij,nj->ni", self.inverse_inertia(), angular)
