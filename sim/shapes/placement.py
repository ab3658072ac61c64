"""From a placement in the job to a solid in the world: scaled, then rotated, then moved."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim.shapes.parameters import Placement, Shape, TorusShape
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere, Torus
from sim.shapes.sampling import sample_surface
from sim.shapes.solid import Points, RestShape, ShapeError, TriangleMesh


@dataclass(frozen=True, eq=False)
class PlacedSolid:
    """A rest shape in the world; implements `sim.shapes.Solid`."""

    shape: RestShape  # the shape about its own origin
    scale: float  # uniform factor [-]
    rotation: NDArray[np.float64]  # (3, 3) rotation matrix, rest axes to world axes
    position: NDArray[np.float64]  # (3,) world position of the shape's origin [m]

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner of its tight axis-aligned box [m], (2, 3)."""
        upper = self.scale * self.shape.support(self.rotation)  # row k is the world axis k in rest axes
        lower = -self.scale * self.shape.support(-self.rotation)
        return self.position + np.stack([lower, upper])

    @property
    def volume(self) -> float:
        """Volume [m³]."""
        return self.shape.volume * self.scale**3

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was repaired or assumed to build it, one sentence each."""
        return self.shape.warnings

    @property
    def orientation(self) -> NDArray[np.float64]:
        """Unit quaternion w, x, y, z with w >= 0, (4,)."""
        return Rotation.from_matrix(self.rotation).as_quat(canonical=True, scalar_first=True)

    def signed_distance(self, points: Points) -> NDArray[np.float64]:
        """Distance to the surface [m], negative inside, (n,), of world positions (n, 3)."""
        rest_points = (np.asarray(points, dtype=np.float64) - self.position) @ self.rotation / self.scale
        return self.scale * self.shape.signed_distance(rest_points)

    def surface_mesh(self, max_edge: float | None = None) -> TriangleMesh:
        """Closed outward-oriented surface in world coordinates; edges no longer than `max_edge` [m] if given."""
        return self._mesh(max_edge).transformed(self.scale, self.rotation, self.position)

    def rest_mesh(self, max_edge: float | None = None) -> TriangleMesh:
        """The surface scaled, but neither rotated nor moved."""
        return self._mesh(max_edge).transformed(self.scale, np.eye(3), np.zeros(3))

    def surface_samples(self, spacing: float) -> NDArray[np.float32]:
        """Evenly spread points on its surface in world coordinates [m], (m, 3).

        They are sampled on the mesh at rest and then placed, so that two bodies of one shape carry the same pattern.
        """
        samples = sample_surface(self.rest_mesh(), spacing).astype(np.float64)
        return (samples @ self.rotation.T + self.position).astype(np.float32)

    def _mesh(self, max_edge: float | None) -> TriangleMesh:
        return self.shape.surface_mesh(None if max_edge is None else max_edge / self.scale)


class SharedShapes:
    """Shapes about their own origins that were built, so that bodies of one shape share it."""

    def __init__(self) -> None:
        self._built: dict[Shape, RestShape] = {}

    def of(self, shape: Shape) -> RestShape:
        """The shape, built where it is new. Raises as `build_solid`."""
        if shape not in self._built:
            self._built[shape] = build_rest_shape(shape)
        return self._built[shape]


def build_solid(placement: Placement, shapes: SharedShapes | None = None) -> PlacedSolid:
    """The solid that a placement describes; a relative mesh path counts from the working directory.

    Its shape is one of those that were built, if some are given.

    Raises:
        ShapeError: the shape cannot be built; the text gives place, rule, value and remedy.
    """
    # Lower-case "xyz" are rotations about fixed world axes: R = Rz Ry Rx.
    rotation = Rotation.from_euler("xyz", placement.rotation_deg, degrees=True).as_matrix()
    position = np.asarray(placement.position, dtype=np.float64)
    rest = build_rest_shape(placement.shape) if shapes is None else shapes.of(placement.shape)
    return PlacedSolid(rest, placement.scale, rotation, position + placement.scale * rotation @ rest.centre)


def build_rest_shape(shape: Shape) -> RestShape:
    """The shape about its own origin. Raises as `build_solid`."""
    return _BUILDERS[shape.type](shape)


def _build_torus(shape: TorusShape) -> Torus:
    if shape.minor_radius >= shape.major_radius:
        raise ShapeError(
            f"shape.minor_radius: must be less than major_radius = {shape.major_radius:g} m, "
            f"got {shape.minor_radius:g} m; use a sphere or a cylinder for a ring without a hole"
        )
    return Torus(shape.major_radius, shape.minor_radius)


def _module(name: str) -> Any:
    """A module that is loaded when a job has a shape of it."""
    return import_module(f"sim.shapes.{name}")


_BUILDERS: Mapping[str, Callable[..., RestShape]] = {
    "box": lambda shape: Box(shape.size),
    "sphere": lambda shape: Sphere(shape.radius),
    "cylinder": lambda shape: Cylinder(shape.radius, shape.height),
    "capsule": lambda shape: Capsule(shape.radius, shape.height),
    "torus": _build_torus,
    "cone": lambda shape: Cone(shape.radius, shape.height),
    "revolved": lambda shape: _module("revolved").build_revolved(shape),
    "duck": lambda shape: _module("procedural").build_duck(shape.length),
    "bunny": lambda shape: _module("procedural").build_bunny(shape.height),
    "mesh": lambda shape: _module("mesh_file").load_mesh_solid(shape),
    "animation": lambda shape: _module("animation").load_animation(shape),
    "compound": lambda shape: _module("assembly").build_compound(shape),
    "piece": lambda shape: _module("cutting").build_piece(shape),
}
"""How each type of shape is built: one line for a new shape."""
