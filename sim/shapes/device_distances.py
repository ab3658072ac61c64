"""Distances of rigid shapes on the device: formulas for primitives, a grid for meshes.

The formulas are those of `sim.shapes.primitives`, exact on both sides of the surface.
"""

from typing import NamedTuple

import taichi as ti

from sim.core.arrays import Floats, Integers, Vectors
from sim.core.bundles import bundle, func

Vector3 = ti.math.vec3
Counts = ti.types.vector(3, ti.i32)
CountTriples = ti.types.ndarray(dtype=Counts, ndim=1)

SPHERE, BOX, CYLINDER, CAPSULE, TORUS, CONE, GRID = range(7)


@bundle
class Shapes(NamedTuple):
    """Shapes of bodies; fields as the attributes of `DeviceShapes`, (b,) each."""

    kind: Integers
    size: Vectors  # [m]
    grid_values: Floats  # distances of all grids [m]
    grid_first: Integers  # place of a grid's first value
    grid_origin: Vectors  # [m]
    grid_spacing: Floats  # [m]
    grid_shape: CountTriples


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


@ti.func
def grid_distance(p: Vector3, values: Floats, first: ti.i32, origin: Vector3, spacing: ti.f32, shape: Counts) -> ti.f32:
    """Trilinear interpolation; outside of the grid that of the nearest point of it, plus the way there."""
    last = ti.cast(shape - 1, ti.f32)
    place = (p - origin) / spacing
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
        value += wx * wy * wz * values[first + node]
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


@ti.func
def distance_at(
    y: ti.math.vec3, b: ti.i32, kind: Integers, size: Vectors, grid_values: Floats, grid_first: Integers,
    grid_origin: Vectors, grid_spacing: Floats, grid_shape: CountTriples,
) -> ti.f32:  # fmt: skip
    """Distance to body b [m], negative inside, of a point in the frame of its shape."""
    distance = 0.0
    if kind[b] == GRID:
        distance = grid_distance(y, grid_values, grid_first[b], grid_origin[b], grid_spacing[b], grid_shape[b])
    else:
        distance = primitive_distance(y, kind[b], size[b])
    return distance


@func
def distance_to(y: ti.math.vec3, b: ti.i32, shapes: Shapes) -> ti.f32:
    """Distance to body b of a bundle, see `distance_at`."""
    return distance_at(
        y,
        b,
        shapes.kind,
        shapes.size,
        shapes.grid_values,
        shapes.grid_first,
        shapes.grid_origin,
        shapes.grid_spacing,
        shapes.grid_shape,
    )
