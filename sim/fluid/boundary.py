"""Boundary samples on the device: of walls and static bodies, then of bodies that move, then of sheets."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from sim.cells import CellGrid, CellSort, SortedPoints
from sim.fluid.boundary_kernels import NO_BODY, STATE_WIDTH, order_samples, place_samples, take_samples

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sim.fluid.boundary_akinci2012 import BoundarySamples
    from sim.solver import Arrays

EVERYWHERE = 1.0e30
"""Stands for "no limit" where samples are sorted [m]."""


class Boundary:
    """Samples of walls and bodies, as the sums over neighbours read them.

    The fixed samples come first, sorted by cell; the moving ones follow in the order they were given, body by body, and
    after them those of sheets, which whoever moves the sheets places.

    Attributes:
        given_count: number of fixed samples given.
        fixed_count: number of those near enough to the grid to matter.
        moving_count: number of samples of moving bodies and of sheets.
        body_sample_count: number of those of moving bodies.
        sheet_count: number of those of sheets.
        body_count: number of moving bodies.
        position: (fixed + moving,) of 3-vectors [m].
        velocity: (fixed + moving,) of 3-vectors [m/s], 0 for the fixed ones.
        volume: V_b of each sample [m³], (fixed + moving,).
        friction_volume: V_b as friction counts it [m³], 0 for samples without friction, (fixed + moving,).
        index: row in the fixed samples given of each fixed sample here, (fixed,), on the host.
        offset: moving samples relative to the centre of mass of their body, in its axes [m], (moving,) of 3-vectors.
        body: number of the body of each moving sample, `NO_BODY` for those of sheets, (moving,), int32.
        body_start: first moving sample of each body, (bodies + 1,), on the host.
        reach: largest distance of a sample from the centre of mass of its body [m], (bodies,), on the host.
        states: of the bodies, as `place` takes them: centre of mass, rotation, velocity and angular velocity of the
            first, then of the next, float32 (`boundary_kernels.STATE_WIDTH`).
    """

    def __init__(
        self,
        fixed: BoundarySamples,
        moving: BoundarySamples,
        *,
        is_smooth: NDArray[np.bool_],
        sheets: BoundarySamples,
        body_count: int,
        grid: CellGrid,
        spacing: float,
        support_in_spacings: float,
    ) -> None:
        """Sort and weigh samples; those of the fixed ones that are smooth, (m,), exert no friction."""
        if (np.diff(moving.body) < 0).any() or moving.body.max(initial=-1) >= body_count:
            raise ValueError(f"moving samples must be given body by body, numbered from 0 to {body_count - 1}")
        low = np.array(grid.origin)
        high = low + grid.cell_size * np.array(grid.shape)
        near = np.flatnonzero(((fixed.positions >= low) & (fixed.positions <= high)).all(axis=1))
        self.given_count, self.fixed_count = len(fixed.positions), len(near)
        self.body_sample_count, self.sheet_count = len(moving.positions), len(sheets.positions)
        self.moving_count = self.body_sample_count + self.sheet_count
        self.body_count = body_count
        ids = _device_array(near.astype(np.int32))
        cells = CellSort(grid, self.fixed_count)
        cells.sort(_device_array(fixed.positions[near]), ids, self.fixed_count, (-EVERYWHERE,) * 3, (EVERYWHERE,) * 3)
        self.index: NDArray[np.int64] = near[cells.order.to_numpy()[: self.fixed_count]]
        fixed_positions = fixed.positions[self.index]
        self.fixed_points = SortedPoints(_coordinates(fixed_positions), cells.cell_start)

        volumes = np.concatenate(
            [
                fixed.volumes(spacing, support_in_spacings)[self.index],
                *(each.volumes(spacing, support_in_spacings) for each in (moving, sheets)),
            ]
        )
        moving_positions = np.concatenate([moving.positions, sheets.positions])
        self.position = _device_array(np.concatenate([fixed_positions, moving_positions]))
        self.velocity = _device_array(np.zeros((self.fixed_count + self.moving_count, 3), dtype=np.float32))
        self.volume = _device_array(volumes.astype(np.float32))
        volumes[: self.fixed_count][is_smooth[self.index]] = 0.0
        self.friction_volume = _device_array(volumes.astype(np.float32))

        no_body = np.full(self.sheet_count, NO_BODY, dtype=np.int32)
        self.offset, self.body = _device_array(moving.positions), _device_array(np.concatenate([moving.body, no_body]))
        self.body_start: NDArray[np.int64] = np.searchsorted(moving.body, np.arange(body_count + 1))
        distance = np.linalg.norm(moving.positions.astype(np.float64), axis=1)
        self.reach: NDArray[np.float64] = np.array(
            [distance[moving.body == body].max(initial=0.0) for body in range(body_count)]
        )
        self.states = ti.ndarray(ti.f32, max(body_count, 1) * STATE_WIDTH)
        self._host_states = self._reference_states = self.states.to_numpy()
        self._moving_cells = CellSort(grid, self.moving_count) if self.moving_count else None
        self._moving_ids = _device_array(np.arange(self.moving_count, dtype=np.int32))
        self._moving_position = ti.Vector.ndarray(3, ti.f32, max(self.moving_count, 1))
        self._moving_points = (
            SortedPoints(_coordinates(moving_positions), self._moving_cells.cell_start) if self._moving_cells else None
        )
        self._reference_sheets = _device_array(sheets.positions)
        self.moving_index = _device_array(np.zeros(self.moving_count, dtype=np.int32))

    @property
    def count(self) -> int:
        """Samples of walls, of all bodies and of sheets."""
        return self.fixed_count + self.moving_count

    @property
    def first_sheet(self) -> int:
        """Index of the first sample of sheets among all samples."""
        return self.fixed_count + self.body_sample_count

    def place(
        self,
        position: NDArray[np.float64],
        rotation: NDArray[np.float64],
        velocity: NDArray[np.float64],
        angular_velocity: NDArray[np.float64],
    ) -> float:
        """Put the moving samples where their bodies are, at the velocity of that point of the body.

        Args:
            position: centres of mass [m], (bodies, 3).
            rotation: from body to world axes, (bodies, 3, 3).
            velocity: of the centres of mass [m/s], (bodies, 3).
            angular_velocity: [rad/s], (bodies, 3).

        Returns:
            How far any sample got at most [m].
        """
        if not self.body_count:
            return 0.0
        states = np.concatenate([position, rotation.reshape(-1, 9), velocity, angular_velocity], axis=1)
        before = self._host_states
        self._place(np.ascontiguousarray(states, dtype=np.float32).ravel())
        # In float64 of the float32 states, which a checkpoint holds: a run that continues finds the same.
        moved = (self._host_states.astype(np.float64) - before).reshape(-1, STATE_WIDTH)
        # Two rotations by an angle a apart differ by 2 sqrt(2) sin(a/2), and points at a distance of 1 by 2 sin(a/2).
        turned = np.linalg.norm(moved[:, 3:12], axis=1) / math.sqrt(2.0)
        return float((np.linalg.norm(moved[:, :3], axis=1) + turned * self.reach).max())

    def checkpoint(self) -> dict[str, NDArray[np.float32]]:
        """Where the bodies and sheets are, and where they were when the moving samples were sorted last."""
        arrays = {"body_states": self.states.to_numpy(), "reference_body_states": self._reference_states.copy()}
        if self.sheet_count:
            own = slice(self.first_sheet, self.count)
            arrays["sheet_position"] = self.position.to_numpy()[own].copy()
            arrays["sheet_velocity"] = self.velocity.to_numpy()[own].copy()
            arrays["reference_sheet_position"] = self._reference_sheets.to_numpy()
        return arrays

    def restore_reference(self, arrays: Arrays) -> None:
        """Put bodies and sheets where they were when the moving samples were sorted before the checkpoint."""
        self._place(arrays["reference_body_states"])
        if self.sheet_count:
            self._put_sheets(self.position, arrays["reference_sheet_position"])

    def restore(self, arrays: Arrays) -> None:
        """Put bodies and sheets where they were at the checkpoint."""
        self._place(arrays["body_states"])
        if self.sheet_count:
            self._put_sheets(self.position, arrays["sheet_position"])
            self._put_sheets(self.velocity, arrays["sheet_velocity"])

    def _put_sheets(self, array: ti.Ndarray, rows: NDArray[np.generic]) -> None:
        values = array.to_numpy()
        values[self.first_sheet : self.count] = rows
        array.from_numpy(values)

    def _place(self, states: NDArray[np.generic]) -> None:
        self._host_states = np.ascontiguousarray(states)
        self.states.from_numpy(self._host_states)
        place_samples(
            self.offset, self.body, self.body_sample_count, self.fixed_count, self.states, self.position, self.velocity
        )

    def sort_moving(self) -> SortedPoints | None:
        """Sort the moving samples by cell, where they are now; None where there are none.

        `moving_index` then tells the index of each of the sorted.
        """
        if self._moving_cells is None or self._moving_points is None:
            return None
        self._reference_states = self.states.to_numpy()
        count, first = self.moving_count, self.fixed_count
        take_samples(self.position, first, count, self._moving_position)
        take_samples(self.position, self.first_sheet, self.sheet_count, self._reference_sheets)
        self._moving_cells.sort(self._moving_position, self._moving_ids, count, (-EVERYWHERE,) * 3, (EVERYWHERE,) * 3)
        order_samples(
            self._moving_position, self._moving_cells.order, count, first,
            *self._moving_points.coordinates, self.moving_index,
        )  # fmt: skip
        return self._moving_points


def _coordinates(positions: NDArray[np.float32]) -> tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray]:
    x, y, z = (_device_array(np.ascontiguousarray(positions[:, axis])) for axis in range(3))
    return x, y, z


def _device_array(values: NDArray[np.generic]) -> ti.Ndarray:
    """Device array of these rows; one of zeros where there is none, as kernels take no empty arrays."""
    rows = values if len(values) else np.zeros((1, *values.shape[1:]), dtype=values.dtype)
    dtype = ti.i32 if rows.dtype == np.int32 else ti.f32
    array = ti.ndarray(dtype, len(rows)) if rows.ndim == 1 else ti.Vector.ndarray(3, dtype, len(rows))
    array.from_numpy(np.ascontiguousarray(rows))
    return array
