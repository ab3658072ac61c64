"""The state of the bodies that move, and of those that never do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim.core.motion import rotation
from sim.core.motion.rotation import Array
from sim.core.snapshots import Snapshot
from sim.rigid.parameters import RigidBodyParameters
from sim.rigid.state_kernels import SEQUENCE, Moving, describe, fly_on
from sim.shapes.placement import SharedShapes, build_solid

_COMPONENTS = ([1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0])
_SIGNS = np.array([[-1.0, 1.0, 1.0, -1.0], [-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, -1.0, 1.0]])
"""q i, q j and q k: the components of q in another order, with signs."""


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
        is_asleep: (n,) bool: rests, and is left alone until something that moves comes near, or an impulse wakes it.
        rest_s: for how long it has been too slow to be seen to move [s], (n,).
        deforming: how fast points of its surface move in its own frame, at most [m/s], (n,).
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
        self.is_asleep, self.rest_s, self.deforming = np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n)
        self._inverse_tensor = np.zeros((n, 3, 3))
        self._inverse_tensor[self.is_dynamic] = np.linalg.inv(self._tensor[self.is_dynamic])
        self.principal_moments, self.principal_orientation = _principal(self._tensor)

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

    def set_inertia(self, number: int, mass: float, tensor: Array) -> None:
        """Give a dynamic body another mass [kg] and inertia tensor about its centre in its own axes [kg m²], (3, 3)."""
        self.mass[number], self._tensor[number] = mass, tensor
        self._inverse_tensor[number] = np.linalg.inv(tensor)
        moments, orientation = _principal(tensor[None])
        self.principal_moments[number], self.principal_orientation[number] = moments[0], orientation[0]

    @property
    def tensors(self) -> Array:
        """Inertia tensors about the centres of mass in the bodies' own axes [kg m²], (n, 3, 3)."""
        return self._tensor

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

    def moving(self) -> Moving:
        """The bodies as kernels take them, which change these very arrays."""
        for name in ("position", "orientation", "velocity", "angular_velocity"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name)))
        return Moving(
            self.position,
            self.orientation,
            self.velocity,
            self.angular_velocity,
            self.inverse_mass,
            self._tensor,
            self._inverse_tensor,
            self.principal_moments,
            self.principal_orientation,
        )

    def describe(self, is_active: NDArray[np.bool_], pose: Array, ease: Array) -> None:
        """Note where bodies are and how easily impulses move active ones; see `state_kernels.describe`."""
        describe(self.moving(), (self.is_free & is_active).astype(np.int32), pose, ease)

    def fly_on(
        self,
        dt: float,
        gravity: Array,
        extra: Array,
        *,
        is_active: NDArray[np.bool_],
        is_touched: NDArray[np.bool_],
        is_held: NDArray[np.bool_],
    ) -> None:
        """Move and turn active bodies for dt [s]; see `state_kernels.fly_on`."""
        which = (each.astype(np.int32) for each in (is_active, is_touched, is_held))
        fly_on(self.moving(), dt, 0.5 * dt * gravity[None], extra, *which)

    def angular_momentum(self) -> Array:
        """Spin I omega about the centres of mass in world axes [kg m²/s], (n, 3); means nothing if kinematic."""
        turned = self.rotation()
        in_body = np.einsum("nji,nj->ni", turned, self.angular_velocity)
        return np.einsum("nij,nj->ni", turned, np.einsum("njk,nk->nj", self._tensor, in_body))

    def spins(self) -> Array:
        """How fast bodies turn [rad/s], (n,)."""
        return lengths(self.angular_velocity)

    def surface_speeds(self, radius: Array) -> Array:
        """Upper bounds of the speeds of surface points within a radius [m] of each body [m/s], (n,)."""
        return lengths(self.velocity) + self.spins() * radius + self.deforming

    def wake(self, which: NDArray[np.bool_]) -> None:
        """Let bodies, (n,), move again."""
        self.is_asleep = self.is_asleep & ~which
        self.rest_s = np.where(which, 0.0, self.rest_s)

    def put_to_sleep(self, which: NDArray[np.bool_]) -> None:
        """Stop bodies, (n,), until they are woken."""
        self.is_asleep = self.is_asleep | which
        self.velocity = np.where(which[:, None], 0.0, self.velocity)
        self.angular_velocity = np.where(which[:, None], 0.0, self.angular_velocity)

    def apply_impulses(self, linear: Array, angular: Array) -> None:
        """Change the velocities of the dynamic bodies by linear [N s] and angular impulses [N m s], (n, 3) each."""
        if not self.is_dynamic.any():
            return
        pushed = linear.any(axis=1)
        self.is_pushed = self.is_pushed | pushed
        self.wake(pushed | angular.any(axis=1))
        self.velocity = self.velocity + self.inverse_mass[:, None] * linear
        self.angular_velocity = self.angular_velocity + np.einsum("nij,nj->ni", self.inverse_inertia(), angular)


