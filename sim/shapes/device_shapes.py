"""Shapes of rigid bodies on the device, and their distances: formulas for primitives, a grid for meshes.

The formulas are those of `sim.shapes.primitives`, exact on both sides of the surface.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import taichi as ti

from sim.core.arrays import Floats, Integers, Vectors, on_device
from sim.core.bundles import bundle, func
from sim.core.host_access import put
from sim.core.launch import kernel
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.deformation import Deformation
from sim.shapes.level_set import LevelSet
from sim.shapes.primitives import Box, Capsule, Cone, Cylinder, Sphere, Torus

Vector3 = ti.math.vec3
Counts = ti.types.vector(3, ti.i32)
CountTriples = ti.types.ndarray(dtype=Counts, ndim=1)

SPHERE, BOX, CYLINDER, CAPSULE, TORUS, CONE, GRID = range(7)


@bundle
class Shapes(NamedTuple):
    """Shapes of bodies, (b,) each."""

    kind: Integers
    size: Vectors  # of a primitive, scaled [m]; of a grid that deforms 1, of others 0
    grid_values: Floats  # distances of all grids [m]
    grid_first: Integers  # place of a grid's first value
    grid_origin: Vectors  # [m]
    grid_spacing: Floats  # [m]
    grid_shape: CountTriples
    deforms: ti.template()  # whether any grid does; its distances are followed by the x, y and z of its motion


@ti.func
def slab(beyond: Vector3) -> ti.f32:
    """Distance to where no component, each a distance across its own axis, is positive."""
    return ti.max(beyond, 0.0).norm() + ti.min(beyond.max(), 0.0)


@ti.func
def rounded(x: ti.f32, y: ti.f32, radius: ti.f32) -> ti.f32:
    """Distance of (x, y) to a circle."""
    return ti.sqrt(x * x + y * y) - radius


@ti.func
def cone_distance(radial: ti.f32, z: ti.f32, radius: ti.f32, height: ti.f32) -> ti.f32:
    """Distance to a triangle that revolves: base down, its bounding box centred on the origin."""
    px, py = radial - radius, z + 0.5 * height
    along = ti.math.clamp((height * py - radius * px) / (radius * radius + height * height), 0.0, 1.0)
    to_slant = rounded(px + along * radius, py - along * height, 0.0)
    to_base = rounded(ti.max(px, 0.0), py, 0.0)
    inside = py > 0.0 and height * px + radius * py < 0.0
    return ti.select(inside, -1.0, 1.0) * ti.min(to_slant, to_base)


@func
def grid_distance(p: Vector3, b: ti.i32, shapes: Shapes) -> ti.f32:
    """Trilinear interpolation; outside of the grid that of the nearest point of it, plus the way there."""
    shape, spacing = shapes.grid_shape[b], shapes.grid_spacing[b]
    last = ti.cast(shape - 1, ti.f32)
    place = (p - shapes.grid_origin[b]) / spacing
    nearest = ti.math.clamp(place, 0.0, last)
    cell = ti.min(ti.cast(nearest, ti.i32), shape - 2)
    share = nearest - ti.cast(cell, ti.f32)
    value = 0.0
    for corner in ti.static(range(8)):
        dx, dy, dz = ti.static(corner // 4, corner // 2 % 2, corner % 2)
        wx = ti.static(1.0 - dx) + ti.static(2.0 * dx - 1.0) * share[0]
        wy = ti.static(1.0 - dy) + ti.static(2.0 * dy - 1.0) * share[1]
        wz = ti.static(1.0 - dz) + ti.static(2.0 * dz - 1.0) * share[2]
        node = ((cell[0] + dx) * shape[1] + cell[1] + dy) * shape[2] + cell[2] + dz
        value += wx * wy * wz * shapes.grid_values[shapes.grid_first[b] + node]
    return value + spacing * (place - nearest).norm()


@ti.func
def primitive_distance(p: Vector3, kind: ti.i32, size: Vector3) -> ti.f32:
    """Distance to a primitive about its own origin [m], negative inside.

    `size`: half edges of a box; else radius and half height; of a torus its two radii; of a cone radius and height.
    """
    radial = ti.sqrt(p[0] * p[0] + p[1] * p[1])
    distance = p.norm() - size[0]
    if kind == BOX:
        distance = slab(ti.abs(p) - size)
    elif kind == CYLINDER:
        beyond = ti.math.vec2(radial - size[0], ti.abs(p[2]) - size[1])
        distance = ti.max(beyond, 0.0).norm() + ti.min(beyond.max(), 0.0)
    elif kind == CAPSULE:
        distance = rounded(radial, ti.max(ti.abs(p[2]) - size[1], 0.0), size[0])
    elif kind == TORUS:
        distance = rounded(radial - size[0], p[2], size[1])
    elif kind == CONE:
        distance = cone_distance(radial, p[2], size[0], size[1])
    return distance


@func
def distance_to(y: Vector3, b: ti.i32, shapes: Shapes) -> ti.f32:
    """Distance to body b [m], negative inside, of a point in the frame of its shape."""
    distance = 0.0
    if shapes.kind[b] == GRID:
        distance = grid_distance(y, b, shapes)
    else:
        distance = primitive_distance(y, shapes.kind[b], shapes.size[b])
    return distance


GRADIENT_STEP = 1.0e-3  # half width of differences for a primitive's normal, in shortest edges
_SIZES = {
    Sphere: (SPHERE, lambda shape: (shape.radius, 0.0, 0.0)),
    Box: (BOX, lambda shape: tuple(0.5 * edge for edge in shape.size)),
    Cylinder: (CYLINDER, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Capsule: (CAPSULE, lambda shape: (shape.radius, 0.5 * shape.height, 0.0)),
    Torus: (TORUS, lambda shape: (shape.major_radius, shape.minor_radius, 0.0)),
    Cone: (CONE, lambda shape: (shape.radius, shape.height, 0.0)),
}
"""Kind and size of a primitive, as `primitive_distance` takes them."""


@func
def surface_motion(y: Vector3, b: ti.i32, shapes: Shapes) -> Vector3:
    """How the surface near a point in the frame of body b moves there as it deforms; see `DeviceShapes.deform`."""
    motion = Vector3(0.0)
    if ti.static(shapes.deforms):
        shape = shapes.grid_shape[b]
        if shapes.kind[b] == GRID and shapes.size[b][0] > 0.0:
            place = (y - shapes.grid_origin[b]) / shapes.grid_spacing[b]
            nearest = ti.math.clamp(place, 0.0, ti.cast(shape - 1, ti.f32))
            cell = ti.min(ti.cast(nearest, ti.i32), shape - 2)
            share = nearest - ti.cast(cell, ti.f32)
            nodes = shape[0] * shape[1] * shape[2]
            for corner in range(8):
                dx, dy, dz = corner // 4, corner // 2 % 2, corner % 2
                weight = ti.select(dx == 1, share[0], 1.0 - share[0])
                weight *= ti.select(dy == 1, share[1], 1.0 - share[1])
                weight *= ti.select(dz == 1, share[2], 1.0 - share[2])
                node = ((cell[0] + dx) * shape[1] + cell[1] + dy) * shape[2] + cell[2] + dz
                for axis in ti.static(range(3)):
                    motion[axis] += weight * shapes.grid_values[shapes.grid_first[b] + (1 + axis) * nodes + node]
    return motion


@kernel
def blend(between: Floats, share: ti.f32, span: ti.f32, first: ti.i32, values: Floats):
    """Put a grid where it is after a share of the time between two moments; its motion is its velocity times a span.

    `between` has distances [m] and three components of velocities [m/s] of all nodes, of one moment, then of the other.
    """
    count = between.shape[0] // 2
    for n in range(count):
        start = between[n]
        value = start + share * (between[count + n] - start)
        values[first + n] = ti.select(n < count // 4, value, span * value)


LONGEST_STEP_S = 0.05
"""Of who asks what is near: a body's surface gets no farther beyond its sphere within it."""


