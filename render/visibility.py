"""Visibility of points and meshes to a camera, by geometry alone: before rendering, without occlusion."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.camera_path import SENSOR_WIDTH_MM, View

Array = NDArray[np.float64]

CLIP_START, CLIP_END = 1.0e-3, 1.0e3
"""Nearest and farthest that is drawn, in distances to the point looked at; see `blender_scripts/camera.py`."""
GRID = 9  # points along each edge of a box that stand for it: what lies between them is an eighth of the box
STRAIGHT_DOWN = 1.0e-9
MOST_TRIANGLES = 100_000  # of a mesh that are projected; of more, every second, third, ...


def screen_positions(view: View, points: Array, *, aspect: float) -> Array:
    """Positions (n, 2) of points (n, 3) [m] in a picture of this width over height.

    -1 and 1 are its edges, y points up; NaN behind the camera.
    """
    offset = np.asarray(points, dtype=np.float64) - view.position
    forward = np.subtract(view.look_at, view.position)
    forward /= max(float(np.linalg.norm(forward)), STRAIGHT_DOWN)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < STRAIGHT_DOWN:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    depth = offset @ forward
    plane = np.stack([offset @ right, offset @ np.cross(right, forward)], axis=1)
    # Blender's sensor fits the longer side of the picture.
    half_long = SENSOR_WIDTH_MM / 2.0 / view.focal_length_mm
    half = half_long * np.array([min(1.0, aspect), 1.0 / max(1.0, aspect)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(depth[:, None] > 0.0, plane / (depth[:, None] * half), np.nan)


def in_picture(view: View, points: Array, *, aspect: float) -> NDArray[np.bool_]:
    """Which points (n, 3) are between the edges of the picture, (n,)."""
    inside: NDArray[np.bool_] = (np.abs(screen_positions(view, points, aspect=aspect)) <= 1.0).all(axis=1)
    return inside


def points_of_box(lower: Sequence[float], upper: Sequence[float]) -> Array:
    """Points that stand for a box [m], (n, 3)."""
    edges = [np.linspace(low, high, GRID) for low, high in zip(lower, upper, strict=True)]
    return np.array(list(itertools.product(*edges)), dtype=np.float64)


def covered_cells(
    view: View, vertices: NDArray[Any], faces: NDArray[np.int32], *, shape: tuple[int, int], aspect: float
) -> tuple[NDArray[np.bool_], float]:
    """The cells of a coarse picture that a mesh covers, and the share of the picture it covers, approximately.

    That is the cells that triangles have their middle or a corner in, and half of the area of all triangles: of a
    closed mesh what it covers, and somewhat more where parts of it hide each other.
    """
    cells = np.zeros(shape, np.bool_)
    every = 1 + len(faces) // MOST_TRIANGLES
    places = screen_positions(view, vertices, aspect=aspect)
    corners = places[faces[::every]]
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    middles = corners.mean(axis=1)
    corners = corners[(np.abs(middles) <= 1.0).all(axis=1)]
    if not len(corners):
        return cells, 0.0
    points = np.concatenate([corners.reshape(-1, 2), corners.mean(axis=1)])
    points = points[(np.abs(points) < 1.0).all(axis=1)]
    rows, columns = shape
    cells[
        ((1.0 - points[:, 1]) / 2.0 * rows).astype(np.int64), ((1.0 + points[:, 0]) / 2.0 * columns).astype(np.int64)
    ] = True
    first, second = (corners[:, corner] - corners[:, 0] for corner in (1, 2))
    areas = 0.5 * np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    return cells, float(every * areas.sum() / 2.0 / 4.0)


def clip_range(view: View) -> tuple[float, float]:
    """Nearest and farthest that is drawn along the view [m]."""
    distance = math.dist(view.position, view.look_at)
    return CLIP_START * distance, CLIP_END * distance


def is_inside(point: Sequence[float], vertices: NDArray[Any], faces: NDArray[np.int32]) -> bool:
    """Whether a point is in a closed mesh, by the generalized winding number (Jacobson et al. 2013).

    It is 1 or -1 in all inside and 0 outside; halfway between for a mesh with holes.
    """
    if not len(faces) or (vertices.min(axis=0) > point).any() or (vertices.max(axis=0) < point).any():
        return False
    import igl

    corners, place = np.asarray(vertices, dtype=np.float64), np.asarray(point, dtype=np.float64)
    return bool(abs(igl.winding_number(corners, faces.astype(np.int64), place)) > 0.5)
