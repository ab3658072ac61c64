"""Bounds of a film's action: the reach of all that moves in many directions, per frame and over the whole film.

A reach is a number for each of `DIRECTIONS`: the largest d . x of what there is. Together they bound a convex body that
is never larger than the axes' box around it, and cuts off the corners of that which nothing gets to: what a camera
frames is the tighter for it. The reach of a film is the largest of its frames'.

Reaches leave outliers out, so that one droplet that flies off does not shrink the picture: `LEFT_OUT` of a fluid's
particles and of a smoke's mass on each of the six sides, and between these what is sparse. Bodies and cloths count
whole.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import InvalidFileError

Box = NDArray[np.float64]  # lower and upper corner [m], (2, 3)
Reach = NDArray[np.float64]  # largest d . x for each d of DIRECTIONS [m], (50,)

DIRECTIONS = np.array(
    [d for d in itertools.product(range(-2, 3), repeat=3) if max(map(abs, d)) == 1 or sorted(map(abs, d)) == [0, 1, 2]],
    dtype=np.float64,
)
"""(50, 3): the axes, the diagonals of squares and cubes, and those halfway between axes and squares' diagonals. Not
normalized, so that a coordinate times a component is exact. The n-th from the end is the opposite of the n-th."""
_LENGTHS = np.sqrt((DIRECTIONS**2).sum(axis=1))
_UPWARDS = np.array([int(np.flatnonzero((axis == DIRECTIONS).all(axis=1))[0]) for axis in np.eye(3)])
_DOWNWARDS = len(DIRECTIONS) - 1 - _UPWARDS  # where the axes are among the directions, and their opposites

LEFT_OUT = 0.002
"""Share of a fluid or a smoke that its box leaves out on each side [-]: the crown of a splash holds some percent of the
water, the droplets that fly off hold less than that."""
_CELL_IN_RADII = 8.0
_DENSE_CELL = 8
"""Particles that make a cell of four of their spacings dense, an eighth of those that fill it: as much as the corner of
a block has in a cell that it half reaches into."""
LEAST_EDGE = 0.1
"""Shortest edge of what is framed, in diagonals of the domain [-]: the set around it has the domain's size, too."""

BOUNDS_VERSION = 2  # 1: boxes along the axes

_SAME_PLACE = 1.0e-9
"""In metres, or largest reaches: what is nearer to a plane lies in it. Planes of a smaller determinant do not meet."""


def reach_of_points(points: ArrayLike) -> Reach:
    """Reach of points (n, 3) [m], n at least 1."""
    columns = np.ascontiguousarray(np.asarray(points, dtype=np.float64).T)
    return np.array([_along(columns, direction).max() for direction in DIRECTIONS])


def reach_of_box(box: Box) -> Reach:
    """Reach of a box."""
    reach: Reach = np.maximum(DIRECTIONS * box[0], DIRECTIONS * box[1]).sum(axis=1)
    return reach


