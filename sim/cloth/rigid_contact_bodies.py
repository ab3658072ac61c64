"""Rigid bodies as contacts with cloth see them: shapes and motion on the device, and the impulses that cloth gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import CollidingBodies, PushedBodies
from sim.core.bundles import with_room
from sim.core.host_access import copied, put, take
from sim.core.motion.paths import Poses
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.device_shapes import CAPSULE, SPHERE, TORUS, DeviceShapes

Array = NDArray[np.float64]

LOAD_UNIT = 1.0e-6
"""Unit of sums of the square roots of mobilities, in the largest of them."""

_ROUND = (SPHERE, CAPSULE, TORUS)


class CollisionBodies(DeviceShapes):
    """All bodies that cloth may touch: those that move, then those that stand still.

    Attributes:
        colliding: the bodies for kernels that find contacts.
        pushed: the bodies for kernels that push them.

    Args:
        geometries: of the bodies.
        friction: Coulomb's coefficients [-], (b,).
    """

    def __init__(self, geometries: Sequence[BodyGeometry], friction: Sequence[float]) -> None:
        super().__init__(geometries)
        b = self.count
        known = {name: getattr(self, name) for name in ("centre_of_mass", "radius", "step")}
        motion = ti.Vector.ndarray(3, ti.f32, 2 * max(b, 1))
        self.colliding: CollidingBodies = with_room(
            CollidingBodies, b, count=b, shapes=self.on_device, motion=motion, **known
        )
        twice = {name: ti.Vector.ndarray(3, ti.f32, 2 * max(b, 1)) for name in ("motion_start", "motion_reached")}
        six = {name: ti.ndarray(ti.i64, 6 * max(b, 1)) for name in ("gathered", "impulse")}
        self.pushed: PushedBodies = with_room(
            PushedBodies, b, may_move=0, count=b, motion=motion, load_unit=1.0, **twice, **six
        )
        self.set_friction(np.asarray(friction, dtype=np.float64))

    def begin_frame(self) -> None:
        """Note anew how deep cloth gets."""
        self.colliding.depth.fill(0.0)

    def set_friction(self, friction: Array) -> None:
        """Say how rough the bodies are: Coulomb's coefficients [-], (b,)."""
        if self.count:
            put(self.colliding.friction, friction)

    def set_lift(self, lift: Array) -> None:
        """Say how much farther than half a thickness vertices keep from each [m], (b,)."""
        if self.count:
            put(self.colliding.lift, lift)

    def place(self, poses: Poses, inverse_mass: Array, inverse_inertia: Array) -> None:
        """Say where the bodies are, and how easily they move.

        Args:
            poses: of all bodies; further ones are not looked at.
            inverse_mass: [1/kg], (b,).
            inverse_inertia: in world axes [1/(kg m²)], (b, 3, 3).
        """
        b = self.count
        if not b:
            return
        put(self.colliding.position, poses.position[:b])
        put(self.colliding.rotation, poses.rotation[:b])
        put(self.pushed.inverse_mass, inverse_mass)
        put(self.pushed.inverse_inertia, inverse_inertia)
        reach = np.array([geometry.radius for geometry in self.geometries])
        mobility = inverse_mass + reach**2 * np.linalg.norm(inverse_inertia, axis=(1, 2))
        self.pushed = self.pushed._replace(
            may_move=int(self.pushed.may_move or inverse_mass.any()),
            load_unit=LOAD_UNIT * float(np.sqrt(mobility.max())) or 1.0,
        )

    def sag(self, edge: float) -> Array:
        """How far each body shows at most through triangles with such an edge whose vertices touch it [m], (b,).

        What is sharp, or read from a grid, may show by any height.
        """
        size, kind = (copied(each)[: self.count] for each in (self.on_device.size, self.on_device.kind))
        radius = np.where(kind == TORUS, size[:, 1], size[:, 0])
        return np.where(np.isin(kind, _ROUND), edge**2 / (6.0 * np.maximum(radius, 1.0e-30)), np.inf)

    def look_at_triangles(self, shows: NDArray[np.bool_]) -> None:
        """Say which bodies may show between vertices, (b,)."""
        put(self.colliding.shows, np.where(copied(self.on_device.kind)[: self.count] == SPHERE, 1, 2) * shows)

    def set_motion(self, shift: Array, turn: Array) -> None:
        """Say how the bodies would move in a substep without cloth.

        Args:
            shift: displacements of the centres of mass [m], (b, 3).
            turn: rotation vectors [rad], (b, 3).
        """
        if self.count:
            put(self.colliding.motion, np.stack([shift, turn], axis=1).reshape(-1, 3))

    def take_impulses(self, unit: float) -> tuple[Array, Array]:
        """Linear and angular impulse times the step that cloth gave since the last call [kg m], [kg m²], (b, 3) each.

        Args:
            unit: of the integers [kg m].
        """
        sums = unit * take(self.pushed.impulse).astype(np.float64).reshape(-1, 6)[: self.count]
        return sums[:, :3], sums[:, 3:]
