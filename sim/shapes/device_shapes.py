"""The shapes of rigid bodies on the device, as kernels ask for distances to them (`shape_distances.distance_at`)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.device_distances import BOX, CAPSULE, CONE, CYLINDER, GRID, SPHERE, TORUS, Shapes
from sim.shapes.distance_grids import sampled_distances
from sim.shapes.level_set import LevelSet
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere, Torus

GRADIENT_STEP = 1.0e-3
"""Half width of the differences that give a primitive's normal, in shortest edges: float32 errs by 1e-4 then."""

_SIZES = {
    Sphere: (SPHERE, lambda shape: (shape.radius, 0.0, 0.0)),
    Box: (BOX, lambda shape: tuple(0.5 * edge for edge in shape.size)),
    Cylinder: (CYLINDER, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Capsule: (CAPSULE, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Torus: (TORUS, lambda shape: (shape.major_radius, shape.minor_radius, 0.0)),
    Cone: (CONE, lambda shape: (shape.radius, shape.height, 0.0)),
}
"""Kind and size of a primitive, as `primitive_distance` takes them."""


class DeviceShapes:
    """Primitives by their formulas and meshes by grids, one shape a body.

    Attributes:
        count: number of bodies, b.
        geometries: of the bodies, on the host.
        kind: of the shape, (b,).
        size: of a primitive, (b,) vec3, scaled.
        centre_of_mass: in the frame of the shape [m], (b,) vec3.
        radius: that of a sphere around the centre of mass that holds the body [m], (b,).
        step: half width of differences for normals [m], (b,).
        grid_first, grid_origin, grid_spacing, grid_shape: where in `grid_values` a mesh's distances are.

    Args:
        geometries: of the bodies; those that share one share its grid.
    """

    def __init__(self, geometries: Sequence[BodyGeometry]) -> None:
        self.count, self.geometries = len(geometries), tuple(geometries)
        room = max(self.count, 1)
        self.kind, self.grid_first = (ti.ndarray(ti.i32, room) for _ in range(2))
        self.radius, self.step, self.grid_spacing = (ti.ndarray(ti.f32, room) for _ in range(3))
        self.size, self.centre_of_mass, self.grid_origin = (ti.Vector.ndarray(3, ti.f32, room) for _ in range(3))
        self.grid_shape = ti.Vector.ndarray(3, ti.i32, room)
        self.grid_values = ti.ndarray(ti.f32, 1)
        if self.count:
            self._describe()

    @property
    def on_device(self) -> Shapes:
        """The shapes for kernels."""
        return Shapes(
            self.kind,
            self.size,
            self.grid_values,
            self.grid_first,
            self.grid_origin,
            self.grid_spacing,
            self.grid_shape,
        )

    def _describe(self) -> None:
        b = self.count
        kind, first, shape = np.empty(b, np.int32), np.zeros(b, np.int32), np.zeros((b, 3), np.int32)
        size, origin, spacing = np.zeros((b, 3)), np.zeros((b, 3)), np.ones(b)
        step = np.empty(b)
        radius = np.array([geometry.radius for geometry in self.geometries])
        sampled: dict[int, tuple[int, LevelSet]] = {}
        values: list[NDArray[np.float32]] = []
        for number, geometry in enumerate(self.geometries):
            solid = geometry.solid
            if type(solid.shape) in _SIZES:
                kind[number], size_of = _SIZES[type(solid.shape)]
                size[number] = solid.scale * np.asarray(size_of(solid.shape))
                step[number] = GRADIENT_STEP * geometry.shortest_edge
                if isinstance(solid.shape, Sphere):  # `geometry` goes by the corners of its box
                    radius[number] = size[number, 0] + np.linalg.norm(geometry.centre_of_mass)
                continue
            if id(geometry) not in sampled:
                level_set = sampled_distances(solid)
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
            (self.radius, radius),
            (self.centre_of_mass, np.array([geometry.centre_of_mass for geometry in self.geometries])),
        ):
            floats.from_numpy(numbers.astype(np.float32))