class DeformingGrid:
    """A grid of distances among others that is to be where its body's surface is."""

    def __init__(self, deformation: Deformation, first: int) -> None:
        """Take that whose first value has a number."""
        self._deformation, self._first = deformation, first
        self._between = ti.ndarray(ti.f32, 8 * int(np.prod(deformation.shape)))
        self._number = -1

    def put_into(self, values: ti.Ndarray, time_s: float, span_s: float) -> None:
        """Fill its values as of a time [s], and motions within a span [s]."""
        fields = self._deformation.fields(time_s)
        if fields.number != self._number:
            moments = [
                part
                for distances, velocities in zip(fields.distances, fields.velocities, strict=True)
                for part in (distances.ravel(), np.moveaxis(velocities, -1, 0).ravel())
            ]
            put(self._between, np.concatenate(moments))
            self._number = fields.number
        still = 0.0 if self._deformation.speed(time_s) == 0.0 else span_s
        blend(self._between, fields.share, still, self._first, values)


class DeviceShapes:
    """Primitives by their formulas and meshes by grids, one shape a body; those that share a geometry share its grid.

    Attributes:
        count: number of bodies, b.
        geometries: of the bodies, on the host.
        on_device: the shapes for kernels.
        centre_of_mass: in the frame of the shape [m], (b,) vec3.
        radius: that of a sphere around the centre of mass that holds the body [m], (b,).
        step: half width of differences for normals [m], (b,).
    """

    def __init__(self, geometries: Sequence[BodyGeometry]) -> None:
        self.count, self.geometries = len(geometries), tuple(geometries)
        room = max(self.count, 1)
        kind, first, shape = np.zeros(room, np.int32), np.zeros(room, np.int32), np.zeros((room, 3), np.int32)
        size, origin, centre = np.zeros((room, 3)), np.zeros((room, 3)), np.zeros((room, 3))
        radius, step, spacing = np.zeros(room), np.zeros(room), np.ones(room)
        sampled: dict[int, tuple[int, LevelSet]] = {}
        self._deforming: list[DeformingGrid] = []
        values = [np.zeros(1, np.float32)]
        for number, geometry in enumerate(geometries):
            solid = geometry.solid
            centre[number], radius[number] = geometry.centre_of_mass, geometry.radius
            if type(solid.shape) in _SIZES:
                kind[number], size_of = _SIZES[type(solid.shape)]
                size[number] = solid.scale * np.asarray(size_of(solid.shape))
                step[number] = GRADIENT_STEP * geometry.shortest_edge
                if isinstance(solid.shape, Sphere):  # `geometry` goes by the corners of its box
                    radius[number] = size[number, 0] + np.linalg.norm(geometry.centre_of_mass)
                continue
            if id(geometry) not in sampled:
                deformation, place = geometry.deformation, sum(each.size for each in values)
                level_set = geometry.fine_grid if deformation is None else geometry.grid
                sampled[id(geometry)] = place, level_set
                values.append(level_set.values.ravel())
                if deformation is not None:
                    self._deforming.append(DeformingGrid(deformation, place))
                    values.append(np.zeros(3 * level_set.values.size, np.float32))
            first[number], level_set = sampled[id(geometry)]
            if geometry.deformation is not None:
                size[number] = 1.0
                radius[number] += LONGEST_STEP_S * geometry.deformation.largest_speed
            kind[number], shape[number], origin[number] = GRID, level_set.values.shape, level_set.origin
            spacing[number], step[number] = level_set.spacing, 0.5 * level_set.spacing
        self.centre_of_mass, self.radius, self.step = on_device(centre), on_device(radius), on_device(step)
        self.on_device = Shapes(
            kind=on_device(kind),
            size=on_device(size),
            grid_values=on_device(np.concatenate(values)),
            grid_first=on_device(first),
            grid_origin=on_device(origin),
            grid_spacing=on_device(spacing),
            grid_shape=on_device(shape),
            deforms=bool(self._deforming),
        )

    def deform(self, time_s: float, span_s: float) -> None:
        """Take shapes that deform as they are at a time [s]; their motion is that of a span [s] from then on."""
        for grid in self._deforming:
            grid.put_into(self.on_device.grid_values, time_s, span_s)
