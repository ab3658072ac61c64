"""Dense arrays of a smoke's file, as other programs read it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from render.volume import import_openvdb


@dataclass(frozen=True)
class Volume:
    """Contents over a box of cells, in the units of `write_volume`; the temperature is above ambient [K].

    Attributes:
        centre: world position of the centre of the first cell [m].
        metadata: of each grid, by its name.
    """

    density: np.ndarray
    temperature: np.ndarray
    velocity: np.ndarray
    centre: tuple[float, float, float]
    cell_size: float
    metadata: dict[str, dict[str, Any]]


def read_volume(path: Path, shape: tuple[int, int, int], first_cell: tuple[int, int, int] = (0, 0, 0)) -> Volume:
    """A box of cells from `first_cell` on."""
    grids = {grid.name: grid for grid in import_openvdb().readAll(str(path))[0]}
    arrays = {name: np.zeros((*shape, 3) if name == "velocity" else shape, np.float32) for name in grids}
    for name, grid in grids.items():
        grid.copyToArray(arrays[name], ijk=first_cell)
    transform = grids["density"].transform
    metadata = {name: dict(grid.metadata) for name, grid in grids.items()}
    return Volume(
        **arrays, centre=transform.indexToWorld(first_cell), cell_size=transform.voxelSize()[0], metadata=metadata
    )
