"""Convex polytopes with rounded edges, which stand for boxes and convex meshes in contacts with each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from sim.rigid.contacts import Array, Indices
from sim.shapes.balls import BALL_DEPTH
from sim.shapes.body_geometry import BodyGeometry
from sim.shapes.mesh_solid import ConvexSolid, MeshSolid
from sim.shapes.primitives import Box, Sphere

CONVEX = 1.0e-6  # part of the hull's volume that a mesh may lack and be taken for convex
SAME = 1.0e-9  # by how much planes and vertices of one face may differ, in the body's size
MOST_CORNERS = 1000  # of all faces together: contacts are told apart by ten bits


@dataclass(frozen=True, eq=False)
class Polytope:
    """A convex polytope, to whose surface a radius is added all around; in the body's frame."""

    radius: float  # [m]
    vertices: Array  # [m], (v, 3)
    planes: Array  # outward normal and offset of each face [m], (f, 4)
    corners: Indices  # vertices of all faces, one face after the other, counterclockwise seen from outside, (c,)
    counts: Indices  # of the corners of each face, (f,)


def polytope_of(geometry: BodyGeometry) -> Polytope | None:
    """The polytope of a body, if it is one of few faces: as balls under its surface have it, edges are rounded.

    A sphere is one of a single corner.
    """
    shape = geometry.solid.shape
    if geometry.deformation is not None:
        return None
    if isinstance(shape, Sphere):
        none = np.zeros(0, dtype=np.int64)
        return Polytope(geometry.solid.scale * shape.radius, np.zeros((1, 3)), np.zeros((0, 4)), none, none)
    hull = _convex_hull(geometry) if isinstance(shape, Box | MeshSolid) else None
    if hull is None:
        return None
    size, radius = float(np.ptp(hull.points, axis=0).max()), BALL_DEPTH * geometry.shortest_edge
    planes = _distinct(hull.equations * [1.0, 1.0, 1.0, 1.0 / size]) * [1.0, 1.0, 1.0, size]
    # The middle of the largest ball inside.
    inside = linprog(
        [0.0, 0.0, 0.0, -1.0], np.insert(planes[:, :3], 3, 1.0, axis=1), -planes[:, 3], bounds=(None, None)
    )
    if inside.x[3] < 2.0 * radius:
        return None
    planes[:, 3] += radius
    vertices = size * _distinct(HalfspaceIntersection(planes, inside.x[:3]).intersections / size)
    loops = [_corners(vertices, plane, SAME * size) for plane in planes]
    kept = [number for number, loop in enumerate(loops) if len(loop) >= 3]
    counts = np.array([len(loops[number]) for number in kept])
    if counts.sum() > MOST_CORNERS:
        return None
    return Polytope(
        radius, vertices, planes[kept] * [1.0, 1.0, 1.0, -1.0], np.concatenate([loops[k] for k in kept]), counts
    )


def _convex_hull(geometry: BodyGeometry) -> ConvexHull | None:
    """The hull of a body that is convex, in its frame."""
    try:
        hull = ConvexHull(geometry.solid.rest_mesh().vertices - geometry.centre_of_mass)
    except QhullError:
        return None
    is_known = isinstance(geometry.solid.shape, Box | ConvexSolid)
    return hull if is_known or hull.volume - geometry.solid.volume <= CONVEX * hull.volume else None


def _distinct(rows: Array) -> Array:
    """Rows of numbers of about 1 that differ by more than rounding, the first of each, in their order."""
    kept: list[Array] = []
    for row in rows:
        if not kept or np.abs(np.array(kept) - row).max(axis=1).min() > SAME:
            kept.append(row)
    return np.array(kept)


def _corners(vertices: Array, plane: Array, within: float) -> Indices:
    """The vertices in a plane (outward normal, minus its offset), counterclockwise seen from outside."""
    normal = plane[:3]
    numbers = np.flatnonzero(np.abs(vertices @ normal + plane[3]) <= within)
    if len(numbers) < 3:
        return numbers
    from_middle = vertices[numbers] - vertices[numbers].mean(axis=0)
    along = from_middle[0] / np.linalg.norm(from_middle[0])
    angle = np.arctan2(from_middle @ np.cross(normal, along), from_middle @ along)
    return numbers[np.argsort(angle)]
