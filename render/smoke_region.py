"""The region where smoke may be drawn: cells that hold some, and those it crosses while the shutter is open."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Box = tuple[slice, slice, slice]

_SLAB = 8  # cells along x that are looked at together: their velocities in float64 take little room


def bounding_box(mask: NDArray[np.bool_]) -> Box | None:
    """The smallest box of cells around those that are marked, or None where there are none; mask (nx, ny, nz)."""
    across = mask.any(axis=2)
    spans = []
    for marked in (across.any(axis=1), across.any(axis=0), mask.any(axis=(0, 1))):
        cells = np.flatnonzero(marked)
        if not cells.size:
            return None
        spans.append(slice(int(cells[0]), int(cells[-1]) + 1))
    return spans[0], spans[1], spans[2]


def blur_reach(velocity: NDArray[np.float32], mask: NDArray[np.bool_], *, shutter_s: float, cell_size: float) -> int:
    """Cells around the smoke in which a renderer looks up velocities: max|v| shutter / 2, and one to interpolate.

    A frame is at the middle of the time that the shutter is open [s], so smoke is drawn up to half of it away. No more
    than the longest side of the grid, which reaches everything.

    Args:
        velocity: (nx, ny, nz, 3) [m/s].
        mask: (nx, ny, nz), where there is smoke.
        shutter_s: how long the shutter is open [s].
        cell_size: edge of a cell [m].
    """
    fastest = 0.0
    for start in range(0, mask.shape[0], _SLAB):
        slab = slice(start, start + _SLAB)
        moving = velocity[slab][mask[slab]].astype(np.float64)
        if moving.size:
            fastest = max(fastest, float(np.einsum("nc,nc->n", moving, moving).max()))
    return min(math.ceil(math.sqrt(fastest) * shutter_s / (2.0 * cell_size)) + 1, max(mask.shape))


def grown(mask: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """All cells at most `reach` cells along each axis from a marked one, in an array longer by that on all sides."""
    from scipy.ndimage import maximum_filter

    found: NDArray[np.bool_] = maximum_filter(np.pad(mask, reach), size=2 * reach + 1, mode="constant")
    return found
