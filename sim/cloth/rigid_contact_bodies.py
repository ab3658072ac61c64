"""Rigid bodies as contacts with cloth see them: shapes and motion on the device, and the impulses that cloth gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.bundles import CollidingBodies, PushedBodies
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
        shows: whether it may show between vertices, so that triangles are looked at; 2 if edges are, too, (b,).
        depth: how deep free cloth was in each at most since `begin_frame`, in its thicknesses, (b,).
        friction: [-], (b,).
        lift: how much farther than half a thickness vertices keep [m], (b,).
        position: centre of mass at the start of the substep [m], (b,) vec3.
        rotation: body axes to world axes, (b,) mat3.
        motion: displacement of the centre of mass in the substep [m] and rotation vector [rad] of each body in turn,
            (2 b,) vec3; contacts change it.
        motion_start, motion_reached: likewise, at the start and in the course of an iteration.
        inverse_mass: [1/kg], (b,); 0 for all that no force moves.
        inverse_inertia: in world axes [1/(kg m²)], (b,) mat3.
        gathered, impulse: integers, of linear and angular impulse times the step, (6 b,).
        load: integers, sums over the contacts of a body, in `load_unit`s, (b,).
        may_move: whether forces move any of them, or ever did.

    Args:
        geometries: of the bodies.
        friction: Coulomb's coefficients [-], (b,).
    """

    def __init__(self, geometries: Sequence[BodyGeometry], friction: Sequence[float]) -> None:
        super().__init__(geometries)
        room = max(self.count, 1)
        self.shows = ti.ndarray(ti.i32, room)
        self.shows.fill(0)
        self.friction, self.inverse_mass, self.depth, self.lift = (ti.ndarray(ti.f32, room) for _ in range(4))
        self.lift.fill(0.0)
        self.begin_frame()
        self.position = ti.Vector.ndarray(3, ti.f32, room)
        self.motion, self.motion_start, self.motion_reached = (ti.Vector.ndarray(3, ti.f32, 2 * room) for _ in range(3))
        self.rotation, self.inverse_inertia = (ti.Matrix.ndarray(3, 3, ti.f32, room) for _ in range(2))
        self.gathered, self.impulse = (ti.ndarray(ti.i64, 6 * room) for _ in range(2))
        self.load = ti.ndarray(ti.i64, room)
        for array in (self.gathered, self.impulse, self.load, self.motion):
            array.fill(0)
        self.load_unit = 1.0
        self.may_move = False
        if self.count:
            self.set_friction(np.asarray(friction, dtype=np.float64))

    @property
    def colliding(self) -> CollidingBodies:
        """The bodies for kernels that find contacts."""
        return CollidingBodies(
            count=self.count,
            shapes=self.on_device,
            shows=self.shows,
            depth=self.depth,
            centre_of_mass=self.centre_of_mass,
            radius=self.radius,
            step=self.step,
            friction=self.friction,
            lift=self.lift,
            position=self.position,
            rotation=self.rotation,
            motion=self.motion,
        )

    @property
    def pushed(self) -> PushedBodies:
        """The bodies for kernels that push them."""
        return PushedBodies(
            may_move=int(self.may_move),
            count=self.count,
            motion=self.motion,
            motion_start=self.motion_start,
            motion_reached=self.motion_reached,
            inverse_mass=self.inverse_mass,
            inverse_inertia=self.inverse_inertia,
            gathered=self.gathered,
            impulse=self.impulse,
            load=self.load,
            load_unit=self.load_unit,
        )

    def begin_frame(self) -> None:
        """Note anew how deep cloth gets."""
        self.depth.fill(0.0)

    def set_friction(self, friction: Array) -> None:
        """Say how rough the bodies are: Coulomb's coefficients [-], (b,)."""
        if self.count:
            put(self.friction, friction)

    def set_lift(self, lift: Array) -> None:
        """Say how much farther than half a thickness vertices keep from each [m], (b,)."""
        if self.count:
            put(self.lift, lift)

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
        put(self.position, poses.position[:b])
        put(self.rotation, poses.rotation[:b])
        put(self.inverse_mass, inverse_mass)
        self.may_move = self.may_move or bool(inverse_mass.any())
        put(self.inverse_inertia, inverse_inertia)
        reach = np.array([geometry.radius for geometry in self.geometries])
        mobility = inverse_mass + reach**2 * np.linalg.norm(inverse_inertia, axis=(1, 2))
        self.load_unit = LOAD_UNIT * float(np.sqrt(mobility.max())) or 1.0

    def sag(self, edge: float) -> Array:
        """How far each body shows at most through triangles with such an edge whose vertices touch it [m], (b,).

        What is sharp, or read from a grid, may show by any height.
        """
        size, kind = (copied(each)[: self.count] for each in (self.on_device.size, self.on_device.kind))
        radius = np.where(kind == TORUS, size[:, 1], size[:, 0])
        return np.where(np.isin(kind, _ROUND), edge**2 / (6.0 * np.maximum(radius, 1.0e-30)), np.inf)

    def look_at_triangles(self, shows: NDArray[np.bool_]) -> None:
        """Say which bodies may show between vertices, (b,)."""
        put(self.shows, np.where(copied(self.on_device.kind)[: self.count] == SPHERE, 1, 2) * shows)

    def set_motion(self, shift: Array, turn: Array) -> None:
        """Say how the bodies would move in a substep without cloth.

        Args:
            shift: displacements of the centres of mass [m], (b, 3).
            turn: rotation vectors [rad], (b, 3).
        """
        if self.count:
            put(self.motion, np.stack([shift, turn], axis=1).reshape(-1, 3))

    def take_impulses(self, unit: float) -> tuple[Array, Array]:
        """Linear and angular impulse times the step that cloth gave since the last call [kg m], [kg m²], (b, 3) each.

        Args:
            unit: of the integers [kg m].
        """
        sums = unit * take(self.impulse).astype(np.float64).reshape(-1, 6)[: self.count]
        return sums[:, :3], sums[:, 3:]
