"""Whether the cells of a smoke are fine enough for the walls of a body: air passes between the corners that it holds.

A wall of normal n and thickness d holds a corner of every row of them along the axis of its largest |n_i|, and thus
lets no air through (`cut_cells`), if d is at least cell_size * max |n_i|; of a thinner one a part of these rows has
none, unless it happens to lie along a layer of corners. That part is what is measured here, at points of the surface.
Beside an edge that is sharper than 45 degrees off a plate's two sides, such as the rim of a cone, a body is thin as
well; cells only blunt it, and what they miss there does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.core.domain import DomainParameters
from sim.shapes.sampling import stratified_points
from sim.shapes.solid import Solid, outward_normals
from sim.smoke.parameters import WHOLE, SmokeParameters

Points = NDArray[np.float64]

PROBES = 1000  # points of the surface within the box below which the thickness is looked at: shares right to 0.03
POINTS_DRAWN = 64 * PROBES  # of the whole surface if the box cuts some off; fewer are looked at if a 64th is in it
DEPTHS = 8  # along the ray inwards, up to the edge of a cell, where it is seen whether it is still in the body
HALVINGS = 5  # of the interval in which a ray leaves the body
OPPOSITE = np.cos(np.deg2rad(45.0))  # least cosine between a ray and the surface's normal where it leaves a wall
LUCK = (0.0, 1.0 / 3.0, 2.0 / 3.0)  # where in a cell a body that moves may be, for an average [cells]


@dataclass(frozen=True)
class ThinWalls:
    """What the cells miss of a body."""

    share: float  # of its surface in the box [-], as far as it is thinner than a cell below
    thickness: float  # its median there [m]; 0 where nothing is missed


def thin_walls(
    solid: Solid, smoke: SmokeParameters, domain: DomainParameters, others: Sequence[Solid] = ()
) -> ThinWalls:
    """What a smoke's cells miss of a body that stands still in its box.

    What lies on a closed side counts as seen, and so does what has a corner in another body, which stands still as
    well, right beside it.
    """
    low, high = (np.asarray(corner) for corner in smoke.limits(domain))
    # A face that lies in a side of the box, but for round-off, is not in it.
    points, inwards = _probes(solid, (low + WHOLE * smoke.cell_size, high - WHOLE * smoke.cell_size))
    depth = _thickness(solid, points, inwards, smoke.cell_size)
    thin = np.flatnonzero(np.isfinite(depth))
    missed = thin[~_has_corner([solid, *others], points[thin], inwards[thin], smoke, domain)]
    return _walls(depth, missed, len(points))


def thin_walls_on_the_way(solid: Solid, smoke: SmokeParameters) -> ThinWalls:
    """What cells of this size miss on average of a body that moves, if it is turned as it is now."""
    points, inwards = _probes(solid, None)
    depth = _thickness(solid, points, inwards, smoke.cell_size)
    thin = np.flatnonzero(np.isfinite(depth))
    missed = [
        thin[~_row([solid], points[thin], inwards[thin], np.full(3, part * smoke.cell_size), smoke.cell_size)]
        for part in LUCK
    ]
    return _walls(depth, np.concatenate(missed), len(LUCK) * len(points))


def _walls(depth: NDArray[np.float64], missed: NDArray[np.int64], looked_at: int) -> ThinWalls:
    if len(missed) == 0:
        return ThinWalls(0.0, 0.0)
    return ThinWalls(len(missed) / looked_at, float(np.median(depth[missed])))


def _probes(solid: Solid, box: tuple[Points, Points] | None) -> tuple[Points, Points]:
    """Points of the surface within a box [m], evenly by area, and unit vectors into the body, (n, 3) each."""
    mesh = solid.surface_mesh()
    low, high = box if box is not None else (np.full(3, -np.inf), np.full(3, np.inf))
    is_cut = np.any((solid.bounds[0] <= low) | (solid.bounds[1] >= high))
    points, face = stratified_points(mesh, POINTS_DRAWN if is_cut else PROBES)
    kept = np.flatnonzero(np.all((points > low) & (points < high), axis=1))
    kept = kept[:: max(1, len(kept) // PROBES)]
    inwards = -mesh.area_vectors[face[kept]]
    return points[kept], inwards / np.linalg.norm(inwards, axis=1, keepdims=True)


def _thickness(solid: Solid, points: Points, inwards: Points, longest: float) -> NDArray[np.float64]:
    """How far rays inwards stay in a wall [m], (n,); infinite where that is farther than `longest` [m], or no wall."""
    step = longest / DEPTHS
    left = np.full(len(points), np.inf)
    for number in range(DEPTHS):
        ahead = np.flatnonzero(np.isinf(left))
        depth = (number + 0.5) * step
        outside = solid.signed_distance(points[ahead] + depth * inwards[ahead]) > 0.0
        left[ahead[outside]] = depth
    thin = np.flatnonzero(np.isfinite(left))
    low, high = np.maximum(left[thin] - step, 0.0), left[thin]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        outside = solid.signed_distance(points[thin] + middle[:, None] * inwards[thin]) > 0.0
        low, high = np.where(outside, low, middle), np.where(outside, middle, high)
    left[thin] = high
    ends = points[thin] + high[:, None] * inwards[thin]
    left[thin[np.sum(outward_normals(solid.signed_distance, ends, 0.01 * step) * inwards[thin], axis=1) < OPPOSITE]] = (
        np.inf
    )
    return left


def _has_corner(
    solids: Sequence[Solid], points: Points, inwards: Points, smoke: SmokeParameters, domain: DomainParameters
) -> NDArray[np.bool_]:
    """Whether the row of corners at each point has one in a body, or ends right there at a closed side, (n,)."""
    low, high = (np.asarray(corner) for corner in smoke.limits(domain))
    found = _row(solids, points, inwards, np.asarray(smoke.corners(domain)[0]), smoke.cell_size)
    axis, every = np.abs(inwards).argmax(axis=1), np.arange(len(points))
    for side, beside in (("-", points - low < smoke.cell_size), ("+", high - points < smoke.cell_size)):
        closed = np.array([f"{name}{side}" not in smoke.open_faces for name in "xyz"])
        found |= closed[axis] & beside[every, axis]
    return found


def _row(solids: Sequence[Solid], points: Points, inwards: Points, low: Points, cell_size: float) -> NDArray[np.bool_]:
    """Whether a body holds one of the two corners next to each point, along the axis of its largest |n_i|, (n,).

    The row goes through the point, not through corners: the rim of a plate, of which cells cut off up to their width,
    is not missed. Bodies may lie beside each other; cells have a corner at `low` [m], (3,).
    """
    found = np.zeros(len(points), bool)
    axis, every = np.abs(inwards).argmax(axis=1), np.arange(len(points))
    layer = (points - low)[every, axis] / cell_size
    for next_layer in (np.floor(layer), np.floor(layer) + 1.0):
        places = points.copy()
        places[every, axis] = low[axis] + next_layer * cell_size
        for solid in solids:
            left = np.flatnonzero(~found)
            found[left] = solid.signed_distance(places[left]) < 0.0
    return found
