"""The balls that stand for a body in contacts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sim.shapes.placement import PlacedSolid
from sim.shapes.primitives import Capsule, Sphere, Torus
from sim.shapes.solid import Points, ShapeError, TriangleMesh

BALL_COUNT = 1500  # balls that cover a surface, about: sixteen along the edge of a cube
BALL_DEPTH = 0.02  # radius of those balls, in shortest edges of the body: how far corners are rounded
_REFINEMENTS = 6  # each leaves under a hundredth of the error at corners of more than 20°
_HALVINGS = 5  # thin walls are met by balls of half, a quarter, ... of that radius.
_SMOOTH = 0.35  # normals of a smooth vertex are within this angle of their mean [rad]: 20 degrees
_NEIGHBOURHOOD = 1.8  # distance to neighbours on a smooth surface, in spacings: beyond those across a cell


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls inside a body whose union stands for it when it touches others.

    A ball about a point at depth r has radius r. Its centre is outside of whatever the body touches, where distances
    are smooth and their gradient is the contact normal: corners on corners and edges along edges have one, too. A ball
    under a flat face may be touched along the normal only: a slanted contact would trip an edge that slides over it.
    """

    centres: Points  # [m], (3, m)
    radii: NDArray[np.float64]  # [m], (m,)
    axes: Points  # outward normal of the surface at each ball, (3, m)
    cones: NDArray[np.float64]  # angle about that normal within which a ball may be touched [rad], (m,)
    exact: bool  # whether their union is the body, as for a sphere, and no ball has a preferred side


def exact_balls(solid: PlacedSolid) -> Balls | None:
    """The balls whose union is the solid at rest, if there are some of one radius."""
    fill = _EXACT_BALLS.get(type(solid.shape))
    if fill is None:
        return None
    centres, radius = fill(solid.shape)
    count = len(centres)
    return Balls(
        centres=np.ascontiguousarray(solid.scale * centres.T),
        radii=np.full(count, solid.scale * radius),
        axes=np.zeros((3, count)),
        cones=np.full(count, np.pi),
        exact=True,
    )


def surface_balls(solid: PlacedSolid) -> Balls:
    """Balls under the vertices of a solid's surface at rest, sharp ones first, about one a cell of a grid.

    Raises:
        ShapeError: its walls are too thin all over.
    """
    area = float(np.linalg.norm(solid.rest_mesh().area_vectors, axis=1).sum())
    spacing = float(np.sqrt(area / BALL_COUNT))
    mesh = solid.rest_mesh(spacing)
    inward, axes, cones = _vertex_frames(mesh)
    kept = _one_per_cell(mesh.vertices, cones, spacing)
    vertices, inward, axes, cones = mesh.vertices[kept], inward[kept], axes[kept], cones[kept]
    cones = _widened_to_neighbours(vertices, axes, cones, _NEIGHBOURHOOD * spacing)

    lower, upper = mesh.bounds
    radius = BALL_DEPTH * float(np.min(upper - lower))
    centres, radii = np.zeros_like(vertices), np.zeros(len(vertices))
    for halving in range(_HALVINGS):
        missing = radii == 0.0
        wanted = radius / 2**halving
        tried = vertices[missing] + wanted * inward[missing]
        depth = -solid.signed_distance(tried)
        found = depth >= 0.5 * wanted
        at = np.flatnonzero(missing)[found]
        centres[at], radii[at] = tried[found], depth[found]
    placed = radii > 0.0
    if not placed.any():
        thinnest = 2.0 * radius / 2 ** (_HALVINGS - 1)
        raise ShapeError(f"its walls are thinner than {thinnest:.2g} m all over; make them thicker")
    return Balls(
        centres=np.ascontiguousarray(centres[placed].T),
        radii=radii[placed],
        axes=np.ascontiguousarray(axes[placed].T),
        cones=cones[placed],
        exact=False,
    )


def _sphere_balls(shape: Sphere) -> tuple[Points, float]:
    return np.zeros((1, 3)), shape.radius