def reach_of_particles(position: ArrayLike, radius: float) -> Reach:
    """Reach of a fluid's particles with centres (n, 3) [m], n at least 1, without the outliers.

    Along the axes it leaves `LEFT_OUT` of them out on each side. Between them it does, too, but takes in what of the
    rest is dense.
    """
    rows = np.asarray(position, dtype=np.float64)
    low, high = np.quantile(rows, [LEFT_OUT, 1.0 - LEFT_OUT], axis=0)
    rows = rows[((rows >= low) & (rows <= high)).all(axis=1)]
    reach = reach_of_box(np.stack([low, high]))
    if len(rows):
        columns = np.ascontiguousarray(rows.T)
        of_dense = columns[:, _is_dense(rows, _CELL_IN_RADII * radius)]
        for number, direction in enumerate(DIRECTIONS[: len(DIRECTIONS) // 2]):
            if number not in _DOWNWARDS:
                along, dense = _along(columns, direction), _along(of_dense, direction)
                reach[number] = min(reach[number], _farthest(along, dense))
                opposite = len(DIRECTIONS) - 1 - number
                reach[opposite] = min(reach[opposite], _farthest(-along, -dense))
    reach += radius * _LENGTHS
    return reach


def _farthest(all_of_it: NDArray[np.float64], dense: NDArray[np.float64]) -> float:
    """The largest number of what is dense, or more if more than the share that is left out lies beyond."""
    farthest = float(dense.max(initial=-np.inf))
    if np.count_nonzero(all_of_it > farthest) <= LEFT_OUT * (len(all_of_it) - 1):
        return farthest
    return float(np.quantile(all_of_it, 1.0 - LEFT_OUT))


def _is_dense(points: NDArray[np.float64], cell_size: float) -> NDArray[np.bool_]:
    """Whether each of the points (n, 3) has many others in its cell of a lattice, (n,)."""
    cells = np.floor((points - points.min(axis=0)) / cell_size).astype(np.int64)
    width, depth, _ = cells.max(axis=0) + 1
    _, which, counts = np.unique(
        cells[:, 0] + width * (cells[:, 1] + depth * cells[:, 2]), return_inverse=True, return_counts=True
    )
    dense: NDArray[np.bool_] = counts[which] >= _DENSE_CELL
    return dense


def _along(points: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """d . x of points by coordinate (3, n), (n,); a sum in this order on every processor."""
    found: NDArray[np.float64] = direction[0] * points[0]
    found += direction[1] * points[1]
    found += direction[2] * points[2]
    return found


def box_of_smoke(density: NDArray[np.float32], lower: ArrayLike, cell_size: float) -> Box | None:
    """The box around a smoke, without the thin rest on each side; None where there is no smoke.

    Args:
        density: of its cells of edge `cell_size` [m], (nx, ny, nz).
        lower: lower corner of the first cell [m], (3,).
    """
    if not density.size or not density.any():
        return None
    ends = []
    for axis in range(3):
        layers = density.sum(axis=tuple({0, 1, 2} - {axis}), dtype=np.float64)
        below = np.cumsum(layers) / layers.sum()
        first = int(np.searchsorted(below, LEFT_OUT, side="right"))
        last = int(np.searchsorted(below, 1.0 - LEFT_OUT, side="left"))
        ends.append((first, last + 1))
    box: Box = np.asarray(lower, dtype=np.float64) + cell_size * np.array(ends, dtype=np.float64).T
    return box


def around(reaches: Iterable[Reach]) -> Reach | None:
    """The reach of all together, or None of nothing."""
    stacked = list(reaches)
    return np.max(stacked, axis=0) if stacked else None


def box_of(reach: Reach) -> Box:
    """The box along the axes around what has this reach."""
    return np.stack([-reach[_DOWNWARDS], reach[_UPWARDS]])


def framed(action: Reach | None, *, domain: Box, world: Box) -> Reach:
    """What the camera frames: the action, as far as it is in the world, and not smaller than the set allows.

    Args:
        action: of all that moves or stands in the film; None if there is nothing.
        domain: the domain, framed where there is no action in the world.
        world: the box around the domain and the boxes of the smokes; what flies out of it is not followed.
    """
    if action is None:
        return reach_of_box(domain)
    box = box_of(action)
    if (box[1] <= world[0]).any() or (box[0] >= world[1]).any():
        return reach_of_box(domain)
    clipped = action.copy()
    clipped[_UPWARDS] = np.minimum(action[_UPWARDS], world[1])
    clipped[_DOWNWARDS] = np.minimum(action[_DOWNWARDS], -world[0])
    if not len(corners_of(clipped)):
        return reach_of_box(domain)
    box = box_of(clipped)
    lacking = np.maximum(LEAST_EDGE * float(np.linalg.norm(domain[1] - domain[0])) - (box[1] - box[0]), 0.0)
    # The sum of the body and a box of what it lacks.
    clipped += reach_of_box(0.5 * lacking * np.array([[-1.0], [1.0]]))
    return clipped


def corners_of(reach: Reach) -> NDArray[np.float64]:
    """Corners of the convex body that reaches so far, (n, 3) [m], some of them several times; none if it is empty.

    Of every three planes the point in which they meet, if no other plane cuts it off: 50 planes have few such triples.
    """
    normals, offsets = DIRECTIONS / _LENGTHS[:, None], reach / _LENGTHS
    triples, weights = _meeting_planes()
    points = sum(offsets[triples[:, [each]]] * weights[each] for each in range(3))
    slack = _SAME_PLACE * max(1.0, float(np.abs(offsets).max()))
    corners: NDArray[np.float64] = points[(points @ normals.T <= offsets + slack).all(axis=1)]
    return corners


@cache
def _meeting_planes() -> tuple[NDArray[np.int64], list[NDArray[np.float64]]]:
    """Which three planes meet in a point, (n, 3), and the three vectors (n, 3) that their offsets weigh to give it."""
    normals = DIRECTIONS / _LENGTHS[:, None]
    triples = np.array([*itertools.combinations(range(len(DIRECTIONS)), 3)])
    first, second, third = (normals[triples[:, each]] for each in range(3))
    determinants = (first * np.cross(second, third)).sum(axis=1)
    meet = np.abs(determinants) > _SAME_PLACE
    crosses = np.cross(second, third), np.cross(third, first), np.cross(first, second)
    return triples[meet], [cross[meet] / determinants[meet, None] for cross in crosses]


def write_bounds(path: Path, reaches: Mapping[str, Reach]) -> None:
    """Write reaches by name; docs/guide/formats.md. The same reaches give the same bytes."""
    document = {"version": BOUNDS_VERSION, "reaches": {name: reach.tolist() for name, reach in reaches.items()}}
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_bounds(path: Path) -> dict[str, Reach]:
    """Reaches by name.

    Raises:
        InvalidFileError: it holds none, or of another version, or some of what has no inside.
        OSError: it cannot be read.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if document["version"] != BOUNDS_VERSION:
            raise InvalidFileError(path, f"is of version {document['version']}, this program reads {BOUNDS_VERSION}")
        reaches = {name: np.array(numbers, dtype=np.float64) for name, numbers in document["reaches"].items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidFileError(path, f"holds no bounds: {error}") from error
    for name, reach in reaches.items():
        if reach.shape != (len(DIRECTIONS),) or not np.isfinite(reach).all() or (reach + reach[::-1] < 0.0).any():
            raise InvalidFileError(path, f'"{name}" bounds nothing: {reach.tolist()}')
    return reaches


def validate_bounds(path: Path) -> None:
    """Read them all. Raises InvalidFileError when some bound nothing."""
    read_bounds(path)
