"""Where the action of a film is: boxes around what moves, frame by frame, and one box around all of it.

Boxes leave outliers out, so that one droplet that flies off does not shrink the picture: `LEFT_OUT` of a fluid's
particles and of a smoke's mass on each of the six sides. Bodies and cloths count whole.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from render.errors import InvalidFileError

Box = NDArray[np.float64]
"""Lower and upper corner [m], (2, 3)."""

LEFT_OUT = 0.002
"""Share of a fluid or a smoke that its box leaves out on each side [-]: the crown of a splash holds some percent of the
water, the droplets that fly off hold less than that."""
LEAST_EDGE = 0.1
"""Shortest edge of a framed box, in diagonals of the domain [-]: the stage around it has the domain's size, too."""

BOUNDS_VERSION = 1


def box_of_points(points: ArrayLike) -> Box:
    """The box around points (n, 3) [m], n at least 1."""
    rows = np.asarray(points, dtype=np.float64)
    return np.stack([rows.min(axis=0), rows.max(axis=0)])


def box_of_particles(position: ArrayLike, radius: float) -> Box:
    """The box around a fluid's particles, without the outliers on each side.

    Args:
        position: of their centres [m], (n, 3), n at least 1.
        radius: of a particle [m].
    """
    low, high = np.quantile(np.asarray(position, dtype=np.float64), [LEFT_OUT, 1.0 - LEFT_OUT], axis=0)
    return np.stack([low - radius, high + radius])


def box_of_smoke(density: NDArray[np.float32], lower: ArrayLike, cell_size: float) -> Box | None:
    """The box around a smoke, without the thin rest on each side; None where there is no smoke.

    Args:
        density: of its cells [-], (nx, ny, nz).
        lower: lower corner of the first cell [m], (3,).
        cell_size: edge of a cell [m].
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


def around(boxes: Iterable[Box]) -> Box | None:
    """The box around all boxes, or None without any."""
    stacked = list(boxes)
    if not stacked:
        return None
    corners = np.array(stacked)
    box: Box = np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
    return box


def framed_box(action: Box | None, *, domain: Box, world: Box) -> Box:
    """What the camera frames: the action, as far as it is in the world, and not smaller than the stage allows.

    Args:
        action: the box around all that moves or stands in the film; None if there is nothing.
        domain: the domain, framed where there is no action in the world.
        world: the box around the domain and the boxes of the smokes; what flies out of it is not followed.
    """
    if action is None or (action[1] <= world[0]).any() or (action[0] >= world[1]).any():
        return domain
    box: Box = np.clip(action, world[0], world[1])
    lacking = LEAST_EDGE * float(np.linalg.norm(domain[1] - domain[0])) - (box[1] - box[0])
    box += 0.5 * np.maximum(lacking, 0.0) * np.array([[-1.0], [1.0]])
    return box


def write_bounds(path: Path, boxes: Mapping[str, Box]) -> None:
    """Write boxes by name; docs/formats.md. The same boxes give the same bytes."""
    document = {"version": BOUNDS_VERSION, "boxes": {name: box.tolist() for name, box in boxes.items()}}
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_bounds(path: Path) -> dict[str, Box]:
    """Boxes by name.

    Raises:
        InvalidFileError: it holds none, or of another version, or one whose lower corner is not the lower.
        OSError: it cannot be read.
    """
    try:
        document: Any = json.loads(path.read_text(encoding="utf-8"))
        if document["version"] != BOUNDS_VERSION:
            raise InvalidFileError(path, f"is of version {document['version']}, this program reads {BOUNDS_VERSION}")
        boxes = {name: np.array(corners, dtype=np.float64) for name, corners in document["boxes"].items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidFileError(path, f"holds no boxes: {error}") from error
    for name, box in boxes.items():
        if box.shape != (2, 3) or not np.isfinite(box).all() or (box[0] > box[1]).any():
            raise InvalidFileError(path, f'"{name}" is no box: {box.tolist()}')
    return boxes


def validate_bounds(path: Path) -> None:
    """Read them all. Raises InvalidFileError when one is no box."""
    read_bounds(path)
