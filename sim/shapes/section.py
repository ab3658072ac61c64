"""Sections of shapes: what a plane through the centre of a shape, across its z axis, cuts out of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.shapes.parameters import FileShape, Shape
from sim.shapes.placement import build_rest_shape
from sim.shapes.solid import ShapeError

POINTS_ALONG_A_SIDE = 400  # at which a section is looked at for its area: 0.1 % of a disc


@dataclass(frozen=True, eq=False)
class Section:
    """A region of the plane, in the shape's x and y axes."""

    half_size: NDArray[np.float64]  # half of the sides of a box around it, about the shape's centre [m], (2,)
    depth: Callable[[NDArray[np.float64]], NDArray[np.float64]]  # of points [m], (n, 2): positive inside [m], (n,)
    area: float  # [m²]


def section_of(shape: Shape) -> Section:
    """The section of a shape about its own origin.

    Raises:
        ShapeError: the shape cannot be built, or the plane misses it.
        OSError: its file cannot be read.
    """
    status = Path(shape.file).stat() if isinstance(shape, FileShape) else None
    return _section_of(shape, None if status is None else (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=32)
def _section_of(shape: Shape, _state: tuple[int, int] | None) -> Section:
    """The section of a shape, and of the state of its file."""
    rest = build_rest_shape(shape)
    directions = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    half = rest.support(directions).reshape(2, 2).max(axis=1)

    def depth(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return -rest.signed_distance(np.pad(points, ((0, 0), (0, 1))))

    middles = (np.arange(POINTS_ALONG_A_SIDE) + 0.5) / POINTS_ALONG_A_SIDE * 2.0 - 1.0
    points = np.stack(np.meshgrid(middles * half[0], middles * half[1], indexing="ij"), axis=-1).reshape(-1, 2)
    share = float((depth(points) > 0.0).mean())
    if share == 0.0:
        raise ShapeError("a plane through its centre, across its z axis, cuts nothing out of it")
    return Section(half, depth, share * 4.0 * float(half[0] * half[1]))
