"""Rigid bodies as contacts with cloth see them: shapes and motion on the device, and the impulses that cloth gives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.cloth.body_grids import EXACT_WITHIN, GRID_PADDING, grid_spacing, thin_wall
from sim.cloth.rigid_contact_shapes import BOX, CAPSULE, CONE, CYLINDER, GRID, SPHERE, TORUS
from sim.rigid.contacts import Poses
from sim.rigid.geometry import BodyGeometry
from sim.shapes.level_set import LevelSet
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere, Torus

Array = NDArray[np.float64]

GRADIENT_STEP = 1.0e-3
"""Half width of the differences that give a primitive's normal, in shortest edges: float32 errs by 1e-4 then."""

LOAD_UNIT = 1.0e-6
"""Unit of sums of the square roots of mobilities, in the largest of them."""

_SIZES = {
    Sphere: (SPHERE, lambda shape: (shape.radius, 0.0, 0.0)),
    Box: (BOX, lambda shape: tuple(0.5 * edge for edge in shape.size)),
    Cylinder: (CYLINDER, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Capsule: (CAPSULE, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Torus: (TORUS, lambda shape: (shape.major_radius, shape.minor_radius, 0.0)),
    Cone: (CONE, lambda shape: (shape.radius, shape.height, 0.0)),
}
"""Kind and size of a primitive, as `primitive_distance` takes them."""

_ROUND = (SPHERE, CAPSULE, TORUS)


class CollisionBodies:
    """All bodies that cloth may touch: those that move, then those that stand still.

    Attributes:
        count: number of bodies, b.
        kind: of the shape, (b,).
        size: of a primitive, (b,) vec3, scaled.
        has_edges: whether more than vertices must be looked at, as the shape has sharp edges or is small, (b,).
        centre_of_mass: in the frame of the shape [m], (b,) vec3.
        radius: largest distance from the centre of mass [m], (b,).
        step: half width of differences for normals [m], (b,).
        friction: [-], (b,).
        grid_first, grid_origin, grid_spacing, grid_shape: where in `grid_values` a mesh's distances are.
        position: centre of mass at the start of the substep [m], (b,) vec3.
        rotation: body axes to world axes, (b,) mat3.
        motion: displacement of the centre of mass in the substep [m] and rotation vector [rad] of each body in turn,
            (2 b,) vec3; contacts change it.
        motion_start, motion_reached: likewise, at the start and in the course of an iteration.
        inverse_mass: [1/kg], (b,); 0 for all that no force moves.
        inverse_inertia: in world axes [1/(kg m²)], (b,) mat3.
        gathered, impulse: integers, of linear and angular impulse times the step, (6 b,).
        load: integers, sums over the contacts of a body, in `load_unit`s, (b,).
        shortest_edge: of the smallest body [m].

    Args:
        geometries: of the bodies.
        friction: Coulomb's coefficients [-], (b,).
    """

    def __init__(self, geometries: Sequence[BodyGeometry], friction: Sequence[float]) -> None:
        self.count, self.geometries = len(geometries), tuple(geometries)
        room = max(self.count, 1)
        self.kind, self.has_edges, self.grid_first = (ti.ndarray(ti.i32, room) for _ in range(3))
        self.radius, self.step, self.friction, self.grid_spacing, self.inverse_mass = (
            ti.ndarray(ti.f32, room) for _ in range(5)
        )
        self.size, self.centre_of_mass, self.grid_origin, self.position = (
            ti.Vector.ndarray(3, ti.f32, room) for _ in range(4)
        )
        self.motion, self.motion_start, self.motion_reached = (ti.Vector.ndarray(3, ti.f32, 2 * room) for _ in range(3))
        self.grid_shape = ti.Vector.ndarray(3, ti.i32, room)
        self.rotation, self.inverse_inertia = (ti.Matrix.ndarray(3, 3, ti.f32, room) for _ in range(2))
        self.gathered, self.impulse = (ti.ndarray(ti.i64, 6 * room) for _ in range(2))
        self.load = ti.ndarray(ti.i64, room)
        for array in (self.gathered, self.impulse, self.load, self.motion):
            array.fill(0)
        self.load_unit = 1.0
        self.shortest_edge = min((geometry.shortest_edge for geometry in geometries), default=np.inf)
        self.grid_values = ti.ndarray(ti.f32, 1)
        if self.count:
            self._describe_shapes(np.asarray(friction))
            self.look_between_vertices(0.0)

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
        self.position.from_numpy(poses.position[:b].astype(np.float32))
        self.rotation.from_numpy(poses.rotation[:b].astype(np.float32))
        self.inverse_mass.from_numpy(inverse_mass.astype(np.float32))
        self.inverse_inertia.from_numpy(inverse_inertia.astype(np.float32))
        reach = np.array([geometry.radius for geometry in self.geometries])
        mobility = inverse_mass + reach**2 * np.linalg.norm(inverse_inertia, axis=(1, 2))
        self.load_unit = LOAD_UNIT * float(np.sqrt(mobility.max())) or 1.0

    def look_between_vertices(self, length: float) -> None:
        """Look at more than vertices where a body has sharp edges, or its box an edge that is shorter [m]."""
        if self.count:
            is_small = np.array([geometry.shortest_edge < length for geometry in self.geometries])
            self.has_edges.from_numpy((~np.isin(self.kind.to_numpy(), _ROUND) | is_small).astype(np.int32))

    def set_motion(self, shift: Array, turn: Array) -> None:
        """Say how the bodies would move in a substep without cloth.

        Args:
            shift: displacements of the centres of mass [m], (b, 3).
            turn: rotation vectors [rad], (b, 3).
        """
        if self.count:
            self.motion.from_numpy(np.stack([shift, turn], axis=1).reshape(-1, 3).astype(np.float32))

    def take_impulses(self, unit: float) -> tuple[Array, Array]:
        """Linear and angular impulse times the step that cloth gave since the last call [kg m], [kg m²], (b, 3) each.

        Args:
            unit: of the integers [kg m].
        """
        sums = unit * self.impulse.to_numpy().astype(np.float64).reshape(-1, 6)[: self.count]
        self.impulse.fill(0)
        return sums[:, :3], sums[:, 3:]

    def _describe_shapes(self, friction: NDArray[np.float32]) -> None:
        b = self.count
        kind, first, shape = np.empty(b, np.int32), np.zeros(b, np.int32), np.zeros((b, 3), np.int32)
        size, origin, spacing = np.zeros((b, 3)), np.zeros((b, 3)), np.ones(b)
        step = np.empty(b)
        sampled: dict[int, tuple[int, LevelSet]] = {}
        values: list[NDArray[np.float32]] = []
        for number, geometry in enumerate(self.geometries):
            solid = geometry.solid
            if type(solid.shape) in _SIZES:
                kind[number], size_of = _SIZES[type(solid.shape)]
                size[number] = solid.scale * np.asarray(size_of(solid.shape))
                step[number] = GRADIENT_STEP * geometry.shortest_edge
                continue
            if id(geometry) not in sampled:
                cell = grid_spacing(solid, thin_wall(solid))
                level_set = LevelSet.sample(solid, cell, padding=GRID_PADDING * cell, exact_within=EXACT_WITHIN * cell)
                sampled[id(geometry)] = sum(each.size for each in values), level_set
                values.append(level_set.values.ravel())
            first[number], level_set = sampled[id(geometry)]
            kind[number], shape[number], origin[number] = GRID, level_set.values.shape, level_set.origin
            spacing[number], step[number] = level_set.spacing, 0.5 * level_set.spacing
        if values:
            self.grid_values = ti.ndarray(ti.f32, sum(each.size for each in values))
            self.grid_values.from_numpy(np.concatenate(values))
        for integers, numbers in (
            (self.kind, kind),
            (self.grid_first, first),
            (self.grid_shape, shape),
        ):
            integers.from_numpy(numbers.astype(np.int32))
        for floats, numbers in (
            (self.size, size),
            (self.grid_origin, origin),
            (self.grid_spacing, spacing),
            (self.step, step),
            (self.friction, friction),
            (self.radius, np.array([geometry.radius for geometry in self.geometries])),
            (self.centre_of_mass, np.array([geometry.centre_of_mass for geometry in self.geometries])),
        ):
            floats.from_numpy(numbers.astype(np.float32))
