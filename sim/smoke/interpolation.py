"""Trilinear interpolation of the air's velocity, which is on the faces of cells, at any place."""

import taichi as ti

from sim.core.bundles import func
from sim.smoke.arrays import Faces
from sim.smoke.lanes import Grid, cell_counts, row_start


@func
def corner(cells: Grid, place, axis: ti.template()):
    """The lowest of the eight faces across an axis around a place in cells, and the offset from it in cells."""
    low = ti.Vector([0, 0, 0])
    offset = ti.Vector([0.0, 0.0, 0.0])
    for a in ti.static(range(3)):
        last = cell_counts(cells)[a] + ti.static(int(a == axis))
        inside = ti.max(1.0, ti.min(place[a] + ti.static(1.0 if a == axis else 0.5), float(last)))
        low[a] = ti.max(1, ti.min(int(inside), last - 1))
        offset[a] = inside - low[a]
    return row_start(cells, low[0], low[1]) + low[2], offset


@func
def weight(cells: Grid, offset, n: ti.template()):
    """Trilinear weight of corner n, and how far it is from the lowest one in the arrays."""
    product = 1.0
    for a in ti.static(range(3)):
        product *= offset[a] if ti.static((n >> (2 - a)) & 1) else 1.0 - offset[a]
    return product, (n >> 2) * cells.step_x + (n >> 1 & 1) * cells.step_y + (n & 1)


@func
def face_velocity_at(cells: Grid, faces: Faces, place):
    """Velocity at a place in cells, each component between its own eight faces [m/s]."""
    velocity = ti.math.vec3(0.0)
    for axis, face in ti.static(((0, faces.x), (1, faces.y), (2, faces.z))):
        at, offset = corner(cells, place, axis)
        for n in ti.static(range(8)):
            part, step = weight(cells, offset, n)
            velocity[axis] += part * face[at + step]
    return velocity
