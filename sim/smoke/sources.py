"""Sources: regions that set smoke, heat and velocity to at least given values."""

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from sim.shapes import build_solid
from sim.smoke.grid import SmokeGrid
from sim.smoke.obstacles import Obstacles
from sim.smoke.parameters import SmokeParameters, SmokeSourceParameters

BLOCK = 256
"""Cells whose emission one thread adds up."""

FLUCTUATION_CELLS = 4
"""Edge of the blocks of cells that fluctuate together: smaller ones are averaged away by the flow."""

FLUCTUATION_RATE_HZ = 20.0
"""How often the fluctuation changes."""


@ti.func
def hash_to_unit(key: ti.u32):
    """A number in [0, 1) from 32 bits (Jarzynski & Olano 2020, PCG)."""
    state = key * ti.u32(747796405) + ti.u32(2891336453)
    word = ((state >> ((state >> ti.u32(28)) + ti.u32(4))) ^ state) * ti.u32(277803737)
    return ti.cast(((word >> ti.u32(22)) ^ word) >> ti.u32(8), ti.f32) / 16777216.0


@ti.data_oriented
class Source:
    """One source on one grid: the open cells and faces whose centres lie inside it.

    What an obstacle that moves covers just now emits nothing.

    Velocity is imposed before the projection, which may change it: a source drives the flow, it is no inlet. So it
    never creates volume, and also blows in a closed box.

    Attributes:
        target_density, target_excess: what cells inside are raised to [-], [K above the air].
        speed: largest component of the imposed velocity [m/s].
        cell_count: how many cells outside of static solids lie inside.
    """

    def __init__(
        self,
        parameters: SmokeSourceParameters,
        obstacles: Obstacles,
        *,
        ambient_temperature: float,
        openness: tuple,
        velocity: tuple,
        cell_fields: tuple,
    ) -> None:
        self.parameters = parameters
        self.target_density = parameters.density
        self.target_excess = parameters.temperature - ambient_temperature
        self.speed = max(map(abs, parameters.velocity)) if parameters.velocity is not None else 0.0
        grid = obstacles.grid
        self._obstacles = obstacles
        self._step_x, self._step_y, self._padded_y = (
            grid.padded[1] * grid.padded[2],
            grid.padded[2],
            grid.padded[1],
        )
        self._density, self._excess = cell_fields
        self._openness, self._velocity = openness, velocity
        region = build_solid(parameters)
        cells = grid.cells_inside(region) & ~grid.solid
        self.cell_count = int(np.count_nonzero(cells))
        self._cells = _index_field(_flat_indices(grid, cells))
        self._block_count = -(-max(1, self.cell_count) // BLOCK)
        self._emitted = ti.field(ti.f32, shape=self._block_count)
        faces = [
            _flat_indices(grid, grid.faces_inside(region, axis) & (grid.open_area[axis] > 0.0)) for axis in range(3)
        ]
        self._face_counts = [len(indices) for indices in faces]
        self._faces = [_index_field(indices) for indices in faces]

    def emit(self, time_s: float) -> float:
        """Bring the fields to the source's values at a simulated time [s].

        The fluctuation is a function of place and time alone, so a run that continues sees the same.

        Returns:
            The density added, summed over cells [-].
        """
        self._raise_cells(int(time_s * FLUCTUATION_RATE_HZ))
        if self.parameters.velocity is not None:
            for axis, speed in enumerate(self.parameters.velocity):
                self._set_faces(
                    self._faces[axis], self._openness[axis], self._velocity[axis], self._face_counts[axis], speed
                )
        return float(self._emitted.to_numpy().sum(dtype=np.float64))

    @ti.kernel
    def _raise_cells(self, tick: ti.i32):
        for block in range(self._block_count):
            emitted = 0.0
            for n in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.cell_count)):
                at = self._cells[n]
                if not self._obstacles.is_solid(at):
                    before = self._density[at]
                    after = ti.max(before, self.target_density)
                    self._density[at] = after
                    emitted += after - before
                    shortfall = self.parameters.fluctuation * self._fluctuate(at, tick)
                    target = (1.0 - shortfall) * self.target_excess
                    # Heat is raised to the target, and cold lowered.
                    excess = self._excess[at]
                    self._excess[at] = ti.max(excess, target) if self.target_excess >= 0.0 else ti.min(excess, target)
            self._emitted[block] = emitted

    @ti.func
    def _fluctuate(self, at: ti.i32, tick: ti.i32):
        """A number in [0, 1) that a few neighbouring cells share."""
        patch_i = at // self._step_x // FLUCTUATION_CELLS
        patch_j = at // self._step_y % self._padded_y // FLUCTUATION_CELLS
        patch_k = at % self._step_y // FLUCTUATION_CELLS
        patch = (patch_i * 1024 + patch_j) * 1024 + patch_k
        # The odd factor (Knuth's) spreads ticks over all bits, so that they do not shift the pattern.
        return hash_to_unit(ti.cast(patch, ti.u32) ^ (ti.cast(tick, ti.u32) * ti.u32(2654435769)))

    @ti.kernel
    def _set_faces(
        self, faces: ti.template(), openness: ti.template(), field: ti.template(), count: ti.i32, speed: ti.f32
    ):
        for n in range(count):
            if openness[faces[n]] > 0.0:
                field[faces[n]] = speed


def build_sources(
    parameters: SmokeParameters, obstacles: Obstacles, *, openness: tuple, velocity: tuple, cell_fields: tuple
) -> Sequence[Source]:
    """The sources of a smoke.

    Args:
        parameters: of the smoke.
        obstacles: in its grid.
        openness: by axis, positive on faces that air passes, flat fields.
        velocity: the three face velocities [m/s], flat fields.
        cell_fields: density and temperature excess, flat fields.

    Raises:
        ValueError: a source contains no open cell: it lies outside the box, in a solid, or is smaller than a cell.
    """
    sources = [
        Source(
            source,
            obstacles,
            ambient_temperature=parameters.ambient_temperature,
            openness=openness,
            velocity=velocity,
            cell_fields=cell_fields,
        )
        for source in parameters.source
    ]
    grid = obstacles.grid
    for number, source in enumerate(sources):
        if source.cell_count == 0:
            raise ValueError(
                f'smoke "{parameters.name}", source {number}: no cell centre lies inside it; move it into the box '
                f"from {grid.origin} to {grid.upper} m, out of solids, or make it larger than a cell "
                f"of {grid.cell_size:g} m"
            )
    return sources


def _flat_indices(grid: SmokeGrid, mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.flatnonzero(grid.pad(mask)).astype(np.int32)


def _index_field(indices: NDArray[np.int32]) -> ti.Field:
    """A field of at least one entry, as Taichi knows no empty ones."""
    field = ti.field(ti.i32, shape=max(1, len(indices)))
    if len(indices):
        field.from_numpy(indices)
    return field
