"""Springs of rectangles on a CPU, without lists: every direction eight lines at a time."""

from itertools import product

import numpy as np
import taichi as ti

from sim.cloth.bundles import Lines
from sim.cloth.device_cells import SHEAR_SWEEPS
from sim.cloth.parameters import ClothParameters
from sim.cloth.row_springs import (
    LANES,
    bend_lines,
    load_blocks,
    measure_excess_in_lines,
    measure_lines,
    row_blocks,
    solve_cells_in_rows,
    solve_lines,
    store_blocks,
    straighten_lines,
    strips_of,
)
from sim.cloth.sheet import Grid
from sim.cloth.springs import bend_share, line_widths
from sim.cloth.state import ClothState, HostCloths
from sim.core.host_access import put
from sim.core.reductions import runs_on_gpu

ALONG_Y, ALONG_X = 0, 1
"""Directions of lines: upright blocks, then turned ones."""


def rectangles_in_rows(host: HostCloths) -> dict[int, Grid]:
    """Cloths that `RectangleSprings` serves, by number: the rectangles on a CPU.

    A GPU has use for all lines and pieces at once, and solves those of lists.
    """
    if runs_on_gpu():
        return {}
    return {number: grid for number, grid in enumerate(host.grids) if grid is not None}


class RectangleSprings:
    """The springs of one rectangle: the same ones in the same order as `XPBDSprings` solves those of lists.

    Args:
        state: what they move.
        grid: how the rectangle is divided.
        first_node: number of its first node.
    """

    def __init__(self, state: ClothState, grid: Grid, first_node: int) -> None:
        self._state, self._grid = state, grid
        self._blocks = blocks = row_blocks(grid.columns, grid.rows)
        room = blocks.u.shape[0]
        self._multipliers, *self._strains = (ti.Vector.ndarray(LANES, ti.f32, room) for _ in range(3))
        lengths, firsts, node_steps = (grid.rows, grid.columns), (0, blocks.turned), (grid.columns, 1)
        strips = (strips_of(grid.columns), strips_of(grid.rows))
        self._lines = tuple(
            Lines(
                count=lengths[1 - axis],
                length=lengths[axis],
                first=firsts[axis],
                strips=strips[axis],
                other_first=firsts[1 - axis],
                other_strips=strips[1 - axis],
                first_node=first_node,
                line_step=node_steps[1 - axis],
                node_step=node_steps[axis],
            )
            for axis in (ALONG_Y, ALONG_X)
        )
        self._steps = (grid.step_y, grid.step_x)
        self._thread_stiffness, self._bend_stiffness = (
            tuple(ti.ndarray(ti.f32, lines.strips * LANES) for lines in self._lines) for _ in range(2)
        )
        self._cell_stiffness = self._poisson = self._bend_damping = 0.0

    def take_parameters(self, cloth: ClothParameters) -> None:
        """Stiffness and damping as they are now; `springs` says how those of a sheet become those of its springs."""
        grid = self._grid
        across = ((grid.columns, grid.step_x), (grid.rows, grid.step_y))
        for axis, ((lines, spacing), step) in enumerate(zip(across, self._steps, strict=True)):
            width = line_widths(lines, spacing)
            padding = np.zeros(self._lines[axis].strips * LANES - lines)
            put(self._thread_stiffness[axis], np.append(cloth.plane_stiffness * width / step, padding + 1.0))
            put(self._bend_stiffness[axis], np.append(cloth.bend_stiffness * bend_share(width, step), padding))
        self._cell_stiffness = cloth.shear_stiffness * grid.step_x * grid.step_y
        self._poisson = cloth.poisson_ratio
        self._bend_damping = cloth.bend_damping

    def displace(self, dt: float, sweeps: int) -> None:
        """Bring the displacements of a step of dt [s] to where the springs let them go, in so many sweeps."""
        state, blocks = self._state, self._blocks
        self._load()
        for axis in (ALONG_X, ALONG_Y):
            bend_lines(
                blocks,
                self._lines[axis],
                self._bend_stiffness[axis],
                state.quantum,
                dt * dt,
                self._bend_damping / dt,
            )
        for sweep in range(sweeps):
            for time, parity in product(range(SHEAR_SWEEPS if sweep == 0 else 1), range(2)):
                solve_cells_in_rows(
                    blocks,
                    parity,
                    self._lines[ALONG_Y],
                    self._steps[::-1],
                    self._cell_stiffness,
                    state.quantum,
                    dt * dt,
                    int(sweep == time == 0),
                )
            self._solve_threads(dt, is_first=sweep == 0)
        for axis in (ALONG_X, ALONG_Y):
            straighten_lines(blocks, self._lines[axis])
        store_blocks(blocks, state.nodes, self._lines[ALONG_Y])

    def sweep(self, dt: float) -> None:
        """Solve the threads once more, after contacts."""
        self._load()
        self._solve_threads(dt, is_first=False)
        store_blocks(self._blocks, self._state.nodes, self._lines[ALONG_Y])

    def _load(self) -> None:
        for lines in self._lines:
            load_blocks(self._blocks, self._state.nodes, lines)

    def _solve_threads(self, dt: float, *, is_first: bool) -> None:
        state, blocks = self._state, self._blocks
        for axis in (ALONG_X, ALONG_Y) if self._poisson > 0.0 else ():
            measure_lines(blocks, self._lines[axis], self._steps[axis], state.quantum, self._strains[axis])
        for axis in (ALONG_X, ALONG_Y):
            solve_lines(
                blocks,
                self._lines[axis],
                self._thread_stiffness[axis],
                self._steps[axis],
                state.quantum,
                dt * dt,
                int(is_first),
                self._multipliers,
                self._poisson,
                self._strains[1 - axis],
            )

    def excess(self, dt: float) -> tuple[float, int]:
        """Largest excess of a spring [rest lengths], and how many have not converged (`threads.excess_of`)."""
        state = self._state
        found = [
            measure_excess_in_lines(
                self._multipliers,
                self._lines[axis],
                self._thread_stiffness[axis],
                self._steps[axis],
                self._poisson,
                self._strains[1 - axis],
                state.nodes,
                dt * dt,
            )
            for axis in (ALONG_Y, ALONG_X)
        ]
        return max(float(largest) for largest, _ in found), sum(int(count) for _, count in found)