def _capsule_balls(shape: Capsule) -> tuple[Points, float]:
    # Between balls a tenth of a radius apart the surface is off by 0.1 % of the radius.
    count = int(np.ceil(shape.height / (0.1 * shape.radius))) + 1
    centres = np.zeros((count, 3))
    centres[:, 2] = np.linspace(-0.5 * shape.height, 0.5 * shape.height, count)
    return centres, shape.radius


def _torus_balls(shape: Torus) -> tuple[Points, float]:
    count = int(np.ceil(2.0 * np.pi * shape.major_radius / (0.1 * shape.minor_radius)))
    angle = 2.0 * np.pi * np.arange(count) / count
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    return shape.major_radius * circle, shape.minor_radius


_EXACT_BALLS: dict[type, Callable[..., tuple[Points, float]]] = {
    Sphere: _sphere_balls,
    Capsule: _capsule_balls,
    Torus: _torus_balls,
}
"""Shapes that are unions of balls of one radius: centres (m, 3) and radius [m], unscaled."""


def _vertex_frames(mesh: TriangleMesh) -> tuple[Points, Points, NDArray[np.float64]]:
    """Of every vertex, its offset when all faces move in by one, its normal, and the largest angle of a face's to it.

    The offset d solves N d = -1 for the normals N of the faces at the vertex, in the sense of least squares.
    """
    area_vectors = mesh.area_vectors
    area = np.linalg.norm(area_vectors, axis=1)
    corner, weight = mesh.faces.ravel(), np.repeat(area, 3)
    normal = np.repeat(area_vectors / np.maximum(area, np.finfo(np.float64).tiny)[:, None], 3, axis=0)
    count = len(mesh.vertices)

    def averaged(values: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.maximum(np.bincount(corner, weights=weight, minlength=count), np.finfo(np.float64).tiny)
        return np.bincount(corner, weights=weight * values, minlength=count) / total

    mean = np.stack([averaged(normal[:, i]) for i in range(3)], axis=1)
    second = np.stack([averaged(normal[:, i] * normal[:, j]) for i in range(3) for j in range(3)], axis=1)
    second = second.reshape(count, 3, 3)
    # The small diagonal leaves smooth vertices, whose normals span one direction, an offset along it. Refining takes
    # its part out again elsewhere: a box must not stand on corners of uneven height.
    offset = np.zeros((count, 3))
    for _ in range(_REFINEMENTS):
        residual = -mean - np.einsum("nij,nj->ni", second, offset)
        offset += np.linalg.solve(second + 1.0e-3 * np.eye(3), residual[:, :, None])[:, :, 0]
    axis = mean / np.maximum(np.linalg.norm(mean, axis=1), np.finfo(np.float64).tiny)[:, None]
    cosine = np.ones(count)
    np.minimum.at(cosine, corner[weight > 0.0], np.einsum("ij,ij->i", normal, axis[corner])[weight > 0.0])
    return offset, axis, np.arccos(np.clip(cosine, -1.0, 1.0))


def _widened_to_neighbours(
    points: Points, axes: Points, cones: NDArray[np.float64], radius: float
) -> NDArray[np.float64]:
    """Cones that on smooth surfaces reach the normals of the neighbours, so that no direction is left out."""
    smooth = np.flatnonzero(cones < _SMOOTH)
    pairs = smooth[cKDTree(points[smooth]).query_pairs(radius, output_type="ndarray")]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", axes[pairs[:, 0]], axes[pairs[:, 1]]), -1.0, 1.0))
    widened = cones.copy()
    for end in (0, 1):
        np.maximum.at(widened, pairs[:, end], angle)
    return widened


def _one_per_cell(points: Points, priority: NDArray[np.float64], spacing: float) -> NDArray[np.int64]:
    """Index of the point of highest priority in every cell of a grid; the first of equal ones."""
    cell = np.floor((points - points.min(axis=0)) / spacing + 0.5).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    order = np.lexsort((np.arange(len(points)), -np.round(priority, 6), key))
    _, first = np.unique(key[order], return_index=True)
    return np.sort(order[first])
