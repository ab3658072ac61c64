"""Pictures of smoke: points, a cell each, and slices. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.web.drawing.shapes import Smoke

AXES = "xyz"
MOST_POINTS = 60_000
THINNEST = 0.02
"""Of the densest cell: what has less is not drawn as a point."""
SLICE_PIXELS = 512
"""Along the longer side, at most as many as cells times four."""
_THIN, _THICK = np.array([70.0, 78.0, 96.0]), np.array([236.0, 238.0, 242.0])


@dataclass(frozen=True)
class SmokePoints:
    """A point a cell."""

    position: NDArray[np.float32]  # [m], (n, 3) float32
    colors: NDArray[np.uint8]  # (n, 3) uint8
    count: int  # number of cells with smoke, of which n are shown


@dataclass(frozen=True)
class Slice:
    """A cut through a smoke."""

    picture: NDArray[np.uint8]  # (rows, columns, 4) uint8, its first row at the upper end of `up`
    corner: NDArray[np.float64]  # where the picture's lower left corner is [m]
    right: NDArray[np.float64]  # edges of the picture [m], (3,)
    up: NDArray[np.float64]  # edges of the picture [m], (3,)


def points(smoke: Smoke, *, densest: float, most: int = MOST_POINTS) -> SmokePoints:
    """Cells with smoke, the denser the lighter; of more than `most`, an evenly spread part."""
    cells = np.flatnonzero(smoke.density > THINNEST * densest)
    count = len(cells)
    if count > most:
        # Not every k-th: on a grid that would leave planes.
        cells = cells[np.random.default_rng(0).permutation(count)[:most]]
    index = np.stack(np.unravel_index(cells, smoke.density.shape), axis=1)
    position = np.asarray(smoke.origin) + (index + 0.5) * smoke.cell_size
    share = np.clip(smoke.density.ravel()[cells] / (densest or 1.0), 0.0, 1.0)[:, None] ** 0.5
    colors = np.rint(_THIN + share * (_THICK - _THIN)).astype(np.uint8)
    return SmokePoints(position.astype(np.float32), colors, count)


def cut(
    smoke: Smoke,
    *,
    axis: str,
    share: float,
    box: tuple[tuple[float, float, float], tuple[float, float, float]],
    densest: float,
) -> Slice | None:
    """A slice across an axis, "x", "y" or "z"; None where there is no smoke.

    Args:
        share: where in the box, 0 at its lower face and 1 at its upper.
        box: the smoke's whole box [m], of which `smoke` has what is not empty.
        densest: density that is opaque white.
    """
    normal = AXES.index(axis)
    place = box[0][normal] + share * (box[1][normal] - box[0][normal])
    layer = int((place - smoke.origin[normal]) // smoke.cell_size)
    if layer == smoke.density.shape[normal] and share >= 1.0:
        layer -= 1  # the upper face belongs to the last cell
    if not 0 <= layer < smoke.density.shape[normal] or not smoke.density.size:
        return None
    across, upwards = (each for each in range(3) if each != normal)
    density = np.take(smoke.density, layer, axis=normal)  # (across, upwards), ascending axes
    share_of_white = np.clip(density.T[::-1] / (densest or 1.0), 0.0, 1.0) ** 0.5
    picture = np.empty((*share_of_white.shape, 4), np.uint8)
    picture[..., :3] = np.rint(_THIN + share_of_white[..., None] * (_THICK - _THIN))
    picture[..., 3] = np.rint(40.0 + 215.0 * share_of_white)
    finer = max(1, min(4, SLICE_PIXELS // max(density.shape)))
    picture = np.repeat(np.repeat(picture, finer, axis=0), finer, axis=1)
    corner = np.array(smoke.origin, np.float64)
    corner[normal] = place
    right, up = np.zeros(3), np.zeros(3)
    right[across] = density.shape[0] * smoke.cell_size
    up[upwards] = density.shape[1] * smoke.cell_size
    return Slice(picture, corner, right, up)
