"""Boundary samples on the device, sorted into the cells of the fluid's grid."""

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.fluid.boundary_akinci2012 import BoundarySamples
from sim.neighbors import CellGrid, CellSort

EVERYWHERE = 1.0e30
"""Stands for "no limit" where samples are sorted [m]."""


class Boundary:
    """Samples of walls and bodies that do not move.

    Attributes:
        given_count: number of samples given.
        count: number of samples near enough to the grid to matter.
        position: (count,) of 3-vectors [m].
        coordinates: the same as x, y and z [m].
        psi: rho0 V_b of each sample [kg], (count,).
        index: row in the samples given of each of these, (count,), on the host.
        cell_start: cell ranges of the samples.
    """

    def __init__(self, samples: BoundarySamples, grid: CellGrid, spacing: float, rest_density: float) -> None:
        psi = rest_density * samples.volumes(spacing)
        low = np.array(grid.origin)
        high = low + grid.cell_size * np.array(grid.shape)
        near = np.flatnonzero(((samples.positions >= low) & (samples.positions <= high)).all(axis=1))
        self.given_count, self.count = len(samples.positions), len(near)
        position, ids = _device_array(samples.positions[near], 3), _device_array(near.astype(np.int32))
        cells = CellSort(grid, self.count)
        cells.sort(position, ids, self.count, (-EVERYWHERE,) * 3, (EVERYWHERE,) * 3)
        self.cell_start = cells.cell_start
        self.index: NDArray[np.int64] = near[cells.order.to_numpy()[: self.count]]
        sorted_positions = samples.positions[self.index]
        self.position = _device_array(sorted_positions, 3)
        self.coordinates = tuple(_device_array(np.ascontiguousarray(sorted_positions[:, axis])) for axis in range(3))
        self.psi = _device_array(psi[self.index].astype(np.float32))


def _device_array(values: NDArray[np.generic], width: int = 1) -> ti.Ndarray:
    """Device array of these rows; one of zeros where there is none, as kernels take no empty arrays."""
    rows = values if len(values) else np.zeros((1, *values.shape[1:]), dtype=values.dtype)
    dtype = ti.i32 if rows.dtype == np.int32 else ti.f32
    array = ti.ndarray(dtype, len(rows)) if width == 1 else ti.Vector.ndarray(width, dtype, len(rows))
    array.from_numpy(np.ascontiguousarray(rows))
    return array