def lengths(vectors: Array) -> Array:
    """Of vectors, (n, k), (n,)."""
    result: Array = np.sqrt(np.einsum("ni,ni->n", vectors, vectors))
    return result


def _principal(tensors: Array) -> tuple[Array, Array]:
    """Principal moments, (n, 3), and the turns of principal axes, (n, 4), of inertia tensors, (n, 3, 3)."""
    moments, axes = np.linalg.eigh(tensors)
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    return moments, np.stack([rotation.from_matrix(each) for each in axes])


def turned_freely(
    orientation: Array, principal_orientation: Array, principal_moments: Array, spin: Array, dt: float
) -> Array:
    """Orientations, (n, 4), after dt [s] without torque, of bodies with spins in world axes [kg m²/s], (n, 3).

    Strang splitting of the Euler equations, I domega/dt = -omega x (I omega), into rotations about the principal axes
    (Dullweber, Leimkuhler & McLachlan 1997, "Symplectic splitting methods for rigid body molecular dynamics"; McLachlan
    1993). Every part is solved as a rotation, so that the spin is exact; as the method is symplectic, the energy
    oscillates by O((omega dt)²) without drift.

    The principal axes are given in body axes, (n, 4), with their moments [kg m²], (n, 3).
    """
    q = rotation.product(orientation, principal_orientation)
    in_body = np.einsum("nji,nj->in", rotation.matrices(q), spin)
    for axis, share in SEQUENCE:
        angle = share * dt * in_body[axis] / principal_moments[:, axis]
        c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
        q = c[:, None] * q + s[:, None] * (_SIGNS[axis] * q[:, _COMPONENTS[axis]])
        # Seen from the turned body, its spin turns backwards.
        cosine, sine = c * c - s * s, 2.0 * c * s
        j, k = (axis + 1) % 3, (axis + 2) % 3
        in_body[j], in_body[k] = cosine * in_body[j] + sine * in_body[k], cosine * in_body[k] - sine * in_body[j]
    return rotation.normalized(rotation.product(q, rotation.conjugate(principal_orientation)))


class StaticBody:
    """A rigid body that stays where its placement puts it.

    Attributes:
        name: its name in the job.
        solid: its region of the world.

    Raises:
        ShapeError: its shape cannot be built.
    """

    def __init__(self, parameters: RigidBodyParameters, shapes: SharedShapes | None = None) -> None:
        self.name, self.solid = parameters.name, build_solid(parameters, shapes)
        self._group = parameters.group

    def snapshot(self) -> Snapshot:
        """Its pose: the same at every frame."""
        arrays = {
            "position": self.solid.position.copy(),
            "orientation": self.solid.orientation,
            "velocity": np.zeros(3),
            "angular_velocity": np.zeros(3),
        }
        return Snapshot("rigid", arrays, {}, self._group)
